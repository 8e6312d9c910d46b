"""Builds the web application behind the request gate, for one machine or for many."""

import logging
import pkgutil
from collections.abc import Iterable, Iterator
from importlib import import_module
from importlib.resources import as_file, files
from pathlib import Path
from string import Template
from typing import Any

from fastapi import APIRouter, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, Response
from fastapi.staticfiles import StaticFiles
from starlette.exceptions import HTTPException
from starlette.middleware.gzip import GZipMiddleware

from fdhil.arming import make_refusal
from fdhil.config import MachineConfig, Web
from fdhil.daemon import SOCKET_NAME
from fdhil.errors import FdhilError
from fdhil.web import pages
from fdhil.web.daemon_client import DaemonClient
from fdhil.web.fault_responses import Fault, RequestRefused, find_http_status, make_fault_document
from fdhil.web.json_response import SafeJsonResponse
from fdhil.web.login import LoginManager
from fdhil.web.request_gate import RequestGate
from fdhil.web.route_context import LoginContext, MachineContext

MENU = ("machine", "live", "rapids", "history", "program", "events")
SHELL = (*MENU, "panel")
"""The first parts of the paths of the browser's router."""
PACKED_FROM, PACKING = 4096, 4  # bytes, level: helps slow networks; no token is in responses of this size
STATIC = Path(__file__).parent / "static"
FAULTS: dict[int | str, dict[str, Any]] = {
    status: {"model": Fault, "description": what}
    for status, what in {
        400: "bad request", 401: "no login", 403: "not allowed", 404: "not found", 405: "method not allowed",
        408: "too slow", 409: "refused in the machine's state", 413: "too large",
        421: "unknown host name", 422: "invalid value", 429: "too many requests", 500: "internal error",
        503: "daemon or store unavailable",
        504: "no answer from the daemon",
    }.items()
}  # fmt: skip


def make_app(config: MachineConfig) -> FastAPI:
    """Return the application of one machine. Raises ConfigError if its users file is faulty."""
    app = make_application(config.web, find_page_routers(), MENU, SHELL, "fdhil status CONFIG")
    app.state.context = MachineContext(config, DaemonClient(config.run_directory / SOCKET_NAME), app.state.entry.access)
    return app


def make_application(
    web: Web, routers: Iterable[APIRouter], menu: Iterable[str], paths: Iterable[str], command: str
) -> FastAPI:
    """Return an application behind the gate. Raises ConfigError as above.

    ``paths`` are the first parts of those of the browser's router, ``menu`` its pages; ``command`` is the alternative
    shown if the browser runs no scripts.
    """
    access = LoginManager(web.users_file)
    app = FastAPI(
        title="fdhil", docs_url=None, redoc_url=None, openapi_url=None, redirect_slashes=False,
        default_response_class=SafeJsonResponse,
    )  # fmt: skip
    app.state.entry = LoginContext(web, access)
    for router in routers:
        app.include_router(router, responses=FAULTS)
    app.add_api_route("/api/openapi.json", lambda: app.openapi(), include_in_schema=False)
    document = Template((STATIC / "shell.html").read_text("utf-8"))
    _serve_shell(app, document.substitute(menu=" ".join(menu), command=command), paths)
    _answer_faults(app)
    app.add_middleware(GZipMiddleware, minimum_size=PACKED_FROM, compresslevel=PACKING)
    app.add_middleware(RequestGate, settings=web, access=access)
    return app


def find_page_routers() -> Iterator[APIRouter]:
    """Yield the router of every page: each file of the folder is one."""
    for found in pkgutil.iter_modules(pages.__path__):
        router = getattr(import_module(f"{pages.__name__}.{found.name}"), "router", None)
        if isinstance(router, APIRouter):
            yield router


def _serve_shell(app: FastAPI, document: str, paths: Iterable[str]) -> None:
    async def answer_shell() -> Response:
        return HTMLResponse(document)

    app.add_api_route("/", answer_shell, include_in_schema=False, response_class=Response)
    for name in paths:
        for path in (f"/{name}", f"/{name}/{{rest:path}}"):
            app.add_api_route(path, answer_shell, include_in_schema=False, response_class=Response)
    with as_file(files("fdhil.report") / "uplot") as uplot:
        app.mount("/static/uplot", StaticFiles(directory=uplot))
    app.mount("/static", StaticFiles(directory=STATIC))


def _answer_faults(app: FastAPI) -> None:
    """Answer every fault with one kind of document, and never with a traceback.

    All handlers are coroutines, as in ``fdhil.web.route_context``: a refused disarm must not wait for a thread either.
    """

    @app.exception_handler(RequestRefused)
    async def answer_refusal(_request: Request, error: RequestRefused) -> SafeJsonResponse:
        return SafeJsonResponse(error.document, error.status)

    @app.exception_handler(FdhilError)
    async def answer_error(_request: Request, error: FdhilError) -> SafeJsonResponse:
        return SafeJsonResponse(make_fault_document(error), find_http_status(error))

    @app.exception_handler(RequestValidationError)
    async def answer_invalid_request(_request: Request, error: RequestValidationError) -> SafeJsonResponse:
        faults = "; ".join(f"{'.'.join(map(str, fault['loc'][1:]))}: {fault['msg']}" for fault in error.errors()[:5])
        return SafeJsonResponse(make_refusal("BadRequest", faults, "correct the listed values"), 422)

    @app.exception_handler(HTTPException)
    async def answer_http_error(_request: Request, error: HTTPException) -> SafeJsonResponse:
        if isinstance(error.__cause__, RequestRefused):  # the body exceeded its limit while it was read
            return await answer_refusal(_request, error.__cause__)
        code = {404: "NotFound", 405: "NoSuchMethod"}.get(error.status_code, "BadRequest")
        text = {404: "there is nothing at this address", 405: "this address does not support the method"}
        faults = make_refusal(code, text.get(error.status_code, str(error.detail)), "see /api/openapi.json")
        return SafeJsonResponse(faults, error.status_code, headers=error.headers)

    @app.exception_handler(Exception)
    async def answer_internal_error(request: Request, error: Exception) -> SafeJsonResponse:
        logging.getLogger("fdhil.web").error("%s %s failed", request.method, request.url.path, exc_info=error)
        text = "fdhil web had an internal error; the machine and the daemon are not affected"
        return SafeJsonResponse(make_refusal("InternalError", text, "report it with the log of fdhil web"), 500)
