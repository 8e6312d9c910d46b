"""Serves metrics to Prometheus over HTTP: GET /metrics only, for the hosts that the config allows."""

import asyncio
import contextlib
import socket
import ssl
from collections.abc import Awaitable, Callable, Iterator, Mapping
from typing import Any

import uvicorn
from prometheus_client import CollectorRegistry
from prometheus_client.exposition import choose_encoder

from fdhil.config import MachineConfig, PrometheusMetrics
from fdhil.connections import BoundedHttpProtocol
from fdhil.errors import ConnectError
from fdhil.shopfloor.prometheus_metrics import MetricsCollector
from fdhil.shopfloor.publisher_process import report_ready
from fdhil.shopfloor.status_poller import poll_status

LOOPBACK = ("localhost", "127.0.0.1", "::1")
MOST_CONNECTIONS = 32
Send = Callable[[Mapping[str, Any]], Awaitable[None]]


class MetricsPage:
    """The metrics page, an ASGI application."""

    def __init__(self, metrics: MetricsCollector, hosts: tuple[str, ...]) -> None:
        self._registry = CollectorRegistry(auto_describe=False)
        self._registry.register(metrics)
        self._hosts = {host.lower() for host in hosts}

    async def __call__(self, scope: Mapping[str, Any], receive: Callable[[], Awaitable[Any]], send: Send) -> None:
        """Answer one request."""
        status, kind, body = self._answer_request(scope)
        headers = [(b"content-type", kind.encode()), (b"cache-control", b"no-store")]
        await send({"type": "http.response.start", "status": status, "headers": headers})
        await send({"type": "http.response.body", "body": b"" if scope["method"] == "HEAD" else body})

    def _answer_request(self, scope: Mapping[str, Any]) -> tuple[int, str, bytes]:
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        if _parse_host_name(headers.get("host", "")) not in self._hosts:
            return 421, "text/plain", b"this host is not in [publish.prometheus] allowed_hosts\n"
        if scope["path"] != "/metrics":
            return 404, "text/plain", b"the metrics are at /metrics\n"
        if scope["method"] not in ("GET", "HEAD"):
            return 405, "text/plain", b"the metrics are read-only\n"
        encode, kind = choose_encoder(headers.get("accept", ""))
        return 200, kind, encode(self._registry)


def _parse_host_name(host: str) -> str:
    if host.startswith("["):
        return host[1:].partition("]")[0].lower()
    return host.partition(":")[0].lower()


class _Server(uvicorn.Server):
    """Leaves signals to the process around it."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


async def publish(config: MachineConfig) -> None:
    """Serve until it is cancelled; ConnectError where it cannot listen."""
    settings, metrics = config.publish.prometheus, MetricsCollector()
    server = _Server(
        _configure_server(settings, MetricsPage(metrics, (*LOOPBACK, settings.host, *settings.allowed_hosts)))
    )
    with _open_listener(settings) as listener:
        serving = asyncio.create_task(server.serve(sockets=[listener]))
        try:
            scheme = "https" if settings.tls_certificate_file else "http"
            host = f"[{settings.host}]" if ":" in settings.host else settings.host
            report_ready(f"metrics for Prometheus at {scheme}://{host}:{listener.getsockname()[1]}/metrics")
            async for news in poll_status(config, settings.period_s):
                metrics.take_update(news)
                if serving.done():
                    raise ConnectError("metrics", "the server stopped unexpectedly; start it again")
        finally:
            server.should_exit = True
            await serving


def _configure_server(settings: PrometheusMetrics, page: MetricsPage) -> uvicorn.Config:
    """Return the server's settings; ConnectError with the TLS file that cannot be used."""
    client_ca = settings.tls_client_ca_file
    configured = uvicorn.Config(
        page,
        lifespan="off",
        http=BoundedHttpProtocol,
        ws="none",
        log_config=None,
        log_level="error",
        access_log=False,
        server_header=False,
        limit_concurrency=MOST_CONNECTIONS,
        backlog=MOST_CONNECTIONS,  # bounds descriptors, too
        timeout_graceful_shutdown=2,
        ssl_certfile=settings.tls_certificate_file,
        ssl_keyfile=settings.tls_key_file,
        ssl_ca_certs=str(client_ca) if client_ca else None,
        ssl_cert_reqs=ssl.CERT_REQUIRED if client_ca else ssl.CERT_NONE,
    )
    try:
        configured.load()
    except OSError as error:  # also SSLError
        text = f"the TLS files cannot be used ({error.strerror or error}); check [publish.prometheus] tls_..._file"
        raise ConnectError("metrics", f"{text}, which this user must be able to read") from None
    return configured


def _open_listener(settings: PrometheusMetrics) -> socket.socket:
    try:
        family = socket.getaddrinfo(settings.host, settings.port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((settings.host, settings.port), family=family)
    except OSError as error:
        text = f"cannot listen at {settings.host}:{settings.port}: {error.strerror or error}"
        raise ConnectError("metrics", f"{text}; set another [publish.prometheus] host or port") from None
