"""Test a commissioned axis by moving it inside the operator's room: a jog, and rapids.

The jog proves units and signs, the rapids identify the drive, and the last two must match the prediction. Set-points
come from ``set_points`` alone; on any interruption, Ctrl-C included, the axis is braked and the drive switched off.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field

from fdhil.commissioning.commissioning_record import CommissioningRecord
from fdhil.commissioning.commissioning_steps import (
    compute_step_fingerprint,
    enable_drive,
    prepare_drive,
    roll_back_afterwards,
)
from fdhil.commissioning.drive_survey import listen_for_master, require_no_fault, survey_drive
from fdhil.commissioning.live_capture import LiveCapture
from fdhil.commissioning.master import Master
from fdhil.commissioning.polarity import assess_acceleration_power, assess_jog
from fdhil.commissioning.rapid_identification import (
    accept_prediction,
    assess_rapids,
    estimate_voltage_delay,
    identify_from_records,
)
from fdhil.commissioning.record_comparison import compare_record
from fdhil.commissioning.step_progress import Found, StepProgress
from fdhil.commissioning.stroke_execution import (
    AllowedTravel,
    determine_travel,
    get_position_mm,
    plan_return,
    run_stroke,
)
from fdhil.commissioning.stroke_planning import Stroke, TravelRoom, plan_jog, plan_rapid, require_single_drive
from fdhil.commissioning.sync_timing import assess_answer_delay, assess_sync_jitter, measure_timing
from fdhil.commissioning.watchdog import watch_heartbeat
from fdhil.config import MachineConfig
from fdhil.drivers import ListeningBus
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
class OperatorCallbacks:
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
class AxisTrial:
    """Results of an axis' trial by step, and the outcomes of its rapids for the history."""

    found: dict[str, Found] = field(default_factory=dict)
    outcomes: tuple[Outcome, ...] = ()


def try_axis(
    config: MachineConfig,
    record: CommissioningRecord,
    room: TravelRoom,
    operator: OperatorCallbacks,
    progress: StepProgress,
    known: PipelineState | None = None,
) -> AxisTrial:
    """Run all steps that are not stored, return their results; nothing moves before ``report`` returns from ``jog``.

    DriveFault for every deviation or rejected result, and as commissioning, after everything was rolled back.
    """
    axis, trial = record.axis, AxisTrial()
    require_single_drive(config, axis)
    jog, rapid = plan_jog(axis, config.axis[axis], room), plan_rapid(axis, config.axis[axis], room)
    with Master(config, axis) as master:
        listen_for_master(master)
        found = survey_drive(master)
        require_no_fault(master, [compare_record(record, found)])
        now = f"{compute_step_fingerprint(config, axis, found)} {config.digest}"
        trial.found = {step: kept for step in STEPS[1:] if (kept := progress.reuse_step(step, now)) is not None}
        if len(trial.found) == len(STEPS) - 1:
            return trial
        with roll_back_afterwards(master):
            operator.report("timing")
            prepare_drive(master)
            trial.found["timing"] = measure_bus_timing(master)
            operator.result("timing", trial.found["timing"])
            travel_mm = determine_allowed_travel(master, record, room, progress, now)
            back = plan_return(master, travel_mm)
            operator.result(GIVEN, _format_travel(master, travel_mm) | {"return": None if back is None else str(back)})
            with save_stop_position(master, progress, now), enable_heartbeat_watch(master):
                if back is not None:
                    operator.report("return")
                    enable_drive(master)
                    run_stroke(master, travel_mm, back, JOG_REST_S, operator.at)
                if "jog" not in trial.found:
                    operator.report("jog")
                    enable_drive(master)
                    trial.found["jog"] = jog_back_and_forth(master, travel_mm, jog, operator)
                    progress.save_step("jog", now, trial.found["jog"])
                    operator.result("jog", trial.found["jog"])
                operator.report("test rapids")
                enable_drive(master)
                capture = run_test_rapids(master, travel_mm, rapid, operator)
                operator.report("restore")
    trial.outcomes = tuple(identify_from_records(config, axis, capture.records, known))
    trial.found |= assess_rapid_results(config, axis, trial.outcomes, capture.build_recording(), operator)
    trial.found["test rapids"] = {"rapid": str(rapid), "moves": TRIAL_RAPIDS, **trial.found["test rapids"]}
    for step in FROM_RAPIDS:
        progress.save_step(step, now, trial.found[step])
    return trial


def determine_allowed_travel(
    master: Master, record: CommissioningRecord, room: TravelRoom, progress: StepProgress, now: str
) -> AllowedTravel:
    """Return the permitted travel; a trial that was stopped elsewhere keeps the room that it began with."""
    given = progress.find_result(GIVEN, now)
    travel_mm = determine_travel(master, record, room, AllowedTravel(**given) if given else None)
    if given is None:
        progress.save_step(
            GIVEN, now, {"low_mm": travel_mm.low_mm, "high_mm": travel_mm.high_mm, "start_mm": travel_mm.start_mm}
        )
    return travel_mm


