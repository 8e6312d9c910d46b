"""Arms and disarms for the operator, as far as the models allow it, and supervises what is armed."""

import asyncio
import contextlib
import hmac
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

from fdhil import tables
from fdhil.arming.answers import Answer, refusal
from fdhil.arming.background_check import BackgroundCheck
from fdhil.arming.checked_program import CheckedProgram
from fdhil.arming.guard_link import GuardLink
from fdhil.arming.knowledge import Knowledge
from fdhil.arming.lessons import compute_axis_deflections_mm, taught
from fdhil.arming.own_thread import in_own_thread
from fdhil.arming.passes import Passes
from fdhil.arming.preparing import (
    Armament,
    ArmRequest,
    Feeding,
    Refused,
    may_begin,
    prepare,
    prepare_armament,
    prepare_feeding,
)
from fdhil.arming.standing import ADOPT_ADVICE, GONE, REST, START_AND_ADOPT, Standing, landed, verdict
from fdhil.arming.standstill import Standstill
from fdhil.arming.stream_feeder import StreamFeeder
from fdhil.arming.token import ensure_token
from fdhil.arming.whole_plan import plan_whole
from fdhil.config import MachineConfig
from fdhil.errors import DeviceError
from fdhil.guard.guard_protocol import RAMPING_MODES
from fdhil.records import AxisSamples, NcState, Notice, Skill
from fdhil.store.rows import Revision
from fdhil.system_clock import SYSTEM_CLOCK, Clock

STREAM_S = 0.05
ALIVE_S = 0.1  # the guard considers the daemon lost after 0.5 s
REFRESH_S = 0.5
LANDING_S = 1.0  # without SYNC; with SYNC a ramp-down that has begun completes on its own

Record = Callable[[Sequence[Notice]], None]
Prepared = TypeVar("Prepared", Armament, Feeding)


class Storing(Protocol):
    fault: str | None
    """Why nothing can be stored now; None while storing works."""


