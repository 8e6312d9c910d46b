"""The drives' state and parameter trends: over time and temperature, with intervals and limits."""

from collections.abc import Callable
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Request

from fdhil.report.condition_summary import Refusals
from fdhil.report.history_reader import read_axes, read_notices
from fdhil.web.answers import Refused
from fdhil.web.context import Context, MachineDependency
from fdhil.web.pages.history_courses import axis_document, axis_line, newest_first

router = APIRouter(prefix="/api/history")
MOST_NOTICES = 8
NEWEST_REVISIONS = 1000
Documents = dict[str | None, tuple[tuple[int, ...], dict[str, Any]]]


async def _documents(request: Request) -> Documents:
    state = request.app.state
    if not hasattr(state, "history"):
        state.history = {}
    found: Documents = state.history
    return found


DocumentCache = Annotated[Documents, Depends(_documents)]
"""Cached documents by axis (None: all of them), with the newest row numbers that they were made from."""


@router.get("")
def axes(context: MachineDependency, cache: DocumentCache) -> dict[str, Any]:
    """Return the state of each axis in a few words."""
    return _kept(context, cache, None, lambda: _overview(context))


@router.get("/{axis}")
def course(axis: str, context: MachineDependency, cache: DocumentCache) -> dict[str, Any]:
    """Return the history of one axis: its trends, limits, changes, published sets and notices."""
    return _kept(context, cache, axis, lambda: _of_axis(context, axis))


def _kept(context: Context, cache: Documents, about: str | None, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    with context.history() as history:
        rows = history.newest_rows()
    known = cache.get(about)
    if known is None or known[0] != rows:
        known = rows, make()
        cache[about] = known  # only of existing axes: others are refused in ``make``
    return known[1]


def _overview(context: Context) -> dict[str, Any]:
    histories, refused = read_axes(context.config)
    return {"axes": [axis_line(history, refused.get(history.axis, Refusals())) for history in histories]}


def _of_axis(context: Context, axis: str) -> dict[str, Any]:
    histories, refused = read_axes(context.config, axis, NEWEST_REVISIONS)
    names = [history.axis for history in histories]
    if axis not in names:
        raise Refused(404, "NoSuchAxis", f"there is no axis {axis[:32]!r}", f"use one of {', '.join(names)}")
    history, of_axis = histories[names.index(axis)], refused.get(axis, Refusals())
    notices = newest_first(read_notices(context.config, axis), MOST_NOTICES)
    return {"axes": names, **axis_document(context.config, history, of_axis), "notices": notices}
