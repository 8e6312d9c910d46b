"""The recorded rapids: their list, the verdict on each, its signals with the model, its recording."""

import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path as FilePath
from typing import Annotated

from fastapi import APIRouter, Depends, FastAPI, Path, Query
from fastapi.responses import Response
from starlette.requests import HTTPConnection

from fdhil.daemon.outcome_store import WINDOWS_FOLDER
from fdhil.errors import StoreError
from fdhil.store.named_file import open_named
from fdhil.web.context import Context, MachineDependency, PrincipalDependency
from fdhil.web.file_answer import FileAnswer
from fdhil.web.pages.rapid_list import (
    LARGEST_ID,
    Counts,
    Kept,
    Rapids,
    RapidTold,
    Verdict,
    counts_of,
    page_of,
    the_window,
    told_of,
)
from fdhil.web.pages.rapid_signals import RapidSignals
from fdhil.web.replayer import Replayer


@asynccontextmanager
async def _replaying(app: FastAPI) -> AsyncIterator[None]:
    try:
        yield
    finally:
        await replayer_of(app).close()


def replayer_of(app: FastAPI) -> Replayer:
    """Return the replayer of this application."""
    if not hasattr(app.state, "replayer"):
        app.state.replayer = Replayer(app.state.context.config)
    replayer = app.state.replayer
    assert isinstance(replayer, Replayer)
    return replayer


async def _replayer(connection: HTTPConnection) -> Replayer:
    return replayer_of(connection.app)


router = APIRouter(prefix="/api/rapids", lifespan=_replaying)
ReplayerDependency = Annotated[Replayer, Depends(_replayer)]
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
    with context.history() as history:
        return page_of(history, _kept(context), axis, verdict, code, before, limit)


@router.get("/counts")
def counts(context: MachineDependency, axis: Annotated[str | None, Query(pattern="^[A-Z]2?$")] = None) -> Counts:
    """Return how many of the newest rapids were accepted, and why the others were refused."""
    with context.history() as history:
        return counts_of(history, context.config.axis, axis)


@router.get("/recordings/{name:path}", response_class=Response)
def recording(context: MachineDependency, principal: PrincipalDependency, name: str) -> Response:
    """Return a recording as its file, for ``fdhil replay`` and ``fdhil export``."""
    try:
        return FileAnswer(open_named(_folder(context), name), name, PARQUET)
    except StoreError as error:
        if error.code == "BadName":
            LOG.warning("BadName: %a asked for a recording %a", principal.name, name[:200])
        raise


@router.get("/{axis}/{number}")
def rapid(context: MachineDependency, axis: Axis, number: Number) -> RapidTold:
    """Return the stored data of one rapid."""
    with context.history() as history:
        return told_of(history, the_window(history, axis, number), _kept(context))


@router.get("/{axis}/{number}/signals", response_model=RapidSignals)
async def signals(replayer: ReplayerDependency, axis: Axis, number: Number) -> Response:
    """Return a rapid's signals with the model, as replayed now."""
    return Response(await replayer.signals(axis, number), media_type="application/json")


def _folder(context: Context) -> FilePath:
    return context.config.store.directory / WINDOWS_FOLDER


def _kept(context: Context) -> Kept:
    folder = _folder(context)
    return lambda name: bool(name) and (folder / name).is_file()
