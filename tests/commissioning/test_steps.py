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
from fdhil.commissioning import steps, survey
from fdhil.commissioning import watchdog as watchdog_module
from fdhil.commissioning.cycle import Cycle
from fdhil.commissioning.master import Master
from fdhil.commissioning.moving import EMCY_HEARTBEAT
from fdhil.commissioning.steps import (
    check_axis,
    commission,
    enable,
    feedforward_test,
    prepare,
    rolled_back,
    sign_test,
)
from fdhil.commissioning.watchdog import FEEDING_TRIES, watchdog_test
from fdhil.config import CorrectionLimits, MachineConfig
from fdhil.errors import ConnectError, DeviceError, DeviceTimeout, DriveFault, ProtocolError
from tests.drivers.frame_builder import build_machine_config
from tests.drivers.peer import DrivePeer
from tests.tiers import sampled

pytestmark = pytest.mark.usefixtures("quick_commissioning")


def config(**sections: Any) -> MachineConfig:
    """The drive shares a busy computer: it is waited for like any simulated drive, and tolerates a late heartbeat."""
    sections = {"guard": {"clock": "sync", "heartbeat_s": 0.1}, **sections}
    return build_machine_config(bus={"interface": "virtual", "channel": uuid.uuid4().hex}, **sections)


@pytest.fixture
def peer() -> Iterator[tuple[DrivePeer, MachineConfig]]:
    settings = config()
    with DrivePeer(settings) as running:
        yield running, settings


