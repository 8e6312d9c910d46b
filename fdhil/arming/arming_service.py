"""Arms and disarms for the operator, as far as the models allow it, and supervises what is armed."""

import asyncio
import contextlib
import hmac
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

from fdhil import tables
from fdhil.arming.arm_plan import (
    ArmPlan,
    ArmRequest,
    FeedforwardPlan,
    Refusal,
    may_arm_ahead,
    prepare_feedforward,
    prepare_program,
    prepare_request,
)
from fdhil.arming.background_check import BackgroundCheck
from fdhil.arming.checked_program import CheckedProgram
from fdhil.arming.dedicated_thread import run_in_dedicated_thread
from fdhil.arming.guard_link import GuardLink
from fdhil.arming.iterative_learning import apply_learned_offsets, compute_axis_deflections_mm
from fdhil.arming.model_tracker import ModelTracker
from fdhil.arming.operator_token import ensure_token
from fdhil.arming.pass_monitor import PassMonitor
from fdhil.arming.refusals import Answer, make_refusal
from fdhil.arming.residual_offset import (
    ADOPT_ADVICE,
    GONE,
    REST,
    START_AND_ADOPT,
    ResidualOffset,
    answer_disarm,
    wait_until_idle,
)
from fdhil.arming.standstill_monitor import StandstillMonitor
from fdhil.arming.stream_feeder import StreamFeeder
from fdhil.arming.whole_plan import plan_whole_program
from fdhil.config import MachineConfig
from fdhil.errors import DeviceError
from fdhil.guard import RAMPING_MODES
from fdhil.records import AxisSamples, NcState, Notice, Skill
from fdhil.store import Revision
from fdhil.system_clock import SYSTEM_CLOCK, Clock

STREAM_S = 0.05
ALIVE_S = 0.1  # the guard considers the daemon lost after 0.5 s
REFRESH_S = 0.5
LANDING_S = 1.0  # without SYNC; with SYNC a ramp-down that has begun completes on its own

Record = Callable[[Sequence[Notice]], None]
Prepared = TypeVar("Prepared", ArmPlan, FeedforwardPlan)


class OutcomeStoreState(Protocol):
    fault: str | None
    """Why nothing can be stored now; None while storing works."""


