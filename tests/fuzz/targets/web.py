"""HTTP requests to ``fdhil web``, in process: every answer is a declared one, and none is an internal error.

A password is not hashed here, and no program is uploaded: both take time by design, and are separate entry points.
"""

from __future__ import annotations

import asyncio
import json
import tempfile
from pathlib import Path
from typing import Any
from unittest.mock import patch
from urllib.parse import unquote_to_bytes

import anyio.to_thread

from fdhil.web import login
from tests.fuzz.input_assessment import Target
from tests.web.http_clients import log_in_for_token, make_test_app

_FOLDER = tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None)
_LOOP = asyncio.new_event_loop()


def _build_no_match(_user: object, _password: str) -> bool:
    return False


async def _run_without_loop(function: Any, *given: Any, **_how: Any) -> Any:
    return function(*given)


APP = make_test_app(Path(_FOLDER.name))
TOKENS = ("", log_in_for_token(APP, "watcher"), log_in_for_token(APP, "operator"))
DECLARED = {200, 204, 206, 304, 400, 401, 403, 404, 405, 408, 409, 413, 416, 421, 422, 429, 503, 504}
ROUTES = sorted({path for route in APP.routes if "json" not in (path := getattr(route, "path", ""))} - {""})


def _build_scope(data: bytes) -> tuple[dict[str, Any], bytes]:
    head, _, body = data.partition(b"\n\n")
    first, *lines = head.split(b"\n")
    method, _, where = first.partition(b" ")
    path, _, query = where.partition(b"?")
    headers = [(k.strip().lower(), v.strip()) for k, _, v in (line.partition(b":") for line in lines)]
    return {
        "type": "http",
        "asgi": {"version": "3.0"},
        "http_version": "1.1",
        "method": method.decode("latin-1").upper()[:20],
        "scheme": "http",
        "path": unquote_to_bytes(path or b"/").decode("utf-8", "replace"),
        "raw_path": path,
        "query_string": query,
        "root_path": "",
        "headers": headers,
        "client": ("127.0.0.1", 1),
        "server": ("localhost", 80),
    }, body


async def _send_request(data: bytes) -> None:
    scope, body = _build_scope(data[1:])
    if scope["method"] == "POST" and scope["path"] == "/api/program":
        return
    scope["headers"] += [(b"host", b"localhost")] if data[0] & 4 else []
    scope["headers"] += [(b"x-fdhil", b"1")] if data[0] & 8 else []
    if token := TOKENS[data[0] % len(TOKENS)]:
        scope["headers"].append((b"authorization", f"Bearer {token}".encode()))
    messages, answers = [{"type": "http.request", "body": body, "more_body": False}], []

    async def receive() -> dict[str, Any]:
        if not messages:
            await asyncio.Event().wait()  # the browser stays
        return messages.pop(0)

    async def send(message: Any) -> None:
        answers.append(message)

    await APP(scope, receive, send)
    status = answers[0]["status"]
    assert status in DECLARED, (status, b"".join(m.get("body", b"") for m in answers)[:500])
    if status >= 400 and scope["path"].startswith("/api/") and scope["method"] != "HEAD":
        reported = json.loads(b"".join(message.get("body", b"") for message in answers[1:]))
        assert reported["code"], reported


def taste(data: bytes) -> None:
    """Send the request in the bytes, as the user selected by the first of them."""
    if data:
        # by design a password takes a tenth of a second; a thread per request takes most of the rest
        with (
            patch.object(login, "verify_password", _build_no_match),
            patch.object(anyio.to_thread, "run_sync", _run_without_loop),
        ):
            _LOOP.run_until_complete(_send_request(data))


def target() -> Target:
    seeds = [b"\x0dGET " + route.replace("{axis}", "X").encode() for route in ROUTES]
    seeds += [b"\x0eGET " + route.encode() + b"?axis=X&limit=3" for route in ROUTES if route.startswith("/api/")]
    seeds += [
        b'\x0ePOST /api/machine/arm\ncontent-type: application/json\n\n{"program": "part.ngc", "method": "inverse"}',
        b"\x0ePOST /api/machine/disarm\ncontent-type: application/json\n\n{}",
        b'\x0cPOST /api/session\ncontent-type: application/json\n\n{"name": "watcher", "password": "canary-9b1f"}',
        b"\x08GET /api/machine\nhost: evil.example\norigin: http://evil.example\nsec-fetch-site: cross-site",
        b"\x0dGET /static/app.js\nrange: bytes=0-10\nif-none-match: x\naccept-encoding: gzip",
    ]
    words = [
        b"content-length: ",
        b"host: ",
        b"origin: null",
        b"authorization: Bearer ",
        b"range: bytes=",
        b"%00",
        b"../",
        b"%ff",
    ]
    words += [b"?axis=", b"&limit=", b"NaN", b"1e999", b"\\ud800", *(route.encode() for route in ROUTES)]
    return Target("web", seeds, taste, words, 600)
