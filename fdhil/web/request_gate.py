"""The gate before every route: checks host, origin, size, login and role before a byte of a body is read.

One rule for all routes: reading below /api requires the role ``watch``, changing ``operate``. Disarming requires only a
login: a client that may read can always stop the correction. The shell, its scripts and the login are open and reveal
nothing of the machine.
"""

import asyncio
import json
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from fdhil.config import Web
from fdhil.web.fault_responses import RequestRefused
from fdhil.web.login import LoginManager, Principal

API = "/api/"
SESSION = "/api/session"
DISARM = "/api/machine/disarm"
COMPUTES_ONLY = "/api/program"
"""Judging a program requires reading rights only: it does not affect the machine."""
READING = ("GET", "HEAD", "OPTIONS")
LARGEST_BODY = 64 * 1024
LARGEST_PROGRAM = 16 * 1024 * 1024
BODY_S, PROGRAM_S = 20.0, 300.0
"""Time limits of a body, so that slow senders cannot hold connections."""
BEARER = "bearer."
"""A browser's WebSocket has no header for the token: it is a subprotocol, ["fdhil", "bearer.TOKEN"]."""
HEADERS: Mapping[str, str] = {
    "content-security-policy": (
        "default-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'; object-src 'none'"
    ),
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "permissions-policy": "camera=(), geolocation=(), microphone=()",
}


class RequestGate:
    """Passes permitted requests on, and answers the others."""

    def __init__(self, app: ASGIApp, settings: Web, access: LoginManager) -> None:
        self._app, self._access, self._settings = app, access, settings
        self._hosts = {"localhost", "127.0.0.1", "[::1]", *map(str.lower, settings.allowed_hosts)}
        if settings.host not in ("0.0.0.0", "::"):
            self._hosts.add(f"[{settings.host}]" if ":" in settings.host else settings.host.lower())
        self._origins = {origin.rstrip("/").lower() for origin in settings.allowed_origins}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        try:
            self._check_host_and_origin(scope, headers)
            principal = self._check_principal(scope, headers)
            most, within_s = (LARGEST_PROGRAM, PROGRAM_S) if _is_program_path(scope["path"]) else (LARGEST_BODY, BODY_S)
            _check_length(headers, most)
        except RequestRefused as refused:
            await _send_refusal(scope, send, refused)
            return
        scope["fdhil.principal"] = principal
        if scope["type"] == "websocket":
            await self._app(scope, receive, send)
        else:
            await self._app(scope, _bound_body(receive, most, within_s), _add_headers(scope, send))

    def _check_host_and_origin(self, scope: Scope, headers: Headers) -> None:
        """Refuse foreign host names (DNS rebinding) and foreign pages (forged requests)."""
        host = headers.get("host", "").lower()
        if _parse_host(host) not in self._hosts or len(headers.getlist("host")) != 1:
            text = "this server does not have the requested name"
            raise RequestRefused(
                421, "BadHost", text, "use the address printed by fdhil web, or add the name to web.allowed_hosts"
            )
        origin = headers.get("origin")
        own = f"{'https' if scope['scheme'] in ('https', 'wss') else 'http'}://{host}"
        foreign = origin is not None and origin.lower() not in (own, *self._origins)
        site = headers.get("sec-fetch-site", "none")
        if origin is None and scope["path"].startswith(API):
            foreign = site not in ("none", "same-origin")
        if foreign:
            text = "the request comes from another server's page, nothing was done"
            raise RequestRefused(
                403, "BadOrigin", text, "open fdhil's own page, or add the page to web.allowed_origins"
            )

    def _check_principal(self, scope: Scope, headers: Headers) -> Principal:
        path, token = scope["path"], find_token(headers)
        principal = self._access.find_principal(token)
        writes = scope["type"] == "http" and scope["method"] not in READING
        if writes and headers.get("x-fdhil") != "1":
            raise RequestRefused(403, "BadOrigin", "the header X-Fdhil is missing, nothing was done", "send X-Fdhil: 1")
        if not path.startswith(API) or path == SESSION:
            return principal or Principal("", "watch")
        if principal is None:
            text = "not logged in, or the login has expired; nothing was done"
            raise RequestRefused(401, "AuthRequired", text, "log in again")
        if writes and not _is_program_path(path):
            self._check_operator_rights(path, principal)
        return principal

    def _check_operator_rights(self, path: str, principal: Principal) -> None:
        if not self._access.needs_login:
            text = "no user may act in the browser: there are no users; nothing was done"
            raise RequestRefused(401, "AuthRequired", text, "set web.users_file and add a user with fdhil web-user")
        if path == DISARM:
            return
        if principal.role != "operate":
            text = f"{principal.name} has the role {principal.role}, nothing was done"
            raise RequestRefused(403, "RoleRequired", text, "ask a user with the role operate")
        if not self._settings.acting:
            text = "only disarming is allowed in the browser here, nothing was done"
            raise RequestRefused(403, "ActingOff", text, "use the command line, or set web.acting = true")


