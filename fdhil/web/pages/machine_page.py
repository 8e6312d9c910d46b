"""The machine: the daemon's status, the state of the axes, and what to do next."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from fastapi import APIRouter
from pydantic import BaseModel

from fdhil.config import MachineConfig
from fdhil.errors import DeviceError, StoreError
from fdhil.records import ParameterSet
from fdhil.store import History, Revision, report_parameters
from fdhil.web.fault_responses import Fault, make_fault_document
from fdhil.web.pages.machine_state import AxisLight, Light, Step, classify_axis, classify_change, suggest_steps
from fdhil.web.route_context import MachineDependency, PrincipalDependency

router = APIRouter(prefix="/api/machine")
COURSE = 40
START = Step(text="The daemon does not answer.", advice="start it with fdhil run CONFIG, and check its log")


class Machine(BaseModel):
    """The machine now. If the daemon does not answer, ``status`` is null and ``fault`` says why; that is no error."""

    ok: Literal[True] = True
    machine: str
    axes: Mapping[str, AxisLight]
    next: list[Step]
    status: dict[str, Any] | None
    fault: Fault | None = None


class Parameter(BaseModel):
    """A published parameter in SI units: its 95 % interval, its first value, and how far it may change.

    ``course`` are its values in the newest published sets, oldest first.
    """

    value: float
    low: float | None
    high: float | None
    unit: str
    first: float | None
    change: float | None
    limit: float
    light: Light
    course: list[float] = []


class Published(BaseModel):
    """The newest published parameters of an axis."""

    revision: int
    published_wall_s: float
    windows_used: int
    temperature_c: float | None
    unexplained_um: float | None
    parameters: Mapping[str, Parameter]
    warnings: list[str]


class AllPublished(BaseModel):
    """The stored parameters of every axis; ``fault`` if the store cannot be read or does not exist yet."""

    ok: Literal[True] = True
    axes: Mapping[str, Published]
    fault: Fault | None = None


@router.get("")
async def machine(context: MachineDependency, principal: PrincipalDependency) -> Machine:
    """Return the daemon's status document, at most half a second old, and its assessment."""
    try:
        status = await context.daemon.read_status()
    except DeviceError as error:
        fault = Fault.model_validate(make_fault_document(error))
        silent = dict.fromkeys(context.config.axis, AxisLight(light="none", text="unknown: the daemon does not answer"))
        return Machine(machine=context.config.machine.name, axes=silent, next=[START], status=None, fault=fault)
    acting = context.config.web.acting and principal.role == "operate"
    return Machine(
        machine=str(status["machine"]),
        axes=classify_axes(status),
        next=list(suggest_steps(status, acting)),
        status=dict(status),
    )


def classify_axes(status: Mapping[str, Any]) -> dict[str, AxisLight]:
    """Return the state of each axis in a status document."""
    troubles: dict[str, list[str]] = {axis: [] for axis in status["axes"]}
    for trouble in status["troubles"]:
        troubles.get(trouble["axis"], []).append(f"{trouble['code']}: {trouble['text']}")
    return {axis: classify_axis(state, troubles[axis]) for axis, state in status["axes"].items()}


@router.get("/parameters")
def parameters(context: MachineDependency) -> AllPublished:
    """Return the newest published parameters, also while no daemon runs."""
    try:
        with context.open_history() as history:
            found = {axis: _read_published(history, axis, context.config) for axis in context.config.axis}
    except StoreError as error:
        return AllPublished(axes={}, fault=Fault.model_validate(make_fault_document(error)))
    return AllPublished(axes={axis: document for axis, document in found.items() if document is not None})


def _read_published(history: History, axis: str, config: MachineConfig) -> Published | None:
    newest = history.read_revisions(axis, limit=COURSE)
    if not newest:
        return None
    return make_published_document(newest, history.read_first_revision(axis), config)


def make_published_document(revisions: Sequence[Revision], first: Revision | None, config: MachineConfig) -> Published:
    """Return the newest of an axis' revisions (oldest first), compared with its first one."""
    newest = revisions[-1]
    shown: ParameterSet = newest.set
    firsts = first.set.parameters.as_dict() if first else {}
    limits = config.maintenance.model_dump()
    found = {}
    for name, figures in report_parameters(shown).items():
        half = None if figures["high"] is None else figures["high"] - figures["value"]
        change, light = classify_change(figures["value"], half, firsts.get(name), limits[name])
        more = {"first": firsts.get(name), "change": change, "limit": limits[name], "light": light}
        more["course"] = [known[name] for each in revisions if name in (known := each.set.parameters.as_dict())]
        found[name] = Parameter(**{key: figures[key] for key in ("value", "low", "high", "unit")}, **more)
    return Published(
        revision=shown.revision,
        published_wall_s=newest.stamp.wall_s,
        windows_used=shown.windows,
        temperature_c=shown.temperature_c,
        unexplained_um=shown.unexplained_um,
        parameters=found,
        warnings=[str(warning) for warning in shown.warnings],
    )
