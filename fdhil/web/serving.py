"""Serves the pages: listens where the configuration allows it, with TLS where required, until stopped."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import ssl
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import TYPE_CHECKING

from fdhil.config import MachineConfig, Web, is_loopback
from fdhil.daemon import Shutdown, limit_heap_growth, trim_heap
from fdhil.errors import ConfigError, ConfigFault, ConnectError, FdhilError

if TYPE_CHECKING:
    import uvicorn
    from fastapi import FastAPI

NEEDED = ("fastapi", "uvicorn", "websockets")
LARGEST_MESSAGE = 64 * 1024
BACKLOG = 64
KEEP_ALIVE_S = 15
STOP_S = 3
END_S = 8.0  # below the TimeoutStopSec of the unit
GIVE_BACK_S = 60.0


def require_extra() -> None:
    """Raise FdhilError if the web extra is not installed."""
    if any(find_spec(name) is None for name in NEEDED):
        raise FdhilError("fdhil web needs the extra 'web': pip install 'fdhil[web]'")


def check_reach(web: Web) -> None:
    """Refuse to listen where other computers could read or act without protection. Raises ConfigError."""
    if web.on_loopback:
        return
    faults = []
    where = f"other computers can reach {web.host}"
    if web.tls_certificate_file is None and (web.acting or not web.unprotected):
        faults.append(ConfigFault("web.tls_certificate_file", f"is missing, and {where}", _advise_tls(web)))
    if web.users_file is None and not web.unprotected:
        advice = "add users with fdhil web-user, or set web.unprotected = true to let every computer read"
        faults.append(ConfigFault("web.users_file", f"is missing, and {where}", advice))
    if faults:
        raise ConfigError("web.host", faults)


def _advise_tls(web: Web) -> str:
    files = "set certificate and key"
    if web.acting:
        return f"{files}: operators send passwords"
    return f"{files}, or set web.unprotected = true to serve without TLS"


def serve_machine(config: MachineConfig, ready: Callable[[str], None]) -> None:
    """Serve the pages of a machine until SIGTERM or SIGINT; ``ready`` receives the address. FdhilError as below."""
    require_extra()
    from fdhil.web.application import make_app

    serve_application(config.web, lambda: make_app(config), ready)


def serve_application(web: Web, make: Callable[[], FastAPI], ready: Callable[[str], None]) -> None:
    """Serve an application until SIGTERM or SIGINT. Raises FdhilError if it cannot start."""
    require_extra()
    check_reach(web)
    certificate = _load_certificate(web)
    limit_heap_growth()
    with _open_listener(web) as listener:
        shutdown = Shutdown(END_S, os._exit)
        try:
            asyncio.run(_run_server(web, make, listener, certificate, ready, shutdown))
        finally:
            shutdown.cancel_deadline()


def make_url(web: Web, listener: socket.socket) -> str:
    port = listener.getsockname()[1]
    host = "localhost" if web.host in ("0.0.0.0", "::") else f"[{web.host}]" if ":" in web.host else web.host
    return f"{'https' if web.tls_certificate_file else 'http'}://{host}:{port}"


def _load_certificate(web: Web) -> ssl.SSLContext | None:
    if web.tls_certificate_file is None or web.tls_key_file is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(web.tls_certificate_file, web.tls_key_file)
    except (OSError, ssl.SSLError) as error:
        what = f"cannot be used: {error.strerror or error}"
        fault = ConfigFault(str(web.tls_certificate_file), what, f"check it and its key {web.tls_key_file}")
        raise ConfigError("web.tls_certificate_file", [fault]) from None
    return context


@contextlib.contextmanager
def _open_listener(web: Web) -> Iterator[socket.socket]:
    try:
        family, _, _, _, address = socket.getaddrinfo(web.host, web.port, type=socket.SOCK_STREAM)[0]
        if is_loopback(web.host) and not is_loopback(str(address[0])):
            raise OSError("the name is not an address of this computer")
        listener = socket.create_server(address[:2], family=family, backlog=BACKLOG)
    except OSError as error:
        text = f"is not available ({error.strerror or error}); set another web.host or web.port"
        raise ConnectError(f"{web.host}:{web.port}", text) from None
    with listener:
        yield listener


async def _run_server(
    web: Web,
    make: Callable[[], FastAPI],
    listener: socket.socket,
    certificate: ssl.SSLContext | None,
    ready: Callable[[str], None],
    shutdown: Shutdown,
) -> None:
    server = make_server(make(), certificate, lambda: ready(make_url(web, listener)))

    def stop_server() -> None:
        shutdown.start_deadline()
        server.should_exit = True

    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop_server)
    giving_back = asyncio.create_task(_give_back(), name="free memory")
    try:
        await server.serve([listener])
    finally:
        giving_back.cancel()


async def _give_back() -> None:
    """Return free memory regularly: a page of a long history takes 100 MB while it is made."""
    while True:
        await asyncio.sleep(GIVE_BACK_S)
        await asyncio.to_thread(trim_heap)


def make_server(app: FastAPI, certificate: ssl.SSLContext | None, ready: Callable[[], None]) -> uvicorn.Server:
    """Return the server of an application; it calls ``ready`` once it listens."""
    import uvicorn  # late: this module must import without the extra

    from fdhil.connections import MOST_CONNECTIONS, BoundedHttpProtocol, BoundedWebSocketProtocol

    class Server(uvicorn.Server):
        @contextlib.contextmanager
        def capture_signals(self) -> Iterator[None]:
            yield  # uvicorn would end the process by the signal, which systemd reports as a failure

        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            await super().startup(sockets)
            ready()

    settings = uvicorn.Config(
        app,
        log_config=None, log_level="error", access_log=False, server_header=False, proxy_headers=False,
        http=BoundedHttpProtocol, ws=BoundedWebSocketProtocol, ws_max_size=LARGEST_MESSAGE,
        limit_concurrency=MOST_CONNECTIONS, timeout_keep_alive=KEEP_ALIVE_S, timeout_graceful_shutdown=STOP_S,
    )  # fmt: skip
    settings.load()
    settings.ssl = certificate
    return Server(settings)