def _is_program_path(path: str) -> bool:
    return path == COMPUTES_ONLY or path.startswith(f"{COMPUTES_ONLY}/")


def find_token(headers: Headers) -> str | None:
    """Return the token of a request: from a header, or from the subprotocol of a browser's socket."""
    kind, _, token = headers.get("authorization", "").partition(" ")
    if kind.lower() == "bearer":
        return token.strip() or None
    offered = [part.strip() for part in headers.get("sec-websocket-protocol", "").split(",")]
    return next((part.removeprefix(BEARER) for part in offered if part.startswith(BEARER)), None)


def _parse_host(host: str) -> str:
    try:
        parts = urlsplit(f"//{host}")
        name, _ = parts.hostname or "", parts.port
    except ValueError:
        return ""
    if parts.username is not None or parts.path or parts.query or parts.fragment:
        return ""
    return f"[{name}]" if ":" in name else name


def _check_length(headers: Headers, most: int) -> None:
    length = headers.get("content-length", "0")
    if not length.isdecimal() or int(length[:20]) > most:
        raise RequestRefused(413, "TooLarge", f"more than {most >> 10} KiB were sent, nothing was read", "send less")


def _bound_body(receive: Receive, most: int, within_s: float) -> Receive:
    """Wrap ``receive`` to end a body that is too long or too slow, whatever length it declared."""
    taken = 0
    until_s: float | None = asyncio.get_running_loop().time() + within_s

    async def receive_bounded() -> Message:
        nonlocal taken, until_s
        try:
            async with asyncio.timeout_at(until_s):
                message = await receive()
        except TimeoutError:
            raise RequestRefused(
                408, "TooSlow", "the request was not complete in time, nothing was done", "send it again"
            ) from None
        if not message.get("more_body", False):
            until_s = None  # what follows is the disconnect
        taken += len(message.get("body", b""))
        if taken > most:
            raise RequestRefused(
                413, "TooLarge", f"more than {most >> 10} KiB were sent, nothing was done", "send less"
            )
        return message

    return receive_bounded


def _add_headers(scope: Scope, send: Send) -> Send:
    cache_control = "no-store" if scope["path"].startswith(API) else "no-cache"

    async def send_with_headers(message: Message) -> None:
        if message["type"] == "http.response.start":
            more = {**HEADERS, "cache-control": cache_control}
            message["headers"] = [*message["headers"], *((k.encode(), v.encode()) for k, v in more.items())]
        await send(message)

    return send_with_headers


async def _send_refusal(scope: Scope, send: Send, refused: RequestRefused) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008, "reason": refused.document["code"]})
        return
    body = json.dumps(refused.document).encode()
    more = {"content-type": "application/json", "content-length": str(len(body)), "connection": "close"}
    if refused.status == 401:
        more["www-authenticate"] = "Bearer"
    start: dict[str, Any] = {"type": "http.response.start", "status": refused.status}
    sending = _add_headers(scope, send)
    await sending({**start, "headers": [(k.encode(), v.encode()) for k, v in more.items()]})
    await sending({"type": "http.response.body", "body": b"" if scope["method"] == "HEAD" else body})
