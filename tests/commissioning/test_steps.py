"""Commissioning of a simulated drive: a good one is signed off, every wrong set-up is refused with its reason."""

from __future__ import annotations

import itertools
import signal
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from typing import Any

import can
import numpy as np
import pytest

from fdhil.cia402 import Object, PowerState
from fdhil.commissioning import commissioning_steps, drive_survey
from fdhil.commissioning import watchdog as watchdog_module
from fdhil.commissioning.axis_motion import EMCY_HEARTBEAT
from fdhil.commissioning.commissioning_steps import (
    check_axis,
    commission_axis,
    enable_drive,
    prepare_drive,
    roll_back_afterwards,
    run_feedforward_test,
    run_sign_test,
)
from fdhil.commissioning.master import Master
from fdhil.commissioning.sync_cycle import SyncCycle
from fdhil.commissioning.watchdog import FEEDING_TRIES, run_watchdog_test
from fdhil.config import CorrectionLimits, MachineConfig
from fdhil.errors import ConnectError, DeviceError, DeviceTimeout, DriveFault, ProtocolError
from tests.drivers.frame_builder import build_machine_config
from tests.drivers.peer import DrivePeer
from tests.tiers import sampled

pytestmark = pytest.mark.usefixtures("fast_commissioning")


def build_config(**sections: Any) -> MachineConfig:
    """The drive shares a busy computer: it is waited for like any simulated drive, and tolerates a late heartbeat."""
    sections = {"guard": {"clock": "sync", "heartbeat_s": 0.1}, **sections}
    return build_machine_config(bus={"interface": "virtual", "channel": uuid.uuid4().hex}, **sections)


@pytest.fixture
def peer() -> Iterator[tuple[DrivePeer, MachineConfig]]:
    settings = build_config()
    with DrivePeer(settings) as running:
        yield running, settings


