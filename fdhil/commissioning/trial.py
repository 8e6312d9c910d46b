"""Test a commissioned axis by moving it inside the operator's room: a jog, and rapids.

The jog proves units and signs, the rapids identify the drive, and the last two must match the prediction. Set-points
come from ``set_points`` alone; on any interruption, Ctrl-C included, the axis is braked and the drive switched off.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field

from fdhil.commissioning.compare import compare_record
from fdhil.commissioning.identified import accept, identify, judge, voltage_late
from fdhil.commissioning.master import Master
from fdhil.commissioning.overhearing import Overhearing
from fdhil.commissioning.polarity import judge_acceleration, judge_jog
from fdhil.commissioning.progress import Found, Progress
from fdhil.commissioning.record import CommissioningRecord
from fdhil.commissioning.steps import enable, holds_for, prepare, rolled_back
from fdhil.commissioning.strokes import Room, Stroke, plan_jog, plan_rapid, require_single_drive
from fdhil.commissioning.stroking import Travel, plan_return, position_mm, stroke, travel_of
from fdhil.commissioning.survey import listen, require, survey
from fdhil.commissioning.timing import judge_answers, judge_sync, measure
from fdhil.commissioning.watchdog import watched
from fdhil.config import MachineConfig
from fdhil.drivers.can.bus_listener import ListeningBus
from fdhil.errors import DeviceError, DriveFault, StoreError
from fdhil.pipeline import PipelineState
from fdhil.records import Outcome, Recording

TRIAL_RAPIDS = 6
TIMING_CYCLES = 1000
REST_S = 0.8  # between two strokes: a window needs a quarter second before it, and a third after
JOG_REST_S = 0.2
LAST_REST_S = 1.8  # a separate sensor may deliver a second late
HEARD_TIMEOUT_S = 10.0
STEPS = ("timing", "jog", "test rapids", "identification", "acceptance")
FROM_RAPIDS = STEPS[2:]
GIVEN = "room"  # stored with the steps: the permitted travel of a stopped trial


@dataclass(frozen=True, slots=True)
class Operator:
    """Callbacks to the operator: ``report`` gets the name of each step before it, and its exception ends the trial.

    ``saw`` gets a question and returns what the operator saw, None if not asked. ``result`` gets the results of a step;
    before the first move those of ``room``: the position, the permitted travel, and the move back to the start of a
    stopped trial. ``at`` gets the position in mm while the axis moves.
    """

    report: Callable[[str], None] = lambda _step: None
    saw: Callable[[str], bool | None] = lambda _question: None
    result: Callable[[str, Found], None] = lambda _step, _found: None
    at: Callable[[float], None] = lambda _mm: None


@dataclass(slots=True)
class Trial:
    """Results of an axis' trial by step, and the outcomes of its rapids for the history."""

    found: dict[str, Found] = field(default_factory=dict)
    outcomes: tuple[Outcome, ...] = ()


def try_axis(
    config: MachineConfig,
    record: CommissioningRecord,
    room: Room,
    operator: Operator,
    progress: Progress,
    known: PipelineState | None = None,
) -> Trial:
    """Run all steps that are not stored, return their results; nothing moves before ``report`` returns from ``jog``.

    DriveFault for every deviation or rejected result, and as commissioning, after everything was rolled back.
    """
    axis, trial = record.axis, Trial()
    require_single_drive(config, axis)
    jog, rapid = plan_jog(axis, config.axis[axis], room), plan_rapid(axis, config.axis[axis], room)
    with Master(config, axis) as master:
        listen(master)
        found = survey(master)
        require(master, [compare_record(record, found)])
        now = f"{holds_for(config, axis, found)} {config.digest}"
        trial.found = {step: kept for step in STEPS[1:] if (kept := progress.kept(step, now)) is not None}
        if len(trial.found) == len(STEPS) - 1:
            return trial
        with rolled_back(master):
            operator.report("timing")
            prepare(master)
            trial.found["timing"] = time_bus(master)
            operator.result("timing", trial.found["timing"])
            travel_mm = allowed(master, record, room, progress, now)
            back = plan_return(master, travel_mm)
            operator.result(GIVEN, _shown(master, travel_mm) | {"return": None if back is None else str(back)})
            with where_stopped(master, progress, now), guarded(master):
                if back is not None:
                    operator.report("return")
                    enable(master)
                    stroke(master, travel_mm, back, JOG_REST_S, operator.at)
                if "jog" not in trial.found:
                    operator.report("jog")
                    enable(master)
                    trial.found["jog"] = jog_to_and_fro(master, travel_mm, jog, operator)
                    progress.keep("jog", now, trial.found["jog"])
                    operator.result("jog", trial.found["jog"])
                operator.report("test rapids")
                enable(master)
                capture = rapids_to_and_fro(master, travel_mm, rapid, operator)
                operator.report("restore")
    trial.outcomes = tuple(identify(config, axis, capture.records, known))
    trial.found |= judged(config, axis, trial.outcomes, capture.recording(), operator)
    trial.found["test rapids"] = {"rapid": str(rapid), "moves": TRIAL_RAPIDS, **trial.found["test rapids"]}
    for step in FROM_RAPIDS:
        progress.keep(step, now, trial.found[step])
    return trial


