"""Faults and refusals end the trial of a simulated axis at standstill; a successful trial is in tests/cli."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from fdhil.commissioning.progress import Found, Progress
from fdhil.commissioning.record import CommissioningRecord, load_record
from fdhil.commissioning.strokes import Room
from fdhil.commissioning.trial import Operator, Trial, try_axis
from fdhil.config import MachineConfig
from fdhil.errors import DeviceError, DriveFault, ForeignMaster
from tests.commissioning.foreign_nc import A_FEW, FOREIGN, NMT, SDO, SYNC, TARGET, ForeignNc, Frame, moves
from tests.drivers.frame_builder import build_machine_config
from tests.drivers.peer import DrivePeer
from tests.integration.conftest import sign_off

ROOM = Room(-2.0, 130.0)


@dataclass
class Bench:
    """A signed-off simulated drive, and the questions to its operator."""

    peer: DrivePeer
    config: MachineConfig
    record: CommissioningRecord
    steps: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)
    saw: bool | None = None
    at: Callable[[str], None] = lambda _step: None

    def report(self, step: str) -> None:
        self.steps.append(step)
        self.at(step)

    def look(self, question: str) -> bool | None:
        self.asked.append(question)
        return self.saw

    def tried(self, room: Room = ROOM) -> Trial:
        """Run the trial; afterwards the axis is off and at standstill."""
        store = self.config.store.directory
        try:
            return try_axis(self.config, self.record, room, Operator(self.report, self.look), Progress(store, "X"))
        finally:
            assert self.peer.drive.power.state.name in ("SWITCH_ON_DISABLED", "FAULT")
            assert self.peer.drive.dictionary.get_number(0x60B0) == 0

    @property
    def stands_mm(self) -> float:
        return self.peer.drive.table_mm


@pytest.fixture
def quick_trial(quick_commissioning: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.commissioning.strokes.JOG_MM", 1.0)
    monkeypatch.setattr("fdhil.commissioning.trial.TIMING_CYCLES", 100)
    monkeypatch.setattr("fdhil.commissioning.trial.LAST_REST_S", 0.4)


@pytest.fixture
def bench(quick_trial: None, tmp_path: Path) -> Iterator[Bench]:
    bus: dict[str, object] = {"interface": "virtual", "channel": uuid.uuid4().hex}
    period = {"name": "bench", "sync_period_s": 0.002}
    config = build_machine_config(tmp_path, bus=bus, guard={"clock": "sync"}, machine=period)
    with DrivePeer(config) as peer:
        sign_off(config)
        record = load_record(config.store.directory, "X")
        assert record is not None
        yield Bench(peer, config, record)


@pytest.mark.usefixtures("long_computation")
def test_a_wrong_sign_and_what_nobody_saw_end_it_before_a_rapid(bench: Bench) -> None:
    bench.peer.drive.faults.get_signal_fault("voltage").gain = -1.0
    with pytest.raises(DriveFault, match="SignOrScale: voltage times current, and times speed is negative"):
        bench.tried()
    bench.peer.drive.faults.get_signal_fault("voltage").gain, bench.saw = 1.0, False
    with pytest.raises(DriveFault, match=r"the table did not move as the drive reports; check drive.sign"):
        bench.tried()
    assert "test rapids" not in bench.steps
    assert bench.stands_mm == pytest.approx(0.0, abs=0.05)
    assert Progress(bench.config.store.directory, "X").done().keys() == {"room"}
    with pytest.raises(DriveFault, match=r"limited to -2.05 to 130.05 mm by the room of the interrupted trial"):
        bench.tried(Room(-5.0, 130.0))


@pytest.mark.usefixtures("long_computation")
def test_stopped_trial_goes_on_within_the_room_that_it_began_with(bench: Bench) -> None:
    bench.saw, positions = True, list[float]()
    results: dict[str, Found] = {}

    def stop_in_the_rapid(mm: float) -> None:
        positions.append(mm)
        if bench.steps[-1] == "test rapids" and mm > 40.0:
            raise KeyboardInterrupt

    progress = Progress(bench.config.store.directory, "X")
    operator = Operator(bench.report, bench.look, results.__setitem__, stop_in_the_rapid)
    with pytest.raises(KeyboardInterrupt):
        try_axis(bench.config, bench.record, ROOM, operator, progress)
    stood_mm = bench.stands_mm
    assert stood_mm > 40.0
    assert results["room"]["return"] is None
    kept = progress.found("room", progress._steps["room"].holds_for)
    assert kept is not None
    moved = {**kept, "stopped_mm": stood_mm - 5.0}  # as if it was moved since, or the encoder lost its zero
    progress.keep("room", progress._steps["room"].holds_for, moved)
    for _ in range(2):
        with pytest.raises(
            DriveFault, match=r"by the room of the interrupted trial, but --room is -2 to \+130 mm from here"
        ):
            bench.tried()
    progress.keep("room", progress._steps["room"].holds_for, kept)
    bench.steps.clear()
    operator = Operator(bench.report, bench.look, results.__setitem__, positions.append)
    tried = try_axis(bench.config, bench.record, ROOM, operator, Progress(bench.config.store.directory, "X"))
    assert bench.steps == ["timing", "return", "test rapids", "restore", "identification", "acceptance"]
    assert float(results["room"]["stands"].split()[0]) == pytest.approx(stood_mm, abs=0.02)
    assert (results["room"]["from"], results["room"]["to"]) == ("-2.000 mm", "130.000 mm")
    assert "toward minus at 20 mm/s" in str(results["room"]["return"])
    assert min(positions) > -2.0
    assert max(positions) < 130.0
    assert tried.found.keys() >= {"jog", "test rapids", "identification", "acceptance"}
    assert bench.stands_mm == pytest.approx(0.0, abs=0.05)


def test_no_room_sends_nothing(bench: Bench) -> None:
    bench.peer.heard.clear()
    with pytest.raises(DriveFault, match="test rapids need 102 mm"):
        bench.tried(Room(-50.0, 90.0))
    assert bench.peer.heard == []


@pytest.mark.usefixtures("long_computation")
def test_software_limits_that_are_nearer_are_respected(bench: Bench) -> None:
    bench.peer.drive.overwrite_object(0x607D, 1, -3277)
    bench.peer.drive.overwrite_object(0x607D, 2, 820_000)
    sign_off(bench.config)
    record = load_record(bench.config.store.directory, "X")
    assert record is not None
    bench.record = record
    with pytest.raises(
        DriveFault, match=r"its position is 0.000 mm, limited to -1.\d* to 250.\d* mm by its software limits"
    ):
        bench.tried()
    assert bench.steps == ["timing"]


def test_a_drive_that_was_set_up_anew_is_not_moved(bench: Bench) -> None:
    bench.peer.drive.overwrite_object(0x6065, 0, 30_000)
    with pytest.raises(DeviceError, match="following-error window"):
        bench.tried()
    assert not {0x000, 0x080, 0x201} & set(bench.peer.heard)


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize(
    ("step", "braking", "what"),
    [("jog", 22, "target"), ("jog", 22, "offset"), ("test rapids", 0, "SYNC"), ("test rapids", 0, "target")],
)
def test_another_master_ends_the_trial(step: str, braking: int, what: str, bench: Bench) -> None:
    """Braked within its acceleration, switched off or left to the other master; the step is not stored."""

    def begins(frame: Frame) -> bool:
        return bench.steps[-1:] == [step] and moves(frame)

    bench.saw = True
    progress = Progress(bench.config.store.directory, "X")
    with ForeignNc(bench.config.bus["can0"].channel, FOREIGN[what], begins) as nc:
        with pytest.raises(ForeignMaster, match="an NC is sending"):
            try_axis(bench.config, bench.record, ROOM, Operator(bench.report, bench.look), progress)
        assert nc.on
        assert nc.count(SYNC) <= A_FEW + braking
        assert nc.count(NMT) == nc.count(SDO) == 0
        assert what != "target" or nc.count(TARGET) == 0
    assert step not in progress.done()
