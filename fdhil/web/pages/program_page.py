"""Programs before machining: their path error without and with correction, and what their passes taught.

A dropped program is forecast in a child process. Nothing context reaches the machine.
"""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from itertools import islice
from typing import Annotated, Any

from fastapi import APIRouter, Depends, FastAPI, Path, Query, Request
from pydantic import BaseModel
from starlette.requests import HTTPConnection

from fdhil.errors import ConnectError, DeviceTimeout, StoreError
from fdhil.store import RECENT_NOTICES
from fdhil.web.fault_responses import RequestRefused
from fdhil.web.forecast.forecast_queue import STATES, ForecastJob, ForecastQueue, ForecastTask
from fdhil.web.forecast.path_view import ViewBox, find_plane, locate_line, make_error_curve, make_view
from fdhil.web.forecast.program_passes import list_learning_curves, list_measured_passes, parse_stored_passes
from fdhil.web.json_response import SafeJsonResponse
from fdhil.web.program_folder import NAME, read_content
from fdhil.web.request_gate import LARGEST_PROGRAM
from fdhil.web.route_context import MachineDependency

LARGEST_MM = 1e7
MOST_LINES = 400
MOST_JOBS = 100
LONGEST_LINE = 400


class Fault(BaseModel):
    """Why there is no forecast; ``line`` is the program line at fault, if there is one."""

    code: str
    text: str
    advice: str
    line: int | None


class Advice(BaseModel):
    """The feeds that keep a tolerance, and their progress: ``lines`` as in ``fdhil advise --json``."""

    tolerance_um: float
    state: STATES
    trial: int | None
    fault: Fault | None
    lines: list[dict[str, Any]]


class Told(BaseModel):
    """A program and the progress of its forecast; ``forecast`` as in ``fdhil correct --json``, plus map data."""

    digest: str
    name: str
    state: STATES
    step: str | None
    rows: int | None
    fault: Fault | None
    forecast: dict[str, Any] | None
    advice: Advice | None


class Kept(BaseModel):
    """A kept program."""

    digest: str
    name: str
    state: STATES


class Programs(BaseModel):
    """The kept programs, the newest first, and the largest allowed size."""

    programs: list[Kept]
    largest_bytes: int


class Learning(BaseModel):
    """The learning curves of programs, and the passes that the running daemon measured, oldest first."""

    daemon: bool
    learning: bool
    lessons: list[dict[str, Any]]
    passes: list[dict[str, Any]]


class Jobs(BaseModel):
    """The newest stored passes of corrected programs, newest first."""

    jobs: list[dict[str, Any]]


class Line(BaseModel):
    """One line of a program's text."""

    line: int
    text: str


class Text(BaseModel):
    """Lines of a program's text, and whether more follow."""

    lines: list[Line]
    more: bool


@asynccontextmanager
async def _close_queue_at_end(app: FastAPI) -> AsyncIterator[None]:
    yield
    queue = getattr(app.state, "programs", None)
    if queue is not None:
        await queue.close()


router = APIRouter(prefix="/api/program", lifespan=_close_queue_at_end)


async def _get_queue(connection: HTTPConnection, context: MachineDependency) -> ForecastQueue:
    state = connection.app.state
    if getattr(state, "programs", None) is None:
        state.programs = ForecastQueue(context.config)
    queue = state.programs
    assert isinstance(queue, ForecastQueue)
    return queue


