"""Who comes and goes while a shop runs: browsers, scrapers, viewers that leave or never read, a flood on the bus."""

from __future__ import annotations

import contextlib
import http.client
import json
import select
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from websockets.sync.client import connect

from fdhil.daemon.daemon_socket import SOCKET_NAME
from studies.soak_shop import MachineRig

WAIT_S = 60.0
FLOOD_CHUNK = 2000  # frames that are written to the hub at once
EMERGENCY = 0x080
PAGES = (
    "/", "/api/machine", "/api/machine/parameters", "/api/history", "/api/history/X", "/api/rapids",
    "/api/rapids/counts", "/api/events", "/api/events/black-boxes", "/api/program", "/api/program/learning",
)  # fmt: skip


def fetch_page(url: str, path: str, method: str = "GET", body: bytes | None = None) -> tuple[int, bytes]:
    """Ask for a page as a browser does; return the status and the answer."""
    place = urlsplit(url)
    connection = http.client.HTTPConnection(str(place.hostname), place.port, timeout=WAIT_S)
    try:
        connection.request(method, path, body=body, headers={"X-Fdhil": "1"})
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def browse_pages(shop: MachineRig) -> int:
    """Open every page once and look at the live one for some messages; return how many answers were none."""
    bad = sum(fetch_page(shop.url, path)[0] != 200 for path in PAGES)
    address = shop.url.replace("http", "ws", 1) + "/api/live/stream?seconds=10&columns=400"
    with connect(address, subprotocols=["fdhil"], open_timeout=WAIT_S) as stream:  # type: ignore[list-item]
        for _ in range(6):
            reported = stream.recv(timeout=WAIT_S)
            if isinstance(reported, bytes):
                header = json.loads(reported[4 : 4 + int.from_bytes(reported[:4], "little")])
                stream.send(json.dumps({"drawn": header["number"]}))
    return bad


def look_at_a_rapid(shop: MachineRig) -> int:
    """Have the newest rapid replayed; return 1 where that failed."""
    newest = json.loads(fetch_page(shop.url, "/api/rapids?limit=1")[1])["rapids"]
    if not newest:
        return 1
    rapid = newest[0]
    return int(fetch_page(shop.url, f"/api/rapids/{rapid['axis']}/{rapid['id']}/signals")[0] != 200)


def drop_a_program(shop: MachineRig, name: str, text: str) -> int:
    """Have a program forecast as the page does; return 1 where it was not taken."""
    return int(fetch_page(shop.url, f"/api/program?name={name}", "POST", text.encode())[0] != 202)


def scrape_metrics(shop: MachineRig) -> int:
    """Read the metrics as Prometheus does; return 1 where there are none."""
    port = shop.document["publish"]["prometheus"]["port"]
    return int(fetch_page(f"http://127.0.0.1:{port}", "/metrics")[0] != 200)


@contextlib.contextmanager
def query_repeatedly(shop: MachineRig, request: dict[str, Any]) -> Iterator[socket.socket]:
    """Connect to the daemon's socket and send requests; the caller may read the answers or leave."""
    path: Path = shop.folder / "run" / SOCKET_NAME
    with socket.socket(socket.AF_UNIX) as client:
        client.settimeout(WAIT_S)
        client.connect(str(path))
        client.sendall(json.dumps(request).encode() + b"\n")
        yield client


def leave_live_stream(shop: MachineRig) -> int:
    """Read some of the live stream, then disconnect in the middle of a line."""
    with query_repeatedly(shop, {"request": "live"}) as client:
        for _ in range(5):
            client.recv(1000)
    return 0


def send_invalid_requests(shop: MachineRig) -> int:
    """Send an invalid request, and leave a partial one."""
    with query_repeatedly(shop, {"request": "what?", "x": "\x1b[31m" * 200}) as client:
        client.recv(100)
        client.sendall(b'{"request": "sta')
    return 0


class Silent:
    """Viewers that never read: the daemon must skip their lines and let them go in the end."""

    def __init__(self) -> None:
        self._stack = contextlib.ExitStack()

    def connect_silently(self, shop: MachineRig) -> int:
        """Connect once more, in place of the previous connection."""
        self.disconnect()
        self._stack.enter_context(query_repeatedly(shop, {"request": "live"}))
        return 0

    def disconnect(self) -> None:
        """Disconnect."""
        self._stack.close()


def flood_bus(shop: MachineRig, frames: int, node: int = 1) -> int:
    """Send so many emergencies of a drive on the bus, as fast as it takes them; return how many."""
    place = shop.document["bus"]["can0"]
    with socket.create_connection((place["host"], place["port"]), timeout=WAIT_S) as hub:
        for greeting in (b"< open can0 >", b"< rawmode >"):
            hub.recv(4096)
            hub.sendall(greeting)
        text = f"< send {EMERGENCY + node:03X} 8 10 81 11 0 0 0 0 0 >".encode() * FLOOD_CHUNK
        hub.settimeout(0.0)
        return _push_text(hub, text, frames)


def _push_text(hub: socket.socket, text: bytes, frames: int) -> int:
    """Write the text again and again; what the hub sends meanwhile is read and dropped, until it has read all."""
    sent, left = 0, b""
    while sent < frames or left:
        if not left:
            left, sent = text, sent + FLOOD_CHUNK
        readable, writable, _ = select.select([hub], [hub], [], WAIT_S)
        if readable and not hub.recv(1 << 20):
            raise ConnectionError("the hub closed the connection")
        if writable:
            left = left[hub.send(left) :]
    hub.shutdown(socket.SHUT_WR)
    hub.settimeout(WAIT_S)
    while hub.recv(1 << 20):
        pass
    return sent
