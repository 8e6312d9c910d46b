"""Faults and refusals end the trial of a simulated axis at standstill; a successful trial is in tests/cli."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from fdhil.commissioning.axis_trial import AxisTrial, OperatorCallbacks, try_axis
from fdhil.commissioning.commissioning_record import CommissioningRecord, load_record
from fdhil.commissioning.step_progress import Found, StepProgress
from fdhil.commissioning.stroke_planning import TravelRoom
from fdhil.config import MachineConfig
from fdhil.errors import DeviceError, DriveFault, ForeignMaster
from tests.commissioning.foreign_nc import A_FEW, FOREIGN, NMT, SDO, SYNC, TARGET, ForeignNc, Frame, is_moving_frame
from tests.drivers.frame_builder import build_machine_config
from tests.drivers.peer import DrivePeer
from tests.integration.conftest import sign_off

ROOM = TravelRoom(-2.0, 130.0)


@dataclass
class TrialBench:
    """A signed-off simulated drive, and the questions to its operator."""

    peer: DrivePeer
    config: MachineConfig
    record: CommissioningRecord
    steps: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)
    saw: bool | None = None
    at: Callable[[str], None] = lambda _step: None

    def record_step(self, step: str) -> None:
        self.steps.append(step)
        self.at(step)

    def answer_question(self, question: str) -> bool | None:
        self.asked.append(question)
        return self.saw

    def run_trial(self, room: TravelRoom = ROOM) -> AxisTrial:
        """Run the trial; afterwards the axis is off and at standstill."""
        store = self.config.store.directory
        try:
            return try_axis(
                self.config,
                self.record,
                room,
                OperatorCallbacks(self.record_step, self.answer_question),
                StepProgress(store, "X"),
            )
        finally:
            assert self.peer.drive.power.state.name in ("SWITCH_ON_DISABLED", "FAULT")
            assert self.peer.drive.dictionary.get_number(0x60B0) == 0

    @property
    def position_mm(self) -> float:
        return self.peer.drive.table_mm


@pytest.fixture
def fast_trial(fast_commissioning: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.commissioning.stroke_planning.JOG_MM", 1.0)
    monkeypatch.setattr("fdhil.commissioning.axis_trial.TIMING_CYCLES", 100)
    monkeypatch.setattr("fdhil.commissioning.axis_trial.LAST_REST_S", 0.4)


@pytest.fixture
def trial_bench(fast_trial: None, tmp_path: Path) -> Iterator[TrialBench]:
    bus: dict[str, object] = {"interface": "virtual", "channel": uuid.uuid4().hex}
    period = {"name": "bench", "sync_period_s": 0.002}
    config = build_machine_config(tmp_path, bus=bus, guard={"clock": "sync"}, machine=period)
    with DrivePeer(config) as peer:
        sign_off(config)
        record = load_record(config.store.directory, "X")
        assert record is not None
        yield TrialBench(peer, config, record)


@pytest.mark.usefixtures("long_computation")
def test_wrong_sign_or_denied_jog_ends_trial_before_rapids(trial_bench: TrialBench) -> None:
    trial_bench.peer.drive.faults.get_signal_fault("voltage").gain = -1.0
    with pytest.raises(DriveFault, match="SignOrScale: voltage times current, and times speed is negative"):
        trial_bench.run_trial()
    trial_bench.peer.drive.faults.get_signal_fault("voltage").gain, trial_bench.saw = 1.0, False
    with pytest.raises(DriveFault, match=r"the table did not move as the drive reports; check drive.sign"):
        trial_bench.run_trial()
    assert "test rapids" not in trial_bench.steps
    assert trial_bench.position_mm == pytest.approx(0.0, abs=0.05)
    assert StepProgress(trial_bench.config.store.directory, "X").list_step_times().keys() == {"room"}
    with pytest.raises(DriveFault, match=r"limited to -2.05 to 130.05 mm by the room of the interrupted trial"):
        trial_bench.run_trial(TravelRoom(-5.0, 130.0))


@pytest.mark.usefixtures("long_computation")
def test_stopped_trial_continues_within_original_room(trial_bench: TrialBench) -> None:
    trial_bench.saw, positions = True, list[float]()
    results: dict[str, Found] = {}

    def stop_during_rapid(mm: float) -> None:
        positions.append(mm)
        if trial_bench.steps[-1] == "test rapids" and mm > 40.0:
            raise KeyboardInterrupt

    progress = StepProgress(trial_bench.config.store.directory, "X")
    operator = OperatorCallbacks(
        trial_bench.record_step, trial_bench.answer_question, results.__setitem__, stop_during_rapid
    )
    with pytest.raises(KeyboardInterrupt):
        try_axis(trial_bench.config, trial_bench.record, ROOM, operator, progress)
    stood_mm = trial_bench.position_mm
    assert stood_mm > 40.0
    assert results["room"]["return"] is None
    kept = progress.find_result("room", progress._steps["room"].holds_for)
    assert kept is not None
    moved = {**kept, "stopped_mm": stood_mm - 5.0}  # as if it was moved since, or the encoder lost its zero
    progress.save_step("room", progress._steps["room"].holds_for, moved)
    for _ in range(2):
        with pytest.raises(
            DriveFault, match=r"by the room of the interrupted trial, but --room is -2 to \+130 mm from here"
        ):
            trial_bench.run_trial()
    progress.save_step("room", progress._steps["room"].holds_for, kept)
    trial_bench.steps.clear()
    operator = OperatorCallbacks(
        trial_bench.record_step, trial_bench.answer_question, results.__setitem__, positions.append
    )
    tried = try_axis(
        trial_bench.config, trial_bench.record, ROOM, operator, StepProgress(trial_bench.config.store.directory, "X")
    )
    assert trial_bench.steps == ["timing", "return", "test rapids", "restore", "identification", "acceptance"]
    assert float(results["room"]["stands"].split()[0]) == pytest.approx(stood_mm, abs=0.02)
    assert (results["room"]["from"], results["room"]["to"]) == ("-2.000 mm", "130.000 mm")
    assert "toward minus at 20 mm/s" in str(results["room"]["return"])
    assert min(positions) > -2.0
    assert max(positions) < 130.0
    assert tried.found.keys() >= {"jog", "test rapids", "identification", "acceptance"}
    assert trial_bench.position_mm == pytest.approx(0.0, abs=0.05)


def test_trial_without_room_sends_nothing(trial_bench: TrialBench) -> None:
    trial_bench.peer.heard.clear()
    with pytest.raises(DriveFault, match="test rapids need 102 mm"):
        trial_bench.run_trial(TravelRoom(-50.0, 90.0))
    assert trial_bench.peer.heard == []


@pytest.mark.usefixtures("long_computation")
def test_nearer_software_limits_are_kept(trial_bench: TrialBench) -> None:
    trial_bench.peer.drive.overwrite_object(0x607D, 1, -3277)
    trial_bench.peer.drive.overwrite_object(0x607D, 2, 820_000)
    sign_off(trial_bench.config)
    record = load_record(trial_bench.config.store.directory, "X")
    assert record is not None
    trial_bench.record = record
    with pytest.raises(
        DriveFault, match=r"its position is 0.000 mm, limited to -1.\d* to 250.\d* mm by its software limits"
    ):
        trial_bench.run_trial()
    assert trial_bench.steps == ["timing"]


def test_reconfigured_drive_is_not_moved(trial_bench: TrialBench) -> None:
    trial_bench.peer.drive.overwrite_object(0x6065, 0, 30_000)
    with pytest.raises(DeviceError, match="following-error window"):
        trial_bench.run_trial()
    assert not {0x000, 0x080, 0x201} & set(trial_bench.peer.heard)


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize(
    ("step", "braking", "what"),
    [("jog", 22, "target"), ("jog", 22, "offset"), ("test rapids", 0, "SYNC"), ("test rapids", 0, "target")],
)
def test_another_master_ends_trial(step: str, braking: int, what: str, trial_bench: TrialBench) -> None:
    """Braked within its acceleration, switched off or left to the other master; the step is not stored."""

    def start_nc(frame: Frame) -> bool:
        return trial_bench.steps[-1:] == [step] and is_moving_frame(frame)

    trial_bench.saw = True
    progress = StepProgress(trial_bench.config.store.directory, "X")
    with ForeignNc(trial_bench.config.bus["can0"].channel, FOREIGN[what], start_nc) as nc:
        with pytest.raises(ForeignMaster, match="an NC is sending"):
            try_axis(
                trial_bench.config,
                trial_bench.record,
                ROOM,
                OperatorCallbacks(trial_bench.record_step, trial_bench.answer_question),
                progress,
            )
        assert nc.on
        assert nc.count_frames(SYNC) <= A_FEW + braking
        assert nc.count_frames(NMT) == nc.count_frames(SDO) == 0
        assert what != "target" or nc.count_frames(TARGET) == 0
    assert step not in progress.list_step_times()