@contextmanager
def save_stop_position(master: Master, progress: StepProgress, now: str) -> Iterator[None]:
    """Store the axis' position if the trial ends early, so that it can be resumed from there."""
    try:
        yield
    except BaseException:  # Ctrl-C, too
        if given := progress.find_result(GIVEN, now):
            with suppress(StoreError):  # the cause is being raised
                progress.save_step(GIVEN, now, {**given, "stopped_mm": get_position_mm(master)})
        raise


def _format_travel(master: Master, travel_mm: AllowedTravel) -> dict[str, str]:
    settings = master.config.axis[master.axis]
    places = {"stands": get_position_mm(master), "from": travel_mm.low_mm, "to": travel_mm.high_mm}
    return {what: settings.format_in_unit(mm, form=".3f") for what, mm in places.items()}


def assess_rapid_results(
    config: MachineConfig, axis: str, outcomes: Sequence[Outcome], recording: Recording, operator: OperatorCallbacks
) -> dict[str, Found]:
    """Return the rapids' results by step; DriveFault for the first deviation."""
    balance = assess_acceleration_power(recording)
    if balance.ok is False:
        raise DriveFault(f"drive {axis}", f"{balance.cause}; {balance.advice}")
    operator.result("test rapids", {balance.point: balance.found})
    operator.report("identification")
    rapids = assess_rapids(axis, outcomes)
    operator.result("identification", rapids.parameters)
    operator.report("acceptance")
    accepted = accept_prediction(config, rapids)
    operator.result("acceptance", accepted)
    return {
        "test rapids": {balance.point: balance.found, **estimate_voltage_delay(config, rapids)},
        "identification": rapids.parameters,
        "acceptance": accepted,
    }


@contextmanager
def enable_heartbeat_watch(master: Master) -> Iterator[None]:
    """Let the drive monitor fdhil's heartbeat, so that it stops by itself if this process or the bus fails."""
    play, loop = master.config.play, master.loop
    with ExitStack() as undo:
        undo.callback(setattr, loop, "heartbeat", None)
        undo.enter_context(watch_heartbeat(master, play.node_id, play.heartbeat_s))
        loop.heartbeat, loop.heartbeat_s = play.node_id, play.heartbeat_s
        try:
            yield
        except BaseException:
            with suppress(DeviceError):  # of a bus that is gone: the cause is being raised
                undo.close()
            raise


def measure_bus_timing(master: Master) -> Found:
    """Measure while fdhil sends SYNC: the drive must answer in time; DriveFault.

    SYNC evenness is reported but not assessed, since it is this computer's; ``fdhil check`` assesses the NC's.
    """
    name, counted = master.bus.name, master.config.guard.clock == "sync"
    with ListeningBus(name, master.config.bus[name]) as bus:
        master.wait_cycles(TIMING_CYCLES)
        timing = measure_timing(bus.drain_frames(), [spec.cob_base + master.node_id for spec in master.profile.tpdos])
    findings = [
        assess_sync_jitter(timing.interval_s, master.period_s, counted=True),
        *assess_answer_delay(timing, master.period_s, counted),
    ]
    require_no_fault(master, findings)
    return {finding.point: finding.found for finding in findings}


def jog_back_and_forth(master: Master, travel_mm: AllowedTravel, jog: Stroke, operator: OperatorCallbacks) -> Found:
    """Jog an enabled axis and back: units and signs must be right, also according to the operator; DriveFault."""
    with LiveCapture(master.config, master.axis) as capture:
        for moved in (jog, jog.reverse_direction()):
            run_stroke(master, travel_mm, moved, JOG_REST_S, operator.at)
        wait_until_captured(master, capture)
    findings = list(assess_jog(capture.build_recording(), jog.distance_mm, jog.axis))
    require_no_fault(master, findings)
    saw = operator.saw(f"The drive moved {jog}, and back. Did the table do the same?")
    if saw is False:
        text = "the table did not move as the drive reports"
        advice = (
            "check drive.sign for the direction, screw_pitch_mm or increments_per_rev for the distance, else a coupling"
        )
        raise DriveFault(master.device, f"{text}; {advice}")
    return {"jog": str(jog), "seen": "not asked" if saw is None else "yes"} | {f.point: f.found for f in findings}


def wait_until_captured(master: Master, capture: LiveCapture) -> None:
    """Wait until all moves so far have been recorded, by a separate sensor too."""
    goal = capture.newest_tick + round(LAST_REST_S / master.period_s)
    patience_s = HEARD_TIMEOUT_S + LAST_REST_S

    def is_goal_reached() -> bool:
        capture.raise_if_failed()
        return capture.newest_tick >= goal

    master.wait_until(is_goal_reached, patience_s, "its TPDOs are no longer received; check the bus")


def run_test_rapids(
    master: Master, travel_mm: AllowedTravel, rapid: Stroke, operator: OperatorCallbacks
) -> LiveCapture:
    """Move an enabled axis back and forth as fast as G0, and return the recording."""
    with LiveCapture(master.config, master.axis, rapid.speed_mm_s) as capture:
        master.wait_cycles(round(REST_S / master.period_s))
        for _ in range(TRIAL_RAPIDS // 2):
            for moved in (rapid, rapid.reverse_direction()):
                run_stroke(master, travel_mm, moved, REST_S, operator.at)
        wait_until_captured(master, capture)
    return capture