class ArmingDesk:
    """Decides whether a correction may be armed, and withdraws the facts that no longer hold."""

    def __init__(self, config: MachineConfig, store: Storing, run_directory: Path, clock: Clock = SYSTEM_CLOCK) -> None:
        self._config, self._clock = config, clock
        self._store = store
        self._run_directory = run_directory
        self._token = ""
        self.knowledge = Knowledge(config.axis, clock)
        self._arming = asyncio.Lock()
        self._armed: tuple[Armament | Feeding, Mapping[str, Any]] | None = None
        self._check = BackgroundCheck(config)
        self._passes = Passes(config, clock)
        self._standstill = Standstill(config)
        self._feeder: StreamFeeder | None = None
        self._given_up = False
        self._hung_up: Callable[[], bool] = lambda: False
        self._disarms: int | None = None
        self._disarming: asyncio.Future[Answer] | None = None
        self.guard = GuardLink(config.guard.run_directory or run_directory, config.store.directory, clock)

    def begin(self, newest: Mapping[str, Revision], skills: Sequence[Skill]) -> None:
        """Start from the stored parameters and skills; create the token if there is none. Raises DeviceError."""
        self._token = ensure_token(self._run_directory)
        self.knowledge.begin(newest, skills)

    def restore_token(self) -> None:
        """Write the token again if it was removed (blocking). Raises DeviceError if it cannot be kept secret."""
        ensure_token(self._run_directory, self._token)

    def hear(self, samples: AxisSamples) -> None:
        """Take samples: those of a pass of the armed program are compared with the prediction."""
        self._passes.take(samples)
        self._standstill.take(samples)

    def hear_nc(self, state: NcState) -> None:
        self._passes.hear_nc(state)

    @property
    def passes(self) -> list[Mapping[str, Any]]:
        """The measurements of the last passes under a correction, oldest first."""
        return list(self._passes.reports)

    @property
    def armed(self) -> Mapping[str, Any] | None:
        """What is armed, None if nothing is; of a program also how far its check is."""
        if self._armed is None:
            return None
        armed, summary = self._armed
        return {**summary, **armed.progress()}

    async def arm(self, request: Mapping[str, Any], hung_up: Callable[[], bool] = lambda: False) -> Answer:
        """Plan, load and arm one program; a refusal has code, cause and next action.

        ``hung_up`` is called in a thread right before the guard is asked: nothing is armed for a client that has left.
        """
        token, program, method = (request.get(key) for key in ("token", "program", "method"))
        if not isinstance(token, str) or not hmac.compare_digest(
            token.encode("utf-8", "surrogatepass"), self._token.encode()
        ):
            return refusal("AuthRequired", "the operator's token is missing or wrong", "use the run directory's token")
        feeding = program is None and method == "flatness"
        if not (feeding or _is_name(program)) or not (method is None or method in tables.CORRECTIONS):
            return refusal(
                "BadRequest",
                "invalid program or method",
                f"methods: {', '.join(tables.CORRECTIONS)}",
            )
        if self._arming.locked():
            return refusal("NotOff", "another program is being armed", "wait for it, then arm again")
        async with self._arming:
            self._given_up, self._hung_up = False, hung_up
            if not await self._landed():
                text = f"the previous correction is still active, in state {self.guard.state}"
                return refusal("NotOff", text, "run fdhil disarm or wait for its end, then arm again")
            self._disarms = self.guard.disarms
            if self.guard.state in ("FROZEN", "lost"):
                way_out = ADOPT_ADVICE if self.guard.connected else START_AND_ADOPT
                text = f"the guard is {self.guard.state}: {self.guard.standing}"
                return refusal("OffsetStands", text, f"{way_out}, then arm again")
            if feeding:
                return await self._feed_forward(token)
            return await self._arm(Path(str(program)), method, token, request)

    async def _landed(self) -> bool:
        await in_own_thread(landed, self.guard.look, LANDING_S, RAMPING_MODES, self._clock)
        if self.guard.state in REST:
            self._release()
        return self.guard.state in REST

    def _release(self) -> None:
        if self._armed is not None:
            cause = {"code": "GuardLost"} if self.guard.state in GONE else self.guard.status.get("cause") or {}
            self._passes.end(cause.get("code", ""), self._armed[0].summary(), cause.get("late", ""))
        self._armed = self._feeder = None

    async def _feed_forward(self, token: str) -> Answer:
        prepared = await asyncio.to_thread(prepare_feeding, self._config, self.knowledge.now())
        if isinstance(prepared, Refused):
            return _refused(prepared)
        summary = prepared.summary()
        answer = await self._hand_over(self.guard.feed_forward, prepared, summary, token)
        if not answer["ok"]:
            return answer
        text = f"on-line feed-forward of speed and torque is active on {', '.join(prepared.laws)} for every program"
        return {"ok": True, "state": "FEEDFORWARD", "text": text, **summary}

    async def _hand_over(
        self,
        ask: Callable[[Prepared, str, Callable[[], bool], int | None], Answer],
        prepared: Prepared,
        summary: Answer,
        token: str,
    ) -> Answer:
        prepared.facts["journal_writable"] = self._store.fault is None
        try:
            answer = await in_own_thread(ask, prepared, token, self._unwanted, self._disarms)
        except DeviceError as error:
            return self._without_guard(error)
        if not answer["ok"]:
            return {**answer, "planned": summary}
        self._armed = (prepared, summary)
        return dict(answer)

    def _unwanted(self) -> bool:
        return self._given_up or self._hung_up()

    async def _arm(self, program: Path, method: str | None, token: str, asked: Mapping[str, Any]) -> Answer:
        request = await asyncio.to_thread(prepare, program, method, self._config, self.knowledge.now())
        if isinstance(request, Refused):
            return _refused(request)
        if asked.get("program_digest") not in (None, request.program_digest):
            text = f"{program} has changed: its digest is not the confirmed one; nothing was armed"
            return refusal("ProgramMismatch", text, "check the program, then arm again")
        checked = await self._checked(request, asked.get("whole") is True)
        if isinstance(checked, Refused):
            return _refused(checked)
        if (broken := self._passes.broken(request.program_digest, request.models)) is not None:
            return _refused(Refused((broken,)))
        rows, learner = await asyncio.to_thread(taught, checked, request, self._config.digest)
        known, rest = self.knowledge.now(), self._standstill.now()
        armament = await asyncio.to_thread(prepare_armament, request, rows, self._config, known, rest)
        summary = armament.summary()
        ahead_mm = await asyncio.to_thread(compute_axis_deflections_mm, rows, request)
        self._passes.begin(armament.begin.demand, armament.rows, request.models, learner, ahead_mm)
        answer = await self._hand_over(self.guard.arm, armament, summary, token)
        if not answer["ok"]:
            self._passes.forget()
            return answer
        self._feeder = StreamFeeder(armament, self.guard, self._standstill)
        text = f"armed {program.name} by {summary['method']}: {summary['promise']}"
        if not summary["check"]["whole"]:
            text += f" in its first {summary['check']['checked_s']:.0f} s; the rest is checked ahead of the motion"
        text += "; start the program: its error is measured as it runs"
        return {"ok": True, "state": answer.get("state", "ARMED"), "text": text, **summary}

    async def _checked(self, request: ArmRequest, whole: bool) -> CheckedProgram | Refused:
        if not request.ahead:
            return await asyncio.to_thread(plan_whole, request, self.knowledge.now())

        def enough(checked: CheckedProgram) -> bool:
            return not whole and may_begin(checked, self._config, self.knowledge.now())

        arguments = (request.program, request.program_digest, request.models)
        checked = await self._check.run(*arguments, enough, request.config)
        return Refused(checked) if isinstance(checked, tuple) else checked

    @property
    def checking(self) -> Mapping[str, Any] | None:
        """The progress of a long program's check; None while none runs."""
        return self._check.progress

    def abandon(self) -> bool:
        """Arm nothing of what is being prepared; return whether its check was ended. Armed programs are unaffected."""
        self._given_up = True
        return self._feeder is None and self._check.abandon()

    async def disarm(self) -> Answer:
        """Have the guard ramp to zero; ok only when zero is reached. What is being prepared is not armed."""
        self._feeder = None  # neither rows nor notices of it from here on
        abandoned = self.abandon()
        if self._disarming is None or self._disarming.done():  # repeated requests wait for the same ramp
            self._disarming = asyncio.ensure_future(self._to_zero())
        answer = await asyncio.shield(self._disarming)
        return {**answer, "text": f"{answer['text']}; the check was abandoned"} if abandoned else answer

    async def _to_zero(self) -> Answer:
        try:
            answer = await in_own_thread(self.guard.disarm)
        except DeviceError as error:
            return self._without_guard(error)
        if not answer["ok"]:
            return answer
        if self.guard.state in REST:
            self._release()
        return verdict(self.guard.status)

    def _without_guard(self, error: DeviceError) -> Answer:
        """Return the refusal without a guard, with the offset that the last one may have left."""
        residual = self.guard.standing
        if residual.nothing:
            text, _, advice = str(error).rpartition("; ")
            return refusal("GuardAbsent", text, advice)
        return refusal("OffsetStands", f"{error}; {residual}", START_AND_ADOPT)

    async def attend(self, record: Record) -> None:
        """Report to the guard that the daemon is alive and which facts hold; record what the guard does.

        The guard's answer is not awaited: it takes its time while a program is handed over.
        """
        looking: asyncio.Future[list[Notice]] | None = None
        turn = 0
        while True:
            self.guard.say_alive(self._facts())
            if looking is None and turn % round(REFRESH_S / ALIVE_S) == 0:
                looking = asyncio.ensure_future(in_own_thread(self.guard.refresh))
            await asyncio.sleep(ALIVE_S)
            turn += 1
            if looking is not None and looking.done():
                record(looking.result())
                looking = None
                if self.guard.state in REST:
                    self._release()

    async def stream(self, record: Record) -> None:
        """Hand a long program's rows to the guard as they pass the check, and record refusals."""
        while True:
            await asyncio.sleep(STREAM_S)
            if self._feeder is not None:
                record(await asyncio.to_thread(self._feeder.go_on))
            record(await asyncio.to_thread(self._passes.digest))
            await self._check.attend()

    def _facts(self) -> Mapping[str, bool] | None:
        if self._armed is None:
            return None
        facts = self._armed[0].standing_facts(self._config, self.knowledge.now())
        return facts | {"journal_writable": self._store.fault is None}

    async def stand_down(self) -> Standing:
        """Have a running correction ramped to zero and wait for it; return what may still be applied."""
        self._feeder = None
        self.abandon()
        if self.guard.connected:
            with contextlib.suppress(DeviceError):
                await in_own_thread(self.guard.disarm if self.guard.state not in REST else self.guard.look)
        await self._check.close()
        await in_own_thread(self.guard.close)
        return self.guard.standing


def _is_name(program: Any) -> bool:
    try:
        return isinstance(program, str) and b"\0" not in os.fsencode(program)
    except UnicodeEncodeError:
        return False


def _refused(refused: Refused) -> Answer:
    first, *_ = refused.reasons
    return refusal(first.code, first.text, first.advice) | {"refused": list(map(str, refused.reasons))}