@pytest.mark.usefixtures("long_computation")
def test_a_good_drive_is_signed_off_and_left_as_it_was(peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    consumers = [drive.drive.dictionary.get_number(0x1016, sub) for sub in (1, 2, 3, 4)]
    steps: list[str] = []
    record = commission(settings, "X", steps.append)
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
def test_a_drive_that_boots_while_it_is_commissioned_is_not_signed_off(peer: tuple[DrivePeer, MachineConfig]) -> None:
    _, settings = peer

    def boot(step: str) -> None:
        if step == "restore":
            with can.Bus(next(iter(settings.bus.values())).channel, "virtual") as drive:
                drive.send(can.Message(arbitration_id=0x701, data=[0], is_extended_id=False))

    with pytest.raises(DriveFault, match="it has booted since it was compared"):
        commission(settings, "X", boot)


class SleepyPeer(DrivePeer):
    """A simulated drive whose process occasionally sleeps, as on a busy computer, until its watchdog is tested."""

    def handle_frame(self, can_id: int, data: bytes) -> list[tuple[int, bytes]]:
        """Sleep longer than any averaging time at every 40th of the first 400 SYNCs."""
        count = self.heard.count(0x080)
        if can_id == 0x080 and count % 40 == 0 and count <= 400:
            time.sleep(0.15)
        return super().handle_frame(can_id, data)


@pytest.mark.usefixtures("long_computation")
def test_a_simulated_drive_may_sleep() -> None:
    settings = config()
    with SleepyPeer(settings), Master(settings, "X") as master:
        prepare(master)
        enable(master)
        assert sign_test(master) == pytest.approx(10.0, abs=3.0)


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
def test_a_simulated_drive_that_slept_answers_one_sync_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """The TPDOs of every tenth SYNC are waited for as well: a guard counts in which SYNC they arrive."""
    settings = config()
    place = next(iter(settings.bus.values())).channel
    with SlowPeer(settings) as peer, Master(settings, "X") as master, can.Bus(place, "virtual") as listener:
        prepare(master)
        with monkeypatch.context() as impatient:
            impatient.setattr("fdhil.commissioning.cycle.LOCKSTEP_WAIT_S", 0.05)
            peer.sleeping_s = 0.2
            master.wait_cycles(50)  # most of them while it slept
        master.wait(lambda: not master.behind, 10.0, "it sleeps on")
        master.wait_cycles(10)  # one until it has caught up
        while listener.recv(0) is not None:
            pass
        master.wait_cycles(40)
        heard = []
        while (message := listener.recv(0)) is not None:
            if message.arbitration_id in (0x080, 0x181, 0x281, 0x381, 0x481):
                heard.append(message.arbitration_id)
    syncs = [k for k, can_id in enumerate(heard) if can_id == 0x080]
    answers = [tuple(heard[a + 1 : b]) for a, b in itertools.pairwise(syncs)]
    assert len(answers) > 30
    assert set(answers) == {(0x181, 0x281), (0x181, 0x281, 0x381, 0x481)}
    seldom = [k for k, each in enumerate(answers) if len(each) == 4]
    assert set(np.diff(seldom)) == {10}


def test_an_object_that_no_tpdo_brings_is_told() -> None:
    settings = config(guard={})
    with Master(settings, "X") as master, pytest.raises(DeviceTimeout, match="0x6064 is no longer received; check"):
        master.average(master.profile.position, 10)


def test_software_limits_are_kept_where_the_drive_has_them(peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    with Master(settings, "X") as master:
        assert not {"607D01", "607D02"} & survey.read_options(master).keys()
        drive.drive.overwrite_object(0x607D, 1, -1000)
        drive.drive.overwrite_object(0x607D, 2, 820_000)
        found = survey.read_options(master)
        assert (found["607D01"], found["607D02"]) == (-1000, 820_000)
        drive.drive.overwrite_object(0x607D, 2, -1000)  # both equal: switched off (CiA 402-2)
        assert "607D01" not in survey.read_options(master)


def test_an_offset_kept_out_of_the_feedforward_is_noticed() -> None:
    settings = config(sim={"axis": {"X": {"offset_in_feedforward": False}}})
    with DrivePeer(settings), Master(settings, "X") as master, rolled_back(master):
        prepare(master)
        enable(master)
        assert feedforward_test(master) is False


def test_a_drive_that_counts_against_the_axis_passes() -> None:
    settings = config(drive={"sign": -1})
    with DrivePeer(settings), Master(settings, "X") as master, rolled_back(master):
        check_axis(master)
        prepare(master)
        enable(master)
        assert sign_test(master) == pytest.approx(10.0, abs=3.0)


def watchdog(master: Master) -> str:
    return watchdog_test(master, enable)


def run_steps(master: Master, last: Callable[[Master], object]) -> None:
    with rolled_back(master):
        prepare(master)
        enable(master)
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
def test_a_wrong_set_up_is_refused_before_anything_moves(what: str, peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    spoil, says = WRONG[what]
    spoil(drive)
    with Master(settings, "X") as master, pytest.raises(DeviceError) as caught:
        check_axis(master)
    assert says in str(caught.value)
    assert not {0x000, 0x080, 0x201, 0x301} & set(drive.heard)


def offset_doubled(peer: DrivePeer) -> None:
    peer.drive.faults.offset_scale = 2.0


def offset_negated(peer: DrivePeer) -> None:
    peer.drive.faults.offset_scale = -1.0


def offset_lost(peer: DrivePeer) -> None:
    peer.drive.faults.ignore_offset = True


def not_csp(peer: DrivePeer) -> None:
    peer.drive.faults.not_csp = True


class HastyMaster(Master):
    """A master that waits for the mode only as long as for a real drive, since its drive never reports it."""

    def wait(self, condition: Callable[[], bool], timeout_s: float, otherwise: str) -> None:
        never = "the mode" in otherwise
        super().wait(condition, timeout_s / self.patience if never else timeout_s, otherwise)


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (offset_doubled, "does not add 0x60B0"),
        (offset_negated, "does not add 0x60B0"),
        (offset_lost, "0x60B0 holds 0"),
        (not_csp, "does not enter the mode"),
    ],
)
@pytest.mark.fault("E16")
def test_a_drive_that_takes_offsets_otherwise_is_refused_and_disabled(
    spoil: Callable[[DrivePeer], None], says: str, peer: tuple[DrivePeer, MachineConfig]
) -> None:
    drive, settings = peer
    spoil(drive)
    kind = HastyMaster if spoil is not_csp else Master
    with kind(settings, "X") as master, pytest.raises(DeviceError) as caught:
        run_steps(master, sign_test)
    assert says in str(caught.value)
    assert drive.drive.power.state.name == "SWITCH_ON_DISABLED"
    assert drive.drive.dictionary.get_number(0x60B0) == 0


@pytest.mark.usefixtures("long_computation")
@pytest.mark.fault("E14")
def test_a_watchdog_that_does_nothing_is_refused(
    peer: tuple[DrivePeer, MachineConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fdhil.commissioning.watchdog.STARVE_TIMEOUT_S", 0.05)  # it never stops
    drive, settings = peer
    drive.drive.faults.no_heartbeat_consumer = True
    with Master(settings, "X") as master, pytest.raises(DriveFault, match="watchdog does not work"):
        run_steps(master, watchdog)
    assert [drive.drive.dictionary.get_number(0x1016, sub) for sub in (1, 2, 3, 4)] == [0, 0, 0, 0]


class LateCycle(Cycle):
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
def fed(peer: tuple[DrivePeer, MachineConfig], monkeypatch: pytest.MonkeyPatch) -> Iterator[LateCycle]:
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
def test_a_feeding_that_this_computer_missed_is_tried_again(fed: LateCycle) -> None:
    fed.late = 2
    run_steps(fed.master, lambda m: watchdog(m) == "proven" or pytest.fail("not proven"))
    assert fed.feedings == 3


@pytest.mark.usefixtures("long_computation")
def test_a_computer_that_is_always_late_is_told(fed: LateCycle) -> None:
    fed.late = 99
    with pytest.raises(DriveFault, match="missed fdhil's heartbeat 4 times; reduce this computer's load"):
        run_steps(fed.master, watchdog)
    assert fed.feedings == FEEDING_TRIES


@pytest.mark.usefixtures("long_computation")
def test_a_drive_that_trips_while_it_is_fed_is_not_tried_again(
    fed: LateCycle, peer: tuple[DrivePeer, MachineConfig]
) -> None:
    fed.trip = lambda: peer[0].drive.trip_fault(0x3210)
    with pytest.raises(DriveFault, match="it fell from Operation enabled to Fault"):
        run_steps(fed.master, watchdog)
    assert fed.feedings == 1


@pytest.mark.usefixtures("long_computation")
def test_a_heartbeat_that_is_late_right_after_the_feeding_proves_as_much(
    fed: LateCycle, peer: tuple[DrivePeer, MachineConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    feed = watchdog_module._feed

    def fed_and_late(master: Master, sub: int, entry: int, enable: Callable[[Master], None]) -> int:
        before = feed(master, sub, entry, enable)
        peer[0].drive.trip_fault(EMCY_HEARTBEAT)
        master.wait_cycles(20)
        return before

    monkeypatch.setattr(watchdog_module, "_feed", fed_and_late)
    run_steps(fed.master, lambda m: watchdog(m) == "proven" or pytest.fail("not proven"))


class SlowReader(Master):
    """A master on a busy computer: the first ``slow`` readings of the speed demand arrive too late."""

    slow = 0
    late_cycles = 2 * steps.EARLY_CYCLES + steps.RAMP_CYCLES
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
def test_a_ramp_whose_begin_was_missed_is_made_again(peer: tuple[DrivePeer, MachineConfig]) -> None:
    _, settings = peer
    with SlowReader(settings, "X") as master, rolled_back(master):
        prepare(master)
        enable(master)
        master.slow = 2 * steps.TRIAL_RAMPS
        assert feedforward_test(master) is True
        assert master.readings > 3 * steps.TRIAL_RAMPS


@pytest.mark.usefixtures("long_computation")
def test_a_feedforward_that_is_never_seen_stays_untold(
    peer: tuple[DrivePeer, MachineConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(steps, "MOST_RAMPS", 1)
    _, settings = peer
    with SlowReader(settings, "X") as master, rolled_back(master):
        prepare(master)
        enable(master)
        master.slow = 1_000_000
        assert feedforward_test(master) is None
        assert master.readings == 1 + steps.MOST_RAMPS * master.patience  # the object exists, and one reading per ramp


@pytest.mark.usefixtures("long_computation")
def test_what_was_read_before_the_ramp_is_no_missing_feedforward(
    peer: tuple[DrivePeer, MachineConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(steps, "MOST_RAMPS", 1)
    _, settings = peer
    with SlowReader(settings, "X") as master, rolled_back(master):
        prepare(master)
        enable(master)
        master.slow = 1_000_000
        master.late_cycles = steps.EARLY_CYCLES + 4  # read before the ramp, received during it
        assert feedforward_test(master) is None


def test_a_mean_over_cycles_that_this_computer_slept_through_is_of_what_came(
    peer: tuple[DrivePeer, MachineConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, settings = peer
    with Master(settings, "X") as master:
        prepare(master)
        position = master.profile.position
        master.wait(lambda: position in master.heard.objects, 5.0, "no position comes")

        def slept(asked: Master) -> int:
            """Return the cycle; at this thread's first call skip twenty cycles."""
            now = asked.loop.count
            if threading.current_thread() is threading.main_thread():
                monkeypatch.undo()
                asked.wait_cycles(20)
            return now

        monkeypatch.setattr(Master, "cycle", property(slept))
        assert master.average(position, 10) == pytest.approx(master.heard.objects[position], abs=2.0)


def test_full_heartbeat_consumers_are_refused(peer: tuple[DrivePeer, MachineConfig]) -> None:
    drive, settings = peer
    for sub in (1, 2, 3, 4):
        drive.drive.overwrite_object(0x1016, sub, (10 + sub) << 16 | 500)
    with Master(settings, "X") as master, pytest.raises(DriveFault, match="all entries of 0x1016 are in use"):
        watchdog(master)


@pytest.mark.parametrize(
    ("can_id", "shown"), [(0x080, "SYNC or set-points"), (0x302, "SYNC or set-points"), (0x605, "SDO requests")]
)
def test_an_nc_on_the_bus_is_left_alone(can_id: int, shown: str, peer: tuple[DrivePeer, MachineConfig]) -> None:
    """Every frame that only a master sends counts, also to another drive with its own SDO channels."""
    drive, settings = peer
    with can.Bus(interface="virtual", channel=settings.bus["can0"].channel) as nc, Master(settings, "X") as master:
        nc.send(can.Message(arbitration_id=can_id, is_extended_id=False))
        with pytest.raises(ProtocolError, match=f"an NC is sending {shown}"):
            survey.listen(master)
    while not drive.heard:
        time.sleep(0.01)
    assert drive.heard == [can_id]  # the NC's own


@pytest.mark.fault("A29")
def test_on_a_silent_bus_the_drive_alone_is_asked_what_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.drivers.can.sdo_channel.RESPONSE_TIMEOUT_S", 0.01)  # receives nothing
    settings = config()
    with can.Bus(interface="virtual", channel=settings.bus["can0"].channel) as other:
        with pytest.raises(ConnectError, match=r"no frame was received on the bus and node-ID 1 did not answer; check"):
            commission(settings, "X")
        sent = {(m.arbitration_id, bytes(m.data)) for m in iter(lambda: other.recv(0), None)}
        read, given_up = b"\x40\x00\x10\0\0\0\0\0", b"\x80\0\0\0\0\0\x04\x05"
        assert sent == {(0x601, read), (0x601, given_up)}


@pytest.mark.fault("A29")
def test_a_bus_of_another_bit_rate_gets_no_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(survey, "LISTEN_S", 2.0)
    settings = config()
    with can.Bus(interface="virtual", channel=settings.bus["can0"].channel) as other:
        with Master(settings, "X") as master:
            other.send(can.Message(arbitration_id=0x4, data=bytes(8), is_error_frame=True))
            master.wait(lambda: master.heard.errors > 0, 5.0, "no frame in error")
            with pytest.raises(
                ConnectError,
                match=r"only error frames are received, so the bit rate is probably wrong; nothing was sent",
            ):
                survey.listen(master)
        assert other.recv(0) is None


@pytest.mark.usefixtures("long_computation")
def test_a_drive_without_a_heartbeat_is_commissioned(peer: tuple[DrivePeer, MachineConfig]) -> None:
    """Many drives are delivered with 0x1017 = 0: with the NC off they send nothing until they are read."""
    drive, settings = peer
    drive.drive.overwrite_object(0x1017, 0, 0)
    record = commission(settings, "X")
    assert (record.watchdog, record.options["1017"]) == ("proven", 0)


def test_a_drive_that_does_not_answer_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.drivers.can.sdo_channel.RESPONSE_TIMEOUT_S", 0.01)  # receives nothing
    settings = config(drive={"node_id": 9})
    with can.Bus(interface="virtual", channel=settings.bus["can0"].channel) as other:
        other.send(can.Message(arbitration_id=0x701, data=[5], is_extended_id=False))
        with Master(settings, "X") as master, pytest.raises(DeviceError, match=r"drive X: .* was not answered"):
            master.sdo.read_int(Object.IDENTITY, 1)


def test_states_are_shown(peer: tuple[DrivePeer, MachineConfig]) -> None:
    _, settings = peer
    with Master(settings, "X") as master, rolled_back(master):
        prepare(master)
        assert master.state() is PowerState.SWITCH_ON_DISABLED
        enable(master)
        assert master.state() is PowerState.OPERATION_ENABLED


@pytest.mark.fault("E16")
@pytest.mark.parametrize("per_mm", [40, 90])
def test_a_scaling_that_knows_no_10_um_is_refused_before_anything_moves(per_mm: int) -> None:
    settings = config(drive={"increments_per_rev": 20 * per_mm})
    with (
        DrivePeer(settings) as drive,
        pytest.raises(DriveFault, match=r"its scaling is too coarse .* finer resolution"),
    ):
        commission(settings, "X")
    assert not {0x000, 0x080, 0x201, 0x301} & set(drive.heard)


class KeptOffsets(DrivePeer):
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


def enabled_and_rolled_back(settings: MachineConfig, step: Callable[[Master], object]) -> None:
    with Master(settings, "X") as master, rolled_back(master):
        prepare(master)
        enable(master)
        step(master)


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("interrupt_at", [12, 33])
def test_a_ramp_that_is_stopped_on_its_way_turns_round_there(interrupt_at: int) -> None:
    settings = config()
    with KeptOffsets(settings, interrupt_at) as drive:
        with pytest.raises(KeyboardInterrupt):
            enabled_and_rolled_back(settings, sign_test)
        offsets = drive.offsets
    assert max(map(abs, np.diff(offsets))) <= 20  # never a step from an old plan to a new one
    assert max(offsets) <= 33
    assert offsets[-1] == 0
    assert drive.drive.power.state.name == "SWITCH_ON_DISABLED"


def test_an_offset_is_taken_away_within_the_acceleration() -> None:
    settings = config()
    fast = settings.axis["X"].model_copy(update={"correction": CorrectionLimits(max_speed_mm_s=20.0)})
    settings = settings.model_copy(update={"axis": {"X": fast}})
    with KeptOffsets(settings) as drive:
        enabled_and_rolled_back(settings, lambda master: steps.ramp(master, 150, 1))
    assert max(drive.offsets) == 150
    assert np.diff(drive.offsets).min() < -5  # 0.8 increments per cycle squared, plus rounding
    assert np.abs(np.diff(drive.offsets, 2)).max() <= 2


def test_ctrl_c_while_all_is_rolled_back_is_heard_once_that_is_done() -> None:
    settings = config()
    with KeptOffsets(settings) as drive:

        def out(master: Master) -> None:
            steps.ramp(master, 30, 1)
            drive.interrupt_at = 14  # on the way back

        with pytest.raises(KeyboardInterrupt):
            enabled_and_rolled_back(settings, out)
        assert drive.offsets[-1] == 0
    assert drive.drive.power.state.name == "SWITCH_ON_DISABLED"
    assert drive.drive.dictionary.get_number(0x60B0) == 0


def test_what_could_not_be_rolled_back_is_told_after_ctrl_c_too(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = config()

    def fails(master: Master) -> None:
        raise DriveFault(master.device, "it still holds an offset")

    monkeypatch.setattr(steps, "zero_offset", fails)
    left = pytest.raises(ProtocolError, match="interrupted; the drive could not be restored")
    with DrivePeer(settings), left, Master(settings, "X") as master, rolled_back(master):
        raise KeyboardInterrupt