def allowed(master: Master, record: CommissioningRecord, room: Room, progress: Progress, now: str) -> Travel:
    """Return the permitted travel; a trial that was stopped elsewhere keeps the room that it began with."""
    given = progress.found(GIVEN, now)
    travel_mm = travel_of(master, record, room, Travel(**given) if given else None)
    if given is None:
        progress.keep(
            GIVEN, now, {"low_mm": travel_mm.low_mm, "high_mm": travel_mm.high_mm, "start_mm": travel_mm.start_mm}
        )
    return travel_mm


@contextmanager
def where_stopped(master: Master, progress: Progress, now: str) -> Iterator[None]:
    """Store the axis' position if the trial ends early, so that it can be resumed from there."""
    try:
        yield
    except BaseException:  # Ctrl-C, too
        if given := progress.found(GIVEN, now):
            with suppress(StoreError):  # the cause is being raised
                progress.keep(GIVEN, now, {**given, "stopped_mm": position_mm(master)})
        raise


def _shown(master: Master, travel_mm: Travel) -> dict[str, str]:
    settings = master.config.axis[master.axis]
    places = {"stands": position_mm(master), "from": travel_mm.low_mm, "to": travel_mm.high_mm}
    return {what: settings.format_in_unit(mm, form=".3f") for what, mm in places.items()}


def judged(
    config: MachineConfig, axis: str, outcomes: Sequence[Outcome], recording: Recording, operator: Operator
) -> dict[str, Found]:
    """Return the rapids' results by step; DriveFault for the first deviation."""
    balance = judge_acceleration(recording)
    if balance.ok is False:
        raise DriveFault(f"drive {axis}", f"{balance.cause}; {balance.advice}")
    operator.result("test rapids", {balance.point: balance.found})
    operator.report("identification")
    rapids = judge(axis, outcomes)
    operator.result("identification", rapids.parameters)
    operator.report("acceptance")
    accepted = accept(config, rapids)
    operator.result("acceptance", accepted)
    return {
        "test rapids": {balance.point: balance.found, **voltage_late(config, rapids)},
        "identification": rapids.parameters,
        "acceptance": accepted,
    }


@contextmanager
def guarded(master: Master) -> Iterator[None]:
    """Let the drive monitor fdhil's heartbeat, so that it stops by itself if this process or the bus fails."""
    play, loop = master.config.play, master.loop
    with ExitStack() as undo:
        undo.callback(setattr, loop, "heartbeat", None)
        undo.enter_context(watched(master, play.node_id, play.heartbeat_s))
        loop.heartbeat, loop.heartbeat_s = play.node_id, play.heartbeat_s
        try:
            yield
        except BaseException:
            with suppress(DeviceError):  # of a bus that is gone: the cause is being raised
                undo.close()
            raise


def time_bus(master: Master) -> Found:
    """Measure while fdhil sends SYNC: the drive must answer in time; DriveFault.

    SYNC evenness is reported but not assessed, since it is this computer's; ``fdhil check`` assesses the NC's.
    """
    name, counted = master.bus.name, master.config.guard.clock == "sync"
    with ListeningBus(name, master.config.bus[name]) as bus:
        master.wait_cycles(TIMING_CYCLES)
        timing = measure(bus.drain_frames(), [spec.cob_base + master.node_id for spec in master.profile.tpdos])
    findings = [
        judge_sync(timing.interval_s, master.period_s, counted=True),
        *judge_answers(timing, master.period_s, counted),
    ]
    require(master, findings)
    return {finding.point: finding.found for finding in findings}


def jog_to_and_fro(master: Master, travel_mm: Travel, jog: Stroke, operator: Operator) -> Found:
    """Jog an enabled axis and back: units and signs must be right, also according to the operator; DriveFault."""
    with Overhearing(master.config, master.axis) as capture:
        for moved in (jog, jog.back()):
            stroke(master, travel_mm, moved, JOG_REST_S, operator.at)
        wait_heard(master, capture)
    findings = list(judge_jog(capture.recording(), jog.distance_mm, jog.axis))
    require(master, findings)
    saw = operator.saw(f"The drive moved {jog}, and back. Did the table do the same?")
    if saw is False:
        text = "the table did not move as the drive reports"
        advice = (
            "check drive.sign for the direction, screw_pitch_mm or increments_per_rev for the distance, else a coupling"
        )
        raise DriveFault(master.device, f"{text}; {advice}")
    return {"jog": str(jog), "seen": "not asked" if saw is None else "yes"} | {f.point: f.found for f in findings}


def wait_heard(master: Master, capture: Overhearing) -> None:
    """Wait until all moves so far have been recorded, by a separate sensor too."""
    goal = capture.newest_tick + round(LAST_REST_S / master.period_s)
    patience_s = HEARD_TIMEOUT_S + LAST_REST_S

    def reached() -> bool:
        capture.check()
        return capture.newest_tick >= goal

    master.wait(reached, patience_s, "its TPDOs are no longer received; check the bus")


def rapids_to_and_fro(master: Master, travel_mm: Travel, rapid: Stroke, operator: Operator) -> Overhearing:
    """Move an enabled axis back and forth as fast as G0, and return the recording."""
    with Overhearing(master.config, master.axis, rapid.speed_mm_s) as capture:
        master.wait_cycles(round(REST_S / master.period_s))
        for _ in range(TRIAL_RAPIDS // 2):
            for moved in (rapid, rapid.back()):
                stroke(master, travel_mm, moved, REST_S, operator.at)
        wait_heard(master, capture)
    return capture
