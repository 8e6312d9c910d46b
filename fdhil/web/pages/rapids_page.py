"""The recorded rapids: their list, the verdict on each, its signals with the model, its recording."""

import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path as FilePath
from typing import Annotated

from fastapi import APIRouter, Depends, FastAPI, Path, Query
from fastapi.responses import Response
from starlette.requests import HTTPConnection

from fdhil.daemon import WINDOWS_FOLDER
from fdhil.errors import StoreError
from fdhil.store import open_named
from fdhil.web.file_response import FileStreamResponse
from fdhil.web.pages.rapid_list import (
    LARGEST_ID,
    Counts,
    Kept,
    Rapids,
    RapidTold,
    Verdict,
    count_rapids,
    read_rapid_details,
    read_rapid_page,
    read_window,
)
from fdhil.web.pages.rapid_signals import RapidSignals
from fdhil.web.rapid_replayer import RapidReplayer
from fdhil.web.route_context import MachineContext, MachineDependency, PrincipalDependency


@asynccontextmanager
async def _close_replayer_at_end(app: FastAPI) -> AsyncIterator[None]:
    try:
        yield
    finally:
        await find_replayer(app).close()


def find_replayer(app: FastAPI) -> RapidReplayer:
    """Return the replayer of this application."""
    if not hasattr(app.state, "replayer"):
        app.state.replayer = RapidReplayer(app.state.context.config)
    replayer = app.state.replayer
    assert isinstance(replayer, RapidReplayer)
    return replayer


async def _get_replayer(connection: HTTPConnection) -> RapidReplayer:
    return find_replayer(connection.app)


router = APIRouter(prefix="/api/rapids", lifespan=_close_replayer_at_end)
ReplayerDependency = Annotated[RapidReplayer, Depends(_get_replayer)]
LOG = logging.getLogger("fdhil.web")
Axis = Annotated[str, Path(pattern="^[A-Z]2?$")]
Number = Annotated[int, Path(ge=1, le=LARGEST_ID)]
PARQUET = "application/vnd.apache.parquet"


@router.get("")
def rapids(
    context: MachineDependency,
    axis: Annotated[str | None, Query(pattern="^[A-Z]2?$")] = None,
    verdict: Verdict | None = None,
    code: Annotated[str | None, Query(max_length=64)] = None,
    before: Annotated[int | None, Query(ge=1, le=LARGEST_ID)] = None,
    limit: Annotated[int, Query(ge=1, le=200)] = 50,
) -> Rapids:
    """Return the newest rapids, or those ``before`` a number, by axis, verdict and reason."""
    with context.open_history() as history:
        return read_rapid_page(history, _make_file_check(context), axis, verdict, code, before, limit)


@router.get("/counts")
def counts(context: MachineDependency, axis: Annotated[str | None, Query(pattern="^[A-Z]2?$")] = None) -> Counts:
    """Return how many of the newest rapids were accepted, and why the others were refused."""
    with context.open_history() as history:
        return count_rapids(history, context.config.axis, axis)


@router.get("/recordings/{name:path}", response_class=Response)
def recording(context: MachineDependency, principal: PrincipalDependency, name: str) -> Response:
    """Return a recording as its file, for ``fdhil replay`` and ``fdhil export``."""
    try:
        return FileStreamResponse(open_named(_get_windows_folder(context), name), name, PARQUET)
    except StoreError as error:
        if error.code == "BadName":
            LOG.warning("BadName: %a asked for a recording %a", principal.name, name[:200])
        raise


@router.get("/{axis}/{number}")
def rapid(context: MachineDependency, axis: Axis, number: Number) -> RapidTold:
    """Return the stored data of one rapid."""
    with context.open_history() as history:
        return read_rapid_details(history, read_window(history, axis, number), _make_file_check(context))


@router.get("/{axis}/{number}/signals", response_model=RapidSignals)
async def signals(replayer: ReplayerDependency, axis: Axis, number: Number) -> Response:
    """Return a rapid's signals with the model, as replayed now."""
    return Response(await replayer.replay_signals(axis, number), media_type="application/json")


def _get_windows_folder(context: MachineContext) -> FilePath:
    return context.config.store.directory / WINDOWS_FOLDER


def _make_file_check(context: MachineContext) -> Kept:
    folder = _get_windows_folder(context)
    return lambda name: bool(name) and (folder / name).is_file()
