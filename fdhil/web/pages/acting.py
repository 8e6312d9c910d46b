"""Acting: what arming would move is told first, and only what was told is armed. To disarm asks nothing."""

import asyncio
import hashlib
import json
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Request
from pydantic import BaseModel, Field

from fdhil import tables
from fdhil.arming.token import TOKEN_NAME, given_credential, read_token
from fdhil.config import MachineConfig
from fdhil.daemon.status import config_difference
from fdhil.web.answers import Refused, granted
from fdhil.web.context import Asking, Context, Here
from fdhil.web.gate import token_of
from fdhil.web.programs import NAME, Program, listed, look_at

router = APIRouter(prefix="/api/machine")
DISARM_S = 15.0  # the daemon waits for the guard's answer and for the ramp
ARM_S = 600.0
FED = ("max_torque_nm", "max_speed_rad_s")
LOOK_S = 0.5  # whether the browser that asked is still there
PLAN_ID = r"^[0-9a-f]{64}$"

ProgramName = Annotated[str, Field(pattern=NAME)]
Method = Literal["inverse", "mirror", "flatness"]


class Choice(BaseModel):
    """What may be armed from here: the programs of the folder that the configuration names, and the methods."""

    ok: Literal[True] = True
    programs: list[Program]
    methods: list[str]
    feedforward: bool


class AxisReach(BaseModel):
    """How far the guard lets a correction go on an axis; null where it sends nothing of that kind."""

    max_offset_um: float | None
    max_speed_mm_s: float | None
    max_acceleration_mm_s2: float | None
    max_torque_nm: float | None
    max_speed_rad_s: float | None


class Plan(BaseModel):
    """What would be armed and what that may move; ``confirm`` goes back with the request, so that nothing else is."""

    ok: Literal[True] = True
    program: Program | None
    method: Method
    axes: Mapping[str, AxisReach]
    state: str
    difference: str
    confirm: str


class Arming(BaseModel):
    """The request to arm what a plan told."""

    program: ProgramName | None = None
    method: Method = "inverse"
    whole: bool = False
    confirm: Annotated[str, Field(pattern=PLAN_ID)]


class Done(BaseModel):
    """What was done, in the daemon's words."""

    ok: Literal[True] = True
    text: str
    state: str


@router.get("/programs")
def programs(here: Here) -> Choice:
    """Tell what may be armed from here."""
    folder = here.config.web.programs_directory
    feeds = any(axis.feedforward is not None for axis in here.config.axis.values())
    return Choice(programs=listed(folder) if folder else [], methods=list(tables.CORRECTIONS), feedforward=feeds)


@router.get("/plan")
async def plan(
    here: Here, program: Annotated[ProgramName | None, Query()] = None, method: Annotated[Method, Query()] = "inverse"
) -> Plan:
    """Tell what arming would move. Nothing is done yet."""
    return await _plan(here, program, method)


async def _plan(here: Context, name: str | None, method: Method) -> Plan:
    config = here.config
    if name is None and method != "flatness":
        raise Refused(422, "BadRequest", f"the method {method} corrects a program, and none is named", "choose one")
    program = None if name is None else await asyncio.to_thread(look_at, config.web.programs_directory, name)
    status = await here.daemon.status()
    axes = _reaches(status["limits"], feeds=program is None)
    if not axes:
        text = "the configuration lets nothing be sent to any axis"
        raise Refused(409, "WritingOff", text, "see how a correction is commissioned in docs/how-to/commission.md")
    told = [program and program.sha256, method, {axis: reach.model_dump() for axis, reach in axes.items()}]
    confirm = hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()
    state, difference = str(status["state"]), config_difference(status, config.digest)
    return Plan(program=program, method=method, axes=axes, state=state, difference=difference, confirm=confirm)


def _reaches(limits: Mapping[str, Mapping[str, float | None]], feeds: bool) -> dict[str, AxisReach]:
    return {
        name: AxisReach(**{key: None if (key in FED) is not feeds else value for key, value in told.items()})
        for name, told in limits.items()
        if not feeds or told["max_torque_nm"] is not None
    }


@router.post("/arm")
async def arm(arming: Arming, request: Request, here: Here, asking: Asking) -> Done:
    """Arm what was confirmed; a browser that goes away while a program is checked has nothing armed.

    What the daemon then says it has armed is compared with what was shown, and disarmed where it differs.
    """
    shown = await _plan(here, arming.program, arming.method)
    if shown.confirm != arming.confirm:
        text = "the program or the limits are not those that were shown; nothing is armed"
        raise Refused(409, "PlanChanged", text, "look at what is shown now, and confirm again")
    asked = {
        "request": "arm",
        "program": shown.program and shown.program.path,
        "program_digest": shown.program and shown.program.sha256,
        "method": arming.method,
        "whole": arming.whole,
        "token": await asyncio.to_thread(_operators_token, here.config),
        "by": asking.name,
    }
    answer = granted(await _while_there(request, here, asked))
    if shown.program is not None and answer.get("program_digest") != shown.program.sha256:
        await here.daemon.ask({"request": "disarm", "by": asking.name}, DISARM_S)
        text = "the program was changed while it was armed; it is disarmed again"
        raise Refused(409, "PlanChanged", text, "look at what is shown now, and confirm again")
    return Done(text=str(answer["text"]), state=str(answer.get("state", "ARMED")))


async def _while_there(request: Request, here: Context, asked: Mapping[str, Any]) -> Mapping[str, Any]:
    asking = asyncio.ensure_future(here.daemon.ask(asked, ARM_S, progress=lambda _: None))
    try:
        while not (await asyncio.wait([asking], timeout=LOOK_S))[0]:
            if await request.is_disconnected():
                raise Refused(409, "Abandoned", "nobody waited for the answer, nothing is armed", "arm again")
            asker = here.access.asker(token_of(request.headers))
            if asker is None or asker.role != "operate":
                text = "the login has ended, or the user lost the role operate: nothing is armed"
                raise Refused(401, "AuthRequired", text, "log in again")
        return await asking
    finally:
        asking.cancel()


def _operators_token(config: MachineConfig) -> str:
    given = given_credential(TOKEN_NAME)
    return read_token(given.parent if given else config.run_directory)


@router.post("/disarm")
async def disarm(here: Here, asking: Asking) -> Done:
    """Ramp the correction to zero and wait until zero is read back; what is being checked is not armed."""
    answer = granted(await here.daemon.ask({"request": "disarm", "by": asking.name}, DISARM_S))
    return Done(text=str(answer["text"]), state=str(answer.get("state", "OFF")))