class ArmingService:
    """Decides whether a correction may be armed, and withdraws the facts that no longer hold."""

    def __init__(
        self, config: MachineConfig, store: OutcomeStoreState, run_directory: Path, clock: Clock = SYSTEM_CLOCK
    ) -> None:
        self._config, self._clock = config, clock
        self._store = store
        self._run_directory = run_directory
        self._token = ""
        self.knowledge = ModelTracker(config.axis, clock)
        self._arming = asyncio.Lock()
        self._armed: tuple[ArmPlan | FeedforwardPlan, Mapping[str, Any]] | None = None
        self._check = BackgroundCheck(config)
        self._passes = PassMonitor(config, clock)
        self._standstill = StandstillMonitor(config)
        self._feeder: StreamFeeder | None = None
        self._given_up = False
        self._hung_up: Callable[[], bool] = lambda: False
        self._disarms: int | None = None
        self._disarming: asyncio.Future[Answer] | None = None
        self.guard = GuardLink(config.guard.run_directory or run_directory, config.store.directory, clock)

    def start_from_history(self, newest: Mapping[str, Revision], skills: Sequence[Skill]) -> None:
        """Start from the stored parameters and skills; create the token if there is none. Raises DeviceError."""
        self._token = ensure_token(self._run_directory)
        self.knowledge.start_from_history(newest, skills)

    def restore_token(self) -> None:
        """Write the token again if it was removed (blocking). Raises DeviceError if it cannot be kept secret."""
        ensure_token(self._run_directory, self._token)

    def take_samples(self, samples: AxisSamples) -> None:
        """Take samples: those of a pass of the armed program are compared with the prediction."""
        self._passes.take_samples(samples)
        self._standstill.take_samples(samples)

    def take_nc_state(self, state: NcState) -> None:
        self._passes.take_nc_state(state)

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
        return {**summary, **armed.report_progress()}

    async def arm(self, request: Mapping[str, Any], hung_up: Callable[[], bool] = lambda: False) -> Answer:
        """Plan, load and arm one program; a refusal has code, cause and next action.

        ``hung_up`` is called in a thread right before the guard is asked: nothing is armed for a client that has left.
        """
        token, program, method = (request.get(key) for key in ("token", "program", "method"))
        if not isinstance(token, str) or not hmac.compare_digest(
            token.encode("utf-8", "surrogatepass"), self._token.encode()
        ):
            return make_refusal(
                "AuthRequired", "the operator's token is missing or wrong", "use the run directory's token"
            )
        feeding = program is None and method == "flatness"
        if not (feeding or _is_file_name(program)) or not (method is None or method in tables.CORRECTIONS):
            return make_refusal(
                "BadRequest",
                "invalid program or method",
                f"methods: {', '.join(tables.CORRECTIONS)}",
            )
        if self._arming.locked():
            return make_refusal("NotOff", "another program is being armed", "wait for it, then arm again")
        async with self._arming:
            self._given_up, self._hung_up = False, hung_up
            if not await self._wait_for_idle():
                text = f"the previous correction is still active, in state {self.guard.state}"
                return make_refusal("NotOff", text, "run fdhil disarm or wait for its end, then arm again")
            self._disarms = self.guard.disarm_count
            if self.guard.state in ("FROZEN", "lost"):
                way_out = ADOPT_ADVICE if self.guard.is_connected else START_AND_ADOPT
                text = f"the guard is {self.guard.state}: {self.guard.residual_offset}"
                return make_refusal("OffsetStands", text, f"{way_out}, then arm again")
            if feeding:
                return await self._arm_feedforward(token)
            return await self._arm_program(Path(str(program)), method, token, request)

    async def _wait_for_idle(self) -> bool:
        await run_in_dedicated_thread(wait_until_idle, self.guard.read_status, LANDING_S, RAMPING_MODES, self._clock)
        if self.guard.state in REST:
            self._release_armed()
        return self.guard.state in REST

    def _release_armed(self) -> None:
        if self._armed is not None:
            cause = {"code": "GuardLost"} if self.guard.state in GONE else self.guard.status.get("cause") or {}
            self._passes.end_pass(cause.get("code", ""), self._armed[0].summarise(), cause.get("late", ""))
        self._armed = self._feeder = None

    async def _arm_feedforward(self, token: str) -> Answer:
        prepared = await asyncio.to_thread(prepare_feedforward, self._config, self.knowledge.get_states())
        if isinstance(prepared, Refusal):
            return _format_refusal(prepared)
        summary = prepared.summarise()
        answer = await self._request_arming(self.guard.enable_feedforward, prepared, summary, token)
        if not answer["ok"]:
            return answer
        text = f"on-line feed-forward of speed and torque is active on {', '.join(prepared.laws)} for every program"
        return {"ok": True, "state": "FEEDFORWARD", "text": text, **summary}

    async def _request_arming(
        self,
        ask: Callable[[Prepared, str, Callable[[], bool], int | None], Answer],
        prepared: Prepared,
        summary: Answer,
        token: str,
    ) -> Answer:
        prepared.facts["journal_writable"] = self._store.fault is None
        try:
            answer = await run_in_dedicated_thread(ask, prepared, token, self._is_abandoned, self._disarms)
        except DeviceError as error:
            return self._report_absent_guard(error)
        if not answer["ok"]:
            return {**answer, "planned": summary}
        self._armed = (prepared, summary)
        return dict(answer)

    def _is_abandoned(self) -> bool:
        return self._given_up or self._hung_up()

    async def _arm_program(self, program: Path, method: str | None, token: str, asked: Mapping[str, Any]) -> Answer:
        request = await asyncio.to_thread(prepare_request, program, method, self._config, self.knowledge.get_states())
        if isinstance(request, Refusal):
            return _format_refusal(request)
        if asked.get("program_digest") not in (None, request.program_digest):
            text = f"{program} has changed: its digest is not the confirmed one; nothing was armed"
            return make_refusal("ProgramMismatch", text, "check the program, then arm again")
        checked = await self._check_program(request, asked.get("whole") is True)
        if isinstance(checked, Refusal):
            return _format_refusal(checked)
        if (broken := self._passes.find_broken_prediction(request.program_digest, request.models)) is not None:
            return _format_refusal(Refusal((broken,)))
        rows, learner = await asyncio.to_thread(apply_learned_offsets, checked, request, self._config.digest)
        known, rest = self.knowledge.get_states(), self._standstill.find_standing_axes()
        armament = await asyncio.to_thread(prepare_program, request, rows, self._config, known, rest)
        summary = armament.summarise()
        ahead_mm = await asyncio.to_thread(compute_axis_deflections_mm, rows, request)
        self._passes.start_pass(armament.first_piece.demand, armament.row_count, request.models, learner, ahead_mm)
        answer = await self._request_arming(self.guard.arm, armament, summary, token)
        if not answer["ok"]:
            self._passes.cancel_pass()
            return answer
        self._feeder = StreamFeeder(armament, self.guard, self._standstill)
        text = f"armed {program.name} by {summary['method']}: {summary['promise']}"
        if not summary["check"]["whole"]:
            text += f" in its first {summary['check']['checked_s']:.0f} s; the rest is checked ahead of the motion"
        text += "; start the program: its error is measured as it runs"
        return {"ok": True, "state": answer.get("state", "ARMED"), "text": text, **summary}

    async def _check_program(self, request: ArmRequest, whole: bool) -> CheckedProgram | Refusal:
        if not request.ahead:
            return await asyncio.to_thread(plan_whole_program, request, self.knowledge.get_states())

        def is_enough(checked: CheckedProgram) -> bool:
            return not whole and may_arm_ahead(checked, self._config, self.knowledge.get_states())

        arguments = (request.program, request.program_digest, request.models)
        checked = await self._check.check_until(*arguments, is_enough, request.config)
        return Refusal(checked) if isinstance(checked, tuple) else checked

    @property
    def check_progress(self) -> Mapping[str, Any] | None:
        """The progress of a long program's check; None while none runs."""
        return self._check.progress

    def abandon_preparation(self) -> bool:
        """Arm nothing of what is being prepared; return whether its check was ended. Armed programs are unaffected."""
        self._given_up = True
        return self._feeder is None and self._check.abandon()

    async def disarm(self) -> Answer:
        """Have the guard ramp to zero; ok only when zero is reached. What is being prepared is not armed."""
        self._feeder = None  # neither rows nor notices of it from here on
        abandoned = self.abandon_preparation()
        if self._disarming is None or self._disarming.done():  # repeated requests wait for the same ramp
            self._disarming = asyncio.ensure_future(self._ramp_to_zero())
        answer = await asyncio.shield(self._disarming)
        return {**answer, "text": f"{answer['text']}; the check was abandoned"} if abandoned else answer

    async def _ramp_to_zero(self) -> Answer:
        try:
            answer = await run_in_dedicated_thread(self.guard.disarm)
        except DeviceError as error:
            return self._report_absent_guard(error)
        if not answer["ok"]:
            return answer
        if self.guard.state in REST:
            self._release_armed()
        return answer_disarm(self.guard.status)

    def _report_absent_guard(self, error: DeviceError) -> Answer:
        """Return the refusal without a guard, with the offset that the last one may have left."""
        residual = self.guard.residual_offset
        if residual.is_zero:
            text, _, advice = str(error).rpartition("; ")
            return make_refusal("GuardAbsent", text, advice)
        return make_refusal("OffsetStands", f"{error}; {residual}", START_AND_ADOPT)

    async def supervise_guard(self, record: Record) -> None:
        """Report to the guard that the daemon is alive and which facts hold; record what the guard does.

        The guard's answer is not awaited: it takes its time while a program is handed over.
        """
        looking: asyncio.Future[list[Notice]] | None = None
        turn = 0
        while True:
            self.guard.send_alive(self._collect_facts())
            if looking is None and turn % round(REFRESH_S / ALIVE_S) == 0:
                looking = asyncio.ensure_future(run_in_dedicated_thread(self.guard.poll_changes))
            await asyncio.sleep(ALIVE_S)
            turn += 1
            if looking is not None and looking.done():
                record(looking.result())
                looking = None
                if self.guard.state in REST:
                    self._release_armed()

    async def stream_rows(self, record: Record) -> None:
        """Hand a long program's rows to the guard as they pass the check, and record refusals."""
        while True:
            await asyncio.sleep(STREAM_S)
            if self._feeder is not None:
                record(await asyncio.to_thread(self._feeder.feed_rows))
            record(await asyncio.to_thread(self._passes.process_samples))
            await self._check.raise_failure()

    def _collect_facts(self) -> Mapping[str, bool] | None:
        if self._armed is None:
            return None
        facts = self._armed[0].collect_facts(self._config, self.knowledge.get_states())
        return facts | {"journal_writable": self._store.fault is None}

    async def shut_down(self) -> ResidualOffset:
        """Have a running correction ramped to zero and wait for it; return what may still be applied."""
        self._feeder = None
        self.abandon_preparation()
        if self.guard.is_connected:
            with contextlib.suppress(DeviceError):
                await run_in_dedicated_thread(
                    self.guard.disarm if self.guard.state not in REST else self.guard.read_status
                )
        await self._check.close()
        await run_in_dedicated_thread(self.guard.close)
        return self.guard.residual_offset


def _is_file_name(program: Any) -> bool:
    try:
        return isinstance(program, str) and b"\0" not in os.fsencode(program)
    except UnicodeEncodeError:
        return False


def _format_refusal(refused: Refusal) -> Answer:
    first, *_ = refused.reasons
    return make_refusal(first.code, first.text, first.advice) | {"refused": list(map(str, refused.reasons))}
