"""Arming from the browser: a plan shows what arming may move, and only that plan is armed. Disarming needs no plan."""

import asyncio
import hashlib
import json
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Request
from pydantic import BaseModel, Field

from fdhil import tables
from fdhil.arming import TOKEN_NAME, find_credential, read_token
from fdhil.config import MachineConfig
from fdhil.daemon import describe_config_difference
from fdhil.web.fault_responses import RequestRefused, require_granted
from fdhil.web.program_folder import NAME, Program, list_programs, read_program
from fdhil.web.request_gate import find_token
from fdhil.web.route_context import MachineContext, MachineDependency, PrincipalDependency

router = APIRouter(prefix="/api/machine")
DISARM_S = 15.0  # the daemon waits for the guard's answer and the ramp
ARM_S = 600.0
FED = ("max_torque_nm", "max_speed_rad_s")
LOOK_S = 0.5  # interval of the check that the browser is still connected
PLAN_ID = r"^[0-9a-f]{64}$"

ProgramName = Annotated[str, Field(pattern=NAME)]
Method = Literal["inverse", "mirror", "flatness"]


class Choice(BaseModel):
    """What can be armed from here: the programs of the configured folder, and the methods."""

    ok: Literal[True] = True
    programs: list[Program]
    methods: list[str]
    feedforward: bool


class AxisReach(BaseModel):
    """The guard's limits for a correction on an axis; null for offsets that it does not send."""

    max_offset_um: float | None
    max_speed_mm_s: float | None
    max_acceleration_mm_s2: float | None
    max_torque_nm: float | None
    max_speed_rad_s: float | None


class Plan(BaseModel):
    """What would be armed and what that may move; ``confirm`` is returned with the request to arm exactly this."""

    ok: Literal[True] = True
    program: Program | None
    method: Method
    axes: Mapping[str, AxisReach]
    state: str
    difference: str
    confirm: str


class Arming(BaseModel):
    """The request to arm a plan."""

    program: ProgramName | None = None
    method: Method = "inverse"
    whole: bool = False
    confirm: Annotated[str, Field(pattern=PLAN_ID)]


class Done(BaseModel):
    """What was done, as reported by the daemon."""

    ok: Literal[True] = True
    text: str
    state: str


@router.get("/programs")
def programs(context: MachineDependency) -> Choice:
    """Return what can be armed from here."""
    folder = context.config.web.programs_directory
    feeds = any(axis.feedforward is not None for axis in context.config.axis.values())
    return Choice(programs=list_programs(folder) if folder else [], methods=list(tables.CORRECTIONS), feedforward=feeds)


@router.get("/plan")
async def plan(
    context: MachineDependency,
    program: Annotated[ProgramName | None, Query()] = None,
    method: Annotated[Method, Query()] = "inverse",
) -> Plan:
    """Return what arming would move. Nothing is done yet."""
    return await _make_plan(context, program, method)


async def _make_plan(context: MachineContext, name: str | None, method: Method) -> Plan:
    """Use the limits of the running daemon, whatever the configuration file contains by now."""
    config = context.config
    if name is None and method != "flatness":
        raise RequestRefused(
            422, "BadRequest", f"the method {method} needs a program, and none was named", "choose a program"
        )
    program = None if name is None else await asyncio.to_thread(read_program, config.web.programs_directory, name)
    status = await context.daemon.read_status()
    axes = _make_axis_limits(status["limits"], feeds=program is None)
    if not axes:
        text = "the configuration allows no offsets on any axis"
        raise RequestRefused(409, "WritingOff", text, "commission a correction as in docs/how-to/commission.md")
    content = [program and program.sha256, method, {axis: reach.model_dump() for axis, reach in axes.items()}]
    confirm = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    state, difference = str(status["state"]), describe_config_difference(status, config.digest)
    return Plan(program=program, method=method, axes=axes, state=state, difference=difference, confirm=confirm)


def _make_axis_limits(limits: Mapping[str, Mapping[str, float | None]], feeds: bool) -> dict[str, AxisReach]:
    return {
        name: AxisReach(**{key: None if (key in FED) is not feeds else value for key, value in values.items()})
        for name, values in limits.items()
        if not feeds or values["max_torque_nm"] is not None
    }


@router.post("/arm")
async def arm(arming: Arming, request: Request, context: MachineDependency, principal: PrincipalDependency) -> Done:
    """Arm the confirmed plan; if the browser disconnects during the check, nothing is armed.

    The daemon's answer is compared with the plan, and disarmed if the program differs.
    """
    shown = await _make_plan(context, arming.program, arming.method)
    if shown.confirm != arming.confirm:
        text = "the program or the limits have changed since they were shown; nothing is armed"
        raise RequestRefused(409, "PlanChanged", text, "check the present plan, and confirm again")
    asked = {
        "request": "arm",
        "program": shown.program and shown.program.path,
        "program_digest": shown.program and shown.program.sha256,
        "method": arming.method,
        "whole": arming.whole,
        "token": await asyncio.to_thread(_read_operator_token, context.config),
        "by": principal.name,
    }
    answer = require_granted(await _ask_while_connected(request, context, asked))
    if shown.program is not None and answer.get("program_digest") != shown.program.sha256:
        await context.daemon.send_request({"request": "disarm", "by": principal.name}, DISARM_S)
        text = "the program was changed while it was armed; it was disarmed again"
        raise RequestRefused(409, "PlanChanged", text, "check the present plan, and confirm again")
    return Done(text=str(answer["text"]), state=str(answer.get("state", "ARMED")))


async def _ask_while_connected(
    request: Request, context: MachineContext, asked: Mapping[str, Any]
) -> Mapping[str, Any]:
    """Wait for the daemon while the browser waits and its user may arm; else the daemon abandons the check."""
    pending = asyncio.ensure_future(context.daemon.send_request(asked, ARM_S, progress=lambda _: None))
    try:
        while not (await asyncio.wait([pending], timeout=LOOK_S))[0]:
            if await request.is_disconnected():
                raise RequestRefused(409, "Abandoned", "the browser disconnected, nothing is armed", "arm again")
            principal = context.access.find_principal(find_token(request.headers))
            if principal is None or principal.role != "operate":
                text = "the login has expired, or the user lost the role operate; nothing is armed"
                raise RequestRefused(401, "AuthRequired", text, "log in again")
        return await pending
    finally:
        pending.cancel()


def _read_operator_token(config: MachineConfig) -> str:
    """Return the operator's token: from systemd, or read as the daemon's own user. DeviceError."""
    given = find_credential(TOKEN_NAME)
    return read_token(given.parent if given else config.run_directory)


@router.post("/disarm")
async def disarm(context: MachineDependency, principal: PrincipalDependency) -> Done:
    """Ramp the correction to zero and wait until zero is read back; what is being prepared is not armed."""
    answer = require_granted(await context.daemon.send_request({"request": "disarm", "by": principal.name}, DISARM_S))
    return Done(text=str(answer["text"]), state=str(answer.get("state", "OFF")))