@pytest.mark.usefixtures("long_computation")
def test_correct_drive_is_signed_off_and_restored(peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    consumers = [drive.drive.dictionary.get_number(0x1016, sub) for sub in (1, 2, 3, 4)]
    steps: list[str] = []
    record = commission_axis(settings, "X", steps.append)
    assert record.offset_in_feedforward is True
    assert record.watchdog == "proven"
    assert record.sign_test_um == pytest.approx(10.0, abs=3.0)
    assert record.options == {"6007": 1, "605A": 2, "605E": 2, "6065": 32768, "6085": 26214400, "1017": 100}
    assert record.serial == drive.drive.dictionary.get_number(0x1018, 4)
    assert record.following_error_window_um == 10_000.0
    assert steps[0] == "listen"
    assert steps[-1] == "restore"
    assert drive.drive.power.state.name == "SWITCH_ON_DISABLED"
    time.sleep(0.01)  # the peer has yet to process the last command
    assert drive.drive.nmt == 0x7F
    assert drive.drive.dictionary.get_number(0x60B0) == 0
    assert [drive.drive.dictionary.get_number(0x1016, sub) for sub in (1, 2, 3, 4)] == consumers


@pytest.mark.usefixtures("long_computation")
def test_drive_that_boots_during_commissioning_is_not_signed_off(peer: tuple[DrivePeer, MachineConfig]) -> None:
    _, settings = peer

    def boot(step: str) -> None:
        if step == "restore":
            with can.Bus(next(iter(settings.bus.values())).channel, "virtual") as drive:
                drive.send(can.Message(arbitration_id=0x701, data=[0], is_extended_id=False))

    with pytest.raises(DriveFault, match="it has booted since it was compared"):
        commission_axis(settings, "X", boot)


class SleepyPeer(DrivePeer):
    """A simulated drive whose process occasionally sleeps, as on a busy computer, until its watchdog is tested."""

    def handle_frame(self, can_id: int, data: bytes) -> list[tuple[int, bytes]]:
        """Sleep longer than any averaging time at every 40th of the first 400 SYNCs."""
        count = self.heard.count(0x080)
        if can_id == 0x080 and count % 40 == 0 and count <= 400:
            time.sleep(0.15)
        return super().handle_frame(can_id, data)


@pytest.mark.usefixtures("long_computation")
def test_sleeping_simulated_drive_is_waited_for() -> None:
    settings = build_config()
    with SleepyPeer(settings), Master(settings, "X") as master:
        prepare_drive(master)
        enable_drive(master)
        assert run_sign_test(master) == pytest.approx(10.0, abs=3.0)


class SlowPeer(DrivePeer):
    """A simulated drive that sends frame by frame and sleeps through many SYNCs on request."""

    sleeping_s = 0.0

    def handle_frame(self, can_id: int, data: bytes) -> list[tuple[int, bytes]]:
        if can_id == 0x080 and self.sleeping_s:
            time.sleep(self.sleeping_s)
            self.sleeping_s = 0.0
        return super().handle_frame(can_id, data)

    def _send(self, frames: list[tuple[int, bytes]]) -> None:
        for frame in frames:
            time.sleep(0.002)
            super()._send([frame])


@pytest.mark.usefixtures("long_computation")
def test_simulated_drive_answers_one_sync_at_a_time_after_sleep(monkeypatch: pytest.MonkeyPatch) -> None:
    """The TPDOs of every tenth SYNC are waited for as well: a guard counts in which SYNC they arrive."""
    settings = build_config()
    place = next(iter(settings.bus.values())).channel
    with SlowPeer(settings) as peer, Master(settings, "X") as master, can.Bus(place, "virtual") as listener:
        prepare_drive(master)
        with monkeypatch.context() as impatient:
            impatient.setattr("fdhil.commissioning.sync_cycle.LOCKSTEP_WAIT_S", 0.05)
            peer.sleeping_s = 0.2
            master.wait_cycles(50)  # most of them while it slept
        master.wait_until(lambda: not master.unanswered_syncs, 10.0, "it sleeps on")
        master.wait_cycles(10)  # one until it has caught up
        while listener.recv(0) is not None:
            pass
        master.wait_cycles(40)
        received = []
        while (message := listener.recv(0)) is not None:
            if message.arbitration_id in (0x080, 0x181, 0x281, 0x381, 0x481):
                received.append(message.arbitration_id)
    syncs = [k for k, can_id in enumerate(received) if can_id == 0x080]
    answers = [tuple(received[a + 1 : b]) for a, b in itertools.pairwise(syncs)]
    assert len(answers) > 30
    assert set(answers) == {(0x181, 0x281), (0x181, 0x281, 0x381, 0x481)}
    rarely = [k for k, each in enumerate(answers) if len(each) == 4]
    assert set(np.diff(rarely)) == {10}


def test_object_without_tpdo_is_reported() -> None:
    settings = build_config(guard={})
    with Master(settings, "X") as master, pytest.raises(DeviceTimeout, match="0x6064 is no longer received; check"):
        master.average_object(master.profile.position, 10)


def test_software_limits_are_recorded_if_present(peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    with Master(settings, "X") as master:
        assert not {"607D01", "607D02"} & drive_survey.read_options(master).keys()
        drive.drive.overwrite_object(0x607D, 1, -1000)
        drive.drive.overwrite_object(0x607D, 2, 820_000)
        found = drive_survey.read_options(master)
        assert (found["607D01"], found["607D02"]) == (-1000, 820_000)
        drive.drive.overwrite_object(0x607D, 2, -1000)  # both equal: switched off (CiA 402-2)
        assert "607D01" not in drive_survey.read_options(master)


def test_offset_outside_feedforward_is_detected() -> None:
    settings = build_config(sim={"axis": {"X": {"offset_in_feedforward": False}}})
    with DrivePeer(settings), Master(settings, "X") as master, roll_back_afterwards(master):
        prepare_drive(master)
        enable_drive(master)
        assert run_feedforward_test(master) is False


def test_drive_with_negative_sign_passes() -> None:
    settings = build_config(drive={"sign": -1})
    with DrivePeer(settings), Master(settings, "X") as master, roll_back_afterwards(master):
        check_axis(master)
        prepare_drive(master)
        enable_drive(master)
        assert run_sign_test(master) == pytest.approx(10.0, abs=3.0)


def start_watchdog_test(master: Master) -> str:
    return run_watchdog_test(master, enable_drive)


def run_steps(master: Master, last: Callable[[Master], object]) -> None:
    with roll_back_afterwards(master):
        prepare_drive(master)
        enable_drive(master)
        last(master)


WRONG: dict[str, tuple[Callable[[DrivePeer], None], str]] = {
    "goes on without communication": (lambda p: p.drive.overwrite_object(0x6007, 0, 0), "0x6007 is 0"),
    "disables voltage instead": (lambda p: p.drive.overwrite_object(0x6007, 0, 2), "0x6007 is 2"),
    "coasts": (lambda p: p.drive.overwrite_object(0x605E, 0, 0), "coasts"),
    "quick stop coasts": (lambda p: p.drive.overwrite_object(0x605A, 0, 0), "coasts"),
    "window off": (lambda p: p.drive.overwrite_object(0x6065, 0, 0xFFFFFFFF), "0x6065 is off"),
    "window zero": (lambda p: p.drive.overwrite_object(0x6065, 0, 0), "0x6065 is off"),
    "window too small": (lambda p: p.drive.overwrite_object(0x6065, 0, 300), "too small"),
    "gear x 10": (lambda p: p.drive.overwrite_object(0x6091, 1, 10), "6553.6 position increments per motor revolution"),
    "feed x 10": (
        lambda p: p.drive.overwrite_object(0x6092, 1, 655360),
        "655360 position increments per motor revolution",
    ),
    "mapping": (
        lambda p: p.drive.overwrite_mapping(0x1A01, [(0x6041, 0, 16), (0x2101, 0, 16), (0x6078, 0, 16)]),
        "TPDO2 maps 60410010, 21010010, 60780010",
    ),
    "transmission type": (lambda p: p.drive.overwrite_object(0x1800, 2, 255), "TPDO1 has transmission type 255"),
    "COB-ID": (lambda p: p.drive.overwrite_object(0x1401, 1, 0x305), "RPDO2 has the COB-ID 00000305"),
    "PDO switched off": (lambda p: p.drive.overwrite_object(0x1401, 1, 0x80000301), "RPDO2 has the COB-ID 80000301"),
    "rated current": (lambda p: p.drive.overwrite_object(0x6075, 0, 10_000), "rated current is 10 A"),
    "no CSP": (lambda p: p.drive.overwrite_object(0x6502, 0, 1), "no cyclic synchronous position"),
    "other period": (lambda p: p.drive.overwrite_object(0x60C2, 1, 2), "interpolates over 2 ms"),
}


@pytest.mark.parametrize("what", sampled(WRONG, every=3))
@pytest.mark.fault("A17", "E16")
def test_wrong_setup_is_refused_before_motion(what: str, peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    spoil, says = WRONG[what]
    spoil(drive)
    with Master(settings, "X") as master, pytest.raises(DeviceError) as caught:
        check_axis(master)
    assert says in str(caught.value)
    assert not {0x000, 0x080, 0x201, 0x301} & set(drive.heard)


def double_offset(peer: DrivePeer) -> None:
    peer.drive.faults.offset_scale = 2.0


def negate_offset(peer: DrivePeer) -> None:
    peer.drive.faults.offset_scale = -1.0


def lose_offset(peer: DrivePeer) -> None:
    peer.drive.faults.ignore_offset = True


def refuse_csp(peer: DrivePeer) -> None:
    peer.drive.faults.not_csp = True


class ImpatientMaster(Master):
    """A master that waits for the mode only as long as for a real drive, since its drive never reports it."""

    def wait_until(self, condition: Callable[[], bool], timeout_s: float, otherwise: str) -> None:
        never = "the mode" in otherwise
        super().wait_until(condition, timeout_s / self.patience if never else timeout_s, otherwise)


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (double_offset, "does not add 0x60B0"),
        (negate_offset, "does not add 0x60B0"),
        (lose_offset, "0x60B0 holds 0"),
        (refuse_csp, "does not enter the mode"),
    ],
)
@pytest.mark.fault("E16")
def test_drive_with_faulty_offset_is_refused_and_disabled(
    spoil: Callable[[DrivePeer], None], says: str, peer: tuple[DrivePeer, MachineConfig]
) -> None:
    drive, settings = peer
    spoil(drive)
    kind = ImpatientMaster if spoil is refuse_csp else Master
    with kind(settings, "X") as master, pytest.raises(DeviceError) as caught:
        run_steps(master, run_sign_test)
    assert says in str(caught.value)
    assert drive.drive.power.state.name == "SWITCH_ON_DISABLED"
    assert drive.drive.dictionary.get_number(0x60B0) == 0


@pytest.mark.usefixtures("long_computation")
@pytest.mark.fault("E14")
def test_drive_without_working_watchdog_is_refused(
    peer: tuple[DrivePeer, MachineConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fdhil.commissioning.watchdog.STARVE_TIMEOUT_S", 0.05)  # it never stops
    drive, settings = peer
    drive.drive.faults.no_heartbeat_consumer = True
    with Master(settings, "X") as master, pytest.raises(DriveFault, match="watchdog does not work"):
        run_steps(master, start_watchdog_test)
    assert [drive.drive.dictionary.get_number(0x1016, sub) for sub in (1, 2, 3, 4)] == [0, 0, 0, 0]


class LateCycle(SyncCycle):
    """A cycle on a delayed computer: in the first ``late`` attempts no heartbeat follows the first one."""

    master: Master
    late = 0
    trip: Callable[[], None] | None = None
    feedings = 0
    _beating = False

    def _send_heartbeat(self) -> None:
        beats = self.heartbeat is not None
        if beats and not self._beating:
            self.feedings += 1
            if self.trip is not None:
                self.trip()
            super()._send_heartbeat()
        self._beating = beats
        if self.feedings > self.late:
            super()._send_heartbeat()


@pytest.fixture
def heartbeat_master(peer: tuple[DrivePeer, MachineConfig], monkeypatch: pytest.MonkeyPatch) -> Iterator[LateCycle]:
    """A master that sends heartbeats for a short time; afterwards the drive's monitoring and power are off."""
    monkeypatch.setattr("fdhil.commissioning.watchdog.FEEDING_S", 0.6)
    drive, settings = peer
    cycle = LateCycle(settings, settings.bus)
    cycle.master = Master(settings, "X", cycle)
    with cycle:
        yield cycle
    assert drive.drive.power.state.name in ("SWITCH_ON_DISABLED", "FAULT")
    assert [drive.drive.dictionary.get_number(0x1016, sub) for sub in (1, 2, 3, 4)] == [0, 0, 0, 0]


@pytest.mark.usefixtures("long_computation")
def test_late_heartbeat_of_computer_is_retried(heartbeat_master: LateCycle) -> None:
    heartbeat_master.late = 2
    run_steps(heartbeat_master.master, lambda m: start_watchdog_test(m) == "proven" or pytest.fail("not proven"))
    assert heartbeat_master.feedings == 3


@pytest.mark.usefixtures("long_computation")
def test_computer_that_is_always_late_is_reported(heartbeat_master: LateCycle) -> None:
    heartbeat_master.late = 99
    with pytest.raises(DriveFault, match="missed fdhil's heartbeat 4 times; reduce this computer's load"):
        run_steps(heartbeat_master.master, start_watchdog_test)
    assert heartbeat_master.feedings == FEEDING_TRIES


@pytest.mark.usefixtures("long_computation")
def test_drive_fault_during_heartbeat_is_not_retried(
    heartbeat_master: LateCycle, peer: tuple[DrivePeer, MachineConfig]
) -> None:
    heartbeat_master.trip = lambda: peer[0].drive.trip_fault(0x3210)
    with pytest.raises(DriveFault, match="it fell from Operation enabled to Fault"):
        run_steps(heartbeat_master.master, start_watchdog_test)
    assert heartbeat_master.feedings == 1


@pytest.mark.usefixtures("long_computation")
def test_late_heartbeat_after_feeding_proves_watchdog(
    heartbeat_master: LateCycle, peer: tuple[DrivePeer, MachineConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    feed = watchdog_module._feed_heartbeat

    def feed_then_delay(master: Master, sub: int, entry: int, enable: Callable[[Master], None]) -> int:
        before = feed(master, sub, entry, enable)
        peer[0].drive.trip_fault(EMCY_HEARTBEAT)
        master.wait_cycles(20)
        return before

    monkeypatch.setattr(watchdog_module, "_feed_heartbeat", feed_then_delay)
    run_steps(heartbeat_master.master, lambda m: start_watchdog_test(m) == "proven" or pytest.fail("not proven"))


class SlowReader(Master):
    """A master on a busy computer: the first ``slow`` readings of the speed demand arrive too late."""

    slow = 0
    late_cycles = 2 * commissioning_steps.EARLY_CYCLES + commissioning_steps.RAMP_CYCLES
    readings = 0

    def __init__(self, config: MachineConfig, axis: str) -> None:
        super().__init__(config, axis)
        self._read_int = self.sdo.read_int
        monkey: Any = self.sdo
        monkey.read_int = self.read_int

    def read_int(self, index: int, sub: int = 0, *, signed: bool = False) -> int:
        value = self._read_int(index, sub, signed=signed)
        if index == Object.VELOCITY_DEMAND:
            self.readings += 1
            if self.readings <= self.slow:
                self.wait_cycles(self.late_cycles)
        return value


@pytest.mark.usefixtures("long_computation")
def test_ramp_with_missed_start_is_repeated(peer: tuple[DrivePeer, MachineConfig]) -> None:
    _, settings = peer
    with SlowReader(settings, "X") as master, roll_back_afterwards(master):
        prepare_drive(master)
        enable_drive(master)
        master.slow = 2 * commissioning_steps.TRIAL_RAMPS
        assert run_feedforward_test(master) is True
        assert master.readings > 3 * commissioning_steps.TRIAL_RAMPS


@pytest.mark.usefixtures("long_computation")
def test_feedforward_without_captured_ramp_is_undetermined(
    peer: tuple[DrivePeer, MachineConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(commissioning_steps, "MOST_RAMPS", 1)
    _, settings = peer
    with SlowReader(settings, "X") as master, roll_back_afterwards(master):
        prepare_drive(master)
        enable_drive(master)
        master.slow = 1_000_000
        assert run_feedforward_test(master) is None
        assert (
            master.readings == 1 + commissioning_steps.MOST_RAMPS * master.patience
        )  # the object exists, and one reading per ramp


@pytest.mark.usefixtures("long_computation")
def test_reading_before_ramp_does_not_count_as_missing_feedforward(
    peer: tuple[DrivePeer, MachineConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(commissioning_steps, "MOST_RAMPS", 1)
    _, settings = peer
    with SlowReader(settings, "X") as master, roll_back_afterwards(master):
        prepare_drive(master)
        enable_drive(master)
        master.slow = 1_000_000
        master.late_cycles = commissioning_steps.EARLY_CYCLES + 4  # read before the ramp, received during it
        assert run_feedforward_test(master) is None


def test_mean_over_missed_cycles_uses_received_values(
    peer: tuple[DrivePeer, MachineConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, settings = peer
    with Master(settings, "X") as master:
        prepare_drive(master)
        position = master.profile.position
        master.wait_until(lambda: position in master.feedback.objects, 5.0, "no position comes")

        def skip_cycles(asked: Master) -> int:
            """Return the cycle; at this thread's first call skip twenty cycles."""
            now = asked.loop.count
            if threading.current_thread() is threading.main_thread():
                monkeypatch.undo()
                asked.wait_cycles(20)
            return now

        monkeypatch.setattr(Master, "cycle", property(skip_cycles))
        assert master.average_object(position, 10) == pytest.approx(master.feedback.objects[position], abs=2.0)


def test_full_heartbeat_consumers_are_refused(peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    for sub in (1, 2, 3, 4):
        drive.drive.overwrite_object(0x1016, sub, (10 + sub) << 16 | 500)
    with Master(settings, "X") as master, pytest.raises(DriveFault, match="all entries of 0x1016 are in use"):
        start_watchdog_test(master)


@pytest.mark.parametrize(
    ("can_id", "shown"), [(0x080, "SYNC or set-points"), (0x302, "SYNC or set-points"), (0x605, "SDO requests")]
)
def test_nothing_is_sent_while_nc_is_on_bus(can_id: int, shown: str, peer: tuple[DrivePeer, MachineConfig]) -> None:
    """Every frame that only a master sends counts, also to another drive with its own SDO channels."""
    drive, settings = peer
    with can.Bus(interface="virtual", channel=settings.bus["can0"].channel) as nc, Master(settings, "X") as master:
        nc.send(can.Message(arbitration_id=can_id, is_extended_id=False))
        with pytest.raises(ProtocolError, match=f"an NC is sending {shown}"):
            drive_survey.listen_for_master(master)
    while not drive.heard:
        time.sleep(0.01)
    assert drive.heard == [can_id]  # the NC's own


@pytest.mark.fault("A29")
def test_only_device_type_is_read_on_silent_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.drivers.can.sdo_channel.RESPONSE_TIMEOUT_S", 0.01)  # receives nothing
    settings = build_config()
    with can.Bus(interface="virtual", channel=settings.bus["can0"].channel) as other:
        with pytest.raises(ConnectError, match=r"no frame was received on the bus and node-ID 1 did not answer; check"):
            commission_axis(settings, "X")
        sent = {(m.arbitration_id, bytes(m.data)) for m in iter(lambda: other.recv(0), None)}
        read, given_up = b"\x40\x00\x10\0\0\0\0\0", b"\x80\0\0\0\0\0\x04\x05"
        assert sent == {(0x601, read), (0x601, given_up)}


@pytest.mark.fault("A29")
def test_bus_with_other_bit_rate_gets_no_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drive_survey, "LISTEN_S", 2.0)
    settings = build_config()
    with can.Bus(interface="virtual", channel=settings.bus["can0"].channel) as other:
        with Master(settings, "X") as master:
            other.send(can.Message(arbitration_id=0x4, data=bytes(8), is_error_frame=True))
            master.wait_until(lambda: master.feedback.errors > 0, 5.0, "no frame in error")
            with pytest.raises(
                ConnectError,
                match=r"only error frames are received, so the bit rate is probably wrong; nothing was sent",
            ):
                drive_survey.listen_for_master(master)
        assert other.recv(0) is None


@pytest.mark.usefixtures("long_computation")
def test_drive_without_heartbeat_is_commissioned(peer: tuple[DrivePeer, MachineConfig]) -> None:
    """Many drives are delivered with 0x1017 = 0: with the NC off they send nothing until they are read."""
    drive, settings = peer
    drive.drive.overwrite_object(0x1017, 0, 0)
    record = commission_axis(settings, "X")
    assert (record.watchdog, record.options["1017"]) == ("proven", 0)


def test_silent_drive_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.drivers.can.sdo_channel.RESPONSE_TIMEOUT_S", 0.01)  # receives nothing
    settings = build_config(drive={"node_id": 9})
    with can.Bus(interface="virtual", channel=settings.bus["can0"].channel) as other:
        other.send(can.Message(arbitration_id=0x701, data=[5], is_extended_id=False))
        with Master(settings, "X") as master, pytest.raises(DeviceError, match=r"drive X: .* was not answered"):
            master.sdo.read_int(Object.IDENTITY, 1)


def test_power_states_have_names(peer: tuple[DrivePeer, MachineConfig]) -> None:
    _, settings = peer
    with Master(settings, "X") as master, roll_back_afterwards(master):
        prepare_drive(master)
        assert master.get_power_state() is PowerState.SWITCH_ON_DISABLED
        enable_drive(master)
        assert master.get_power_state() is PowerState.OPERATION_ENABLED


@pytest.mark.fault("E16")
@pytest.mark.parametrize("per_mm", [40, 90])
def test_scaling_coarser_than_10_um_is_refused_before_motion(per_mm: int) -> None:
    settings = build_config(drive={"increments_per_rev": 20 * per_mm})
    with (
        DrivePeer(settings) as drive,
        pytest.raises(DriveFault, match=r"its scaling is too coarse .* finer resolution"),
    ):
        commission_axis(settings, "X")
    assert not {0x000, 0x080, 0x201, 0x301} & set(drive.heard)


class OffsetRecorder(DrivePeer):
    """A simulated drive that records every offset and raises Ctrl-C at ``interrupt_at``."""

    def __init__(self, config: MachineConfig, interrupt_at: int | None = None) -> None:
        super().__init__(config)
        self.offsets = [0]
        self.interrupt_at: int | None = interrupt_at

    def handle_frame(self, can_id: int, data: bytes) -> list[tuple[int, bytes]]:
        if can_id == 0x301:
            self.offsets.append(int.from_bytes(data[:4], "little", signed=True))
            if self.offsets[-1] == self.interrupt_at:
                self.interrupt_at = None
                signal.raise_signal(signal.SIGINT)
        return super().handle_frame(can_id, data)


def enable_and_roll_back(settings: MachineConfig, step: Callable[[Master], object]) -> None:
    with Master(settings, "X") as master, roll_back_afterwards(master):
        prepare_drive(master)
        enable_drive(master)
        step(master)


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("interrupt_at", [12, 33])
def test_interrupted_ramp_returns_from_reached_offset(interrupt_at: int) -> None:
    settings = build_config()
    with OffsetRecorder(settings, interrupt_at) as drive:
        with pytest.raises(KeyboardInterrupt):
            enable_and_roll_back(settings, run_sign_test)
        offsets = drive.offsets
    assert max(map(abs, np.diff(offsets))) <= 20  # never a step from an old plan to a new one
    assert max(offsets) <= 33
    assert offsets[-1] == 0
    assert drive.drive.power.state.name == "SWITCH_ON_DISABLED"


def test_offset_is_zeroed_within_acceleration() -> None:
    settings = build_config()
    fast = settings.axis["X"].model_copy(update={"correction": CorrectionLimits(max_speed_mm_s=20.0)})
    settings = settings.model_copy(update={"axis": {"X": fast}})
    with OffsetRecorder(settings) as drive:
        enable_and_roll_back(settings, lambda master: commissioning_steps.ramp_offset(master, 150, 1))
    assert max(drive.offsets) == 150
    assert np.diff(drive.offsets).min() < -5  # 0.8 increments per cycle squared, plus rounding
    assert np.abs(np.diff(drive.offsets, 2)).max() <= 2


def test_ctrl_c_during_rollback_is_raised_afterwards() -> None:
    settings = build_config()
    with OffsetRecorder(settings) as drive:

        def interrupt_rollback(master: Master) -> None:
            commissioning_steps.ramp_offset(master, 30, 1)
            drive.interrupt_at = 14  # on the way back

        with pytest.raises(KeyboardInterrupt):
            enable_and_roll_back(settings, interrupt_rollback)
        assert drive.offsets[-1] == 0
    assert drive.drive.power.state.name == "SWITCH_ON_DISABLED"
    assert drive.drive.dictionary.get_number(0x60B0) == 0


def test_failed_rollback_after_ctrl_c_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = build_config()

    def fail_disable(master: Master) -> None:
        raise DriveFault(master.device, "it still holds an offset")

    monkeypatch.setattr(commissioning_steps, "zero_offset", fail_disable)
    left = pytest.raises(ProtocolError, match="interrupted; the drive could not be restored")
    with DrivePeer(settings), left, Master(settings, "X") as master, roll_back_afterwards(master):
        raise KeyboardInterrupt
