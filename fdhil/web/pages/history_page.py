"""The drives' state and parameter trends: over time and temperature, with intervals and limits."""

from collections.abc import Callable
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Request

from fdhil.report import Refusals, read_axes, read_notices
from fdhil.web.fault_responses import RequestRefused
from fdhil.web.pages.parameter_trends import make_axis_document, sort_notices, summarise_axis
from fdhil.web.route_context import MachineContext, MachineDependency

router = APIRouter(prefix="/api/history")
MOST_NOTICES = 8
NEWEST_REVISIONS = 1000
Documents = dict[str | None, tuple[tuple[int, ...], dict[str, Any]]]


async def _get_documents(request: Request) -> Documents:
    state = request.app.state
    if not hasattr(state, "history"):
        state.history = {}
    found: Documents = state.history
    return found


DocumentCache = Annotated[Documents, Depends(_get_documents)]
"""Cached documents by axis (None: all of them), with the newest row numbers that they were made from."""


@router.get("")
def axes(context: MachineDependency, cache: DocumentCache) -> dict[str, Any]:
    """Return the state of each axis in a few words."""
    return _make_if_changed(context, cache, None, lambda: _make_overview(context))


@router.get("/{axis}")
def course(axis: str, context: MachineDependency, cache: DocumentCache) -> dict[str, Any]:
    """Return the history of one axis: its trends, limits, changes, published sets and notices."""
    return _make_if_changed(context, cache, axis, lambda: _make_axis_document(context, axis))


def _make_if_changed(
    context: MachineContext, cache: Documents, about: str | None, make: Callable[[], dict[str, Any]]
) -> dict[str, Any]:
    with context.open_history() as history:
        rows = history.find_newest_row_numbers()
    known = cache.get(about)
    if known is None or known[0] != rows:
        known = rows, make()
        cache[about] = known  # only of existing axes: others are refused in ``make``
    return known[1]


def _make_overview(context: MachineContext) -> dict[str, Any]:
    histories, refused = read_axes(context.config)
    return {"axes": [summarise_axis(history, refused.get(history.axis, Refusals())) for history in histories]}


def _make_axis_document(context: MachineContext, axis: str) -> dict[str, Any]:
    histories, refused = read_axes(context.config, axis, NEWEST_REVISIONS)
    names = [history.axis for history in histories]
    if axis not in names:
        raise RequestRefused(404, "NoSuchAxis", f"there is no axis {axis[:32]!r}", f"use one of {', '.join(names)}")
    history, of_axis = histories[names.index(axis)], refused.get(axis, Refusals())
    notices = sort_notices(read_notices(context.config, axis), MOST_NOTICES)
    return {"axes": names, **make_axis_document(context.config, history, of_axis), "notices": notices}
