"""The drives' state and parameter trends: over time and temperature, with intervals and limits."""

from collections.abc import Callable
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Request

from fdhil.report.history_reading import read_axes, read_notices
from fdhil.report.history_verdict import Refusals
from fdhil.web.answers import Refused
from fdhil.web.context import Context, Here
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


Made = Annotated[Documents, Depends(_documents)]
"""Cached documents by axis (None: all of them), with the newest row numbers that they were made from."""


@router.get("")
def axes(here: Here, made: Made) -> dict[str, Any]:
    """Return the state of each axis in a few words."""
    return _kept(here, made, None, lambda: _overview(here))


@router.get("/{axis}")
def course(axis: str, here: Here, made: Made) -> dict[str, Any]:
    """Return the history of one axis: its trends, limits, changes, published sets and notices."""
    return _kept(here, made, axis, lambda: _of_axis(here, axis))


def _kept(here: Context, made: Documents, about: str | None, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    with here.history() as history:
        rows = history.newest_rows()
    known = made.get(about)
    if known is None or known[0] != rows:
        known = rows, make()
        made[about] = known  # only of existing axes: others are refused in ``make``
    return known[1]


def _overview(here: Context) -> dict[str, Any]:
    histories, refused = read_axes(here.config)
    return {"axes": [axis_line(history, refused.get(history.axis, Refusals())) for history in histories]}


def _of_axis(here: Context, axis: str) -> dict[str, Any]:
    histories, refused = read_axes(here.config, axis, NEWEST_REVISIONS)
    names = [history.axis for history in histories]
    if axis not in names:
        raise Refused(404, "NoSuchAxis", f"there is no axis {axis[:32]!r}", f"use one of {', '.join(names)}")
    history, of_axis = histories[names.index(axis)], refused.get(axis, Refusals())
    notices = newest_first(read_notices(here.config, axis), MOST_NOTICES)
    return {"axes": names, **axis_document(here.config, history, of_axis), "notices": notices}