QueueDependency = Annotated[ForecastQueue, Depends(_get_queue)]
Digest = Annotated[str, Path(pattern="^[0-9a-f]{64}$", description="SHA-256 of the program's bytes")]
Mm = Annotated[float, Query(ge=-LARGEST_MM, le=LARGEST_MM, allow_inf_nan=False)]
BODY = {"requestBody": {"content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}}}


@router.get("")
async def programs(queue: QueueDependency) -> Programs:
    """List the kept programs."""
    listed = [Kept(digest=job.digest, name=job.name, state=job.forecasting.state) for job in queue.jobs]
    return Programs(programs=listed, largest_bytes=LARGEST_PROGRAM)


@router.post("", status_code=202, openapi_extra=BODY)
async def drop(
    request: Request, queue: QueueDependency, name: Annotated[str, Query(min_length=1, max_length=255)]
) -> Told:
    """Store an NC program, or a demand if ``name`` ends in .csv, from the body's bytes, and have it forecast."""
    return _make_program_forecast(await queue.add_program(name, request.stream()))


@router.post("/named", status_code=202)
async def take_named(
    context: MachineDependency, queue: QueueDependency, name: Annotated[str, Query(pattern=NAME)]
) -> Told:
    """Have a program of the folder of programs forecast."""
    content = await asyncio.to_thread(read_content, context.config.web.programs_directory, name, LARGEST_PROGRAM)
    return _make_program_forecast(await queue.add_program(name, _yield_once(content)))


async def _yield_once(content: bytes) -> AsyncIterator[bytes]:
    yield content


@router.get("/jobs")
def finished_jobs(context: MachineDependency) -> Jobs:
    """Return the passes of corrected programs with predicted and measured errors; none without a history."""
    try:
        with context.open_history() as history:
            found = list(parse_stored_passes(history.read_notices(limit=RECENT_NOTICES)))
    except StoreError:
        found = []
    return Jobs(jobs=found[::-1][:MOST_JOBS])


@router.get("/learning")
async def learning(context: MachineDependency, queue: QueueDependency) -> Learning:
    """Return what was learned in the passes of programs."""
    try:
        status = await context.daemon.read_status()
    except (ConnectError, DeviceTimeout):
        status = None
    measured = list_measured_passes(status)
    names = {str(each["program_digest"]): str(each["program"]).rpartition("/")[2] for each in measured}
    names |= {job.digest: job.name for job in queue.jobs}
    config = context.config
    return Learning(
        daemon=status is not None,
        learning=config.correction.learning,
        lessons=list_learning_curves(config, names),
        passes=[dict(each) for each in measured],
    )


@router.get("/{digest}")
async def program(digest: Digest, queue: QueueDependency) -> Told:
    """Return the progress of a forecast, and its results for the whole program."""
    return _make_program_forecast(queue.get_job(digest))


@router.post("/{digest}/cancel")
async def cancel(digest: Digest, queue: QueueDependency) -> Told:
    """Cancel a running forecast."""
    return _make_program_forecast(await queue.cancel_job(digest))


@router.post("/{digest}/advise", status_code=202)
async def feeds(
    digest: Digest, queue: QueueDependency, tolerance_um: Annotated[float, Query(gt=0.0, le=1e6, allow_inf_nan=False)]
) -> Told:
    """Compute the feeds that keep the path within a tolerance, as ``fdhil advise`` does."""
    return _make_program_forecast(queue.request_advice(digest, tolerance_um))


@router.get("/{digest}/view")
def part(
    digest: Digest,
    queue: QueueDependency,
    across: Annotated[str, Query(max_length=16)],
    along: Annotated[str, Query(max_length=16)],
    left: Mm | None = None,
    right: Mm | None = None,
    bottom: Mm | None = None,
    top: Mm | None = None,
    factor: Annotated[float, Query(ge=0.0, le=10_000.0, allow_inf_nan=False)] = 0.0,
) -> SafeJsonResponse:
    """Return the path in the plane of two axes: all of it, or inside a box (mm) with the predicted table path.

    ``factor`` enlarges the table's distance from the path; 0: as far as the view has room.
    """
    forecast = queue.get_forecast(digest)
    try:
        plane = find_plane(forecast, (across, along))
    except ValueError:
        listed = ", ".join(forecast.axes)
        raise RequestRefused(422, "BadRequest", "the program has no such plane", f"its axes are {listed}") from None
    box = None
    if left is not None and right is not None and bottom is not None and top is not None:
        box = ViewBox(left, right, bottom, top)
        if not (left < right and bottom < top):
            raise RequestRefused(422, "BadRequest", "the box is empty", "give left < right and bottom < top")
    return SafeJsonResponse(make_view(forecast, plane, box, factor))


@router.get("/{digest}/course")
def over_time(
    digest: Digest,
    queue: QueueDependency,
    start_s: Annotated[float, Query(ge=0.0, allow_inf_nan=False)] = 0.0,
    end_s: Annotated[float | None, Query(ge=0.0, allow_inf_nan=False)] = None,
) -> SafeJsonResponse:
    """Return contour errors and feed over time."""
    forecast = queue.get_forecast(digest)
    rows = len(forecast.line)
    first = min(int(min(start_s / forecast.dt_s, rows)), rows - 1)
    last = rows if end_s is None else int(min(end_s / forecast.dt_s, rows))
    return SafeJsonResponse(make_error_curve(forecast, first, max(last, first + 1)))


@router.get("/{digest}/line/{line}")
def place_of_line(
    digest: Digest, line: Annotated[int, Path(ge=1, le=10**9)], queue: QueueDependency
) -> SafeJsonResponse:
    """Return where a program line has its largest error."""
    found = locate_line(queue.get_forecast(digest), line)
    if found is None:
        raise RequestRefused(
            404, "NotFound", f"line {line} of the program orders no motion", "choose a line that moves"
        )
    return SafeJsonResponse(found)


@router.get("/{digest}/text")
def text(
    digest: Digest,
    queue: QueueDependency,
    first: Annotated[int, Query(ge=1, le=10**9)] = 1,
    count: Annotated[int, Query(ge=1, le=MOST_LINES)] = 40,
) -> Text:
    """Return lines of the program's text."""
    job = queue.get_job(digest)
    try:
        with job.program.open(encoding="utf-8", errors="replace", newline="\n") as file:
            found = list(islice(file, first - 1, first + count))
    except OSError:
        raise RequestRefused(404, "NotFound", "the text is not stored (any more)", "drop the file again") from None
    lines = [Line(line=first + k, text=_clean_line(each)) for k, each in enumerate(found[:count])]
    return Text(lines=lines, more=len(found) > count)


def _clean_line(line: str) -> str:
    printable = "".join(letter if letter.isprintable() else " " for letter in line.rstrip("\r\n")[:LONGEST_LINE])
    return printable + ("..." if len(line) > LONGEST_LINE + 2 else "")


def _make_program_forecast(job: ForecastJob) -> Told:
    forecasting, advising = job.forecasting, job.advising
    advice = advising and Advice(
        tolerance_um=advising.tolerance_um or 0.0,
        state=advising.state,
        trial=advising.progress.get("trial"),
        fault=_make_fault(advising),
        lines=job.advice if advising.state == "done" else [],
    )
    return Told(
        digest=job.digest,
        name=job.name,
        state=forecasting.state,
        step=forecasting.progress.get("step"),
        rows=forecasting.progress.get("rows"),
        fault=_make_fault(forecasting),
        forecast=None if job.forecast is None else job.forecast.document,
        advice=advice,
    )


def _make_fault(work: ForecastTask) -> Fault | None:
    return None if work.fault is None else Fault.model_validate(work.fault)
