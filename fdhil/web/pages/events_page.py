"""Alarms with cause, effect and next action, their acknowledgements, and the black boxes."""

from typing import Annotated

from fastapi import APIRouter, Query
from fastapi.responses import Response
from pydantic import BaseModel, Field

from fdhil.daemon import MOST_NOTE
from fdhil.store import RECENT_NOTICES
from fdhil.web.fault_responses import require_granted
from fdhil.web.file_response import FileStreamResponse
from fdhil.web.pages.black_boxes import BlackBox, Envelope, make_envelope, open_black_box, summarise_black_boxes
from fdhil.web.pages.event_list import MOST_PAGE, Events, Severity, make_event_page
from fdhil.web.route_context import MachineDependency, PrincipalDependency

router = APIRouter(prefix="/api/events")
LARGEST_NUMBER = 2**53 - 1
Number = Annotated[int, Field(ge=1, le=LARGEST_NUMBER)]


class Acknowledgement(BaseModel):
    """The notices to acknowledge: by their numbers, or all unacknowledged ones up to a number."""

    notices: Annotated[list[Number], Field(max_length=1000)] | None = None
    up_to: Number | None = None
    note: Annotated[str, Field(max_length=MOST_NOTE)] = ""


class Done(BaseModel):
    """What was acknowledged, as text and by number."""

    ok: bool
    text: str
    acknowledged: list[int]


@router.get("")
def events(
    context: MachineDependency,
    axis: Annotated[str | None, Query(max_length=32)] = None,
    code: Annotated[str | None, Query(max_length=64)] = None,
    severity: Severity | None = None,
    before: Annotated[int | None, Query(ge=1, le=LARGEST_NUMBER)] = None,
    limit: Annotated[int, Query(ge=1, le=MOST_PAGE)] = 50,
) -> Events:
    """Return the newest notices, the unacknowledged ones first."""
    with context.open_history() as history:
        notices = history.read_notices(limit=RECENT_NOTICES)
    return make_event_page(notices, limit=limit, before=before, axis=axis, code=code, severity=severity)


@router.post("/acknowledge")
async def acknowledge(wanted: Acknowledgement, context: MachineDependency, principal: PrincipalDependency) -> Done:
    """Acknowledge notices; the daemon stores the user and the time."""
    request = {"request": "acknowledge", **wanted.model_dump(exclude_none=True), "by": principal.name}
    return Done.model_validate(require_granted(await context.daemon.send_request(request)))


@router.get("/black-boxes")
def black_boxes(context: MachineDependency) -> list[BlackBox]:
    """Return the stored black boxes, newest first."""
    return summarise_black_boxes(context.config.store.directory)


@router.get("/black-boxes/{name}")
def black_box(name: str, context: MachineDependency) -> Envelope:
    """Return the envelope of the drives' signals in a black box."""
    return make_envelope(context.config.store.directory, name, context.config)


@router.get("/black-boxes/{name}/file", response_class=Response)
def black_box_file(name: str, context: MachineDependency) -> Response:
    """Return a black box as a file: a log for candump's tools."""
    return FileStreamResponse(
        open_black_box(context.config.store.directory, name), name, "text/plain; charset=us-ascii"
    )
