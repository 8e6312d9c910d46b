"""Another master during fdhil's actions on a bus: it is detected within a few SYNC, and the drives are stopped."""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import can
import pytest

from fdhil.commissioning import config_check, pdo_setup, steps
from fdhil.commissioning.compare import compare_again
from fdhil.commissioning.master import Master
from fdhil.commissioning.moving import move
from fdhil.commissioning.set_points import Bounds, straight
from fdhil.commissioning.trial import guarded
from fdhil.commissioning.watchdog import watchdog_test
from fdhil.config import MachineConfig
from fdhil.errors import ForeignMaster
from tests.commissioning.foreign_nc import (
    A_FEW,
    FOREIGN,
    HEARTBEAT,
    LEFT_TO_IT,
    NMT,
    OFFSET,
    SDO,
    SYNC,
    TARGET,
    TO_BRAKE,
    ForeignNc,
    Frame,
    is_offset,
    moves,
    offset_of,
)
from tests.drivers.frame_builder import build_machine_config
from tests.drivers.peer import DrivePeer
from tests.integration.conftest import sign_off
from tests.tiers import sampled
from tests.virtual_threads import VirtualThreads

pytestmark = pytest.mark.usefixtures("quick_commissioning")


@dataclass(frozen=True)
class Rig:
    peer: DrivePeer
    config: MachineConfig

    def nc(self, what: str, when: Callable[[Frame], bool], *, often: bool = True) -> ForeignNc:
        return ForeignNc(self.config.bus["can0"].channel, FOREIGN[what], when, often)

    def require_left_alone(self, nc: ForeignNc, what: str, braking: int = 0) -> None:
        """fdhil may send only a few SYNC after the other master, and the drive must be stopped or left to it."""
        assert nc.on
        assert nc.count(OFFSET) <= A_FEW + braking
        assert nc.count(SYNC) <= A_FEW + braking
        assert nc.count(TARGET) <= A_FEW + braking
        assert nc.count(NMT) == 0
        assert nc.count(SDO) <= 1  # it was in flight
        assert nc.count(HEARTBEAT) <= 2
        if what in LEFT_TO_IT:
            assert nc.count(LEFT_TO_IT[what]) <= 1
        if what != "offset":
            assert [offset_of(frame) for frame in nc.sent if frame[0] == OFFSET][-1:] in ([], [0])
            assert self.holds(lambda: self.peer.drive.dictionary.get_number(0x60B0) == 0)
        if what != "target":
            off = ("SWITCH_ON_DISABLED", "FAULT", "FAULT_REACTION_ACTIVE")
            assert self.holds(lambda: self.peer.drive.power.state.name in off)

    def holds(self, condition: Callable[[], bool]) -> bool:
        """Whether the condition holds after the simulated drive has processed its frames."""
        time.sleep(0.01)
        return condition()


@pytest.fixture
def rig(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Rig]:
    sections: dict[str, Any] = {"guard": {"clock": "sync", "heartbeat_s": 0.1}, "play": {"heartbeat_s": 0.5}}
    sections |= getattr(request, "param", {})
    bus: dict[str, object] = {"interface": "virtual", "channel": uuid.uuid4().hex}
    config = build_machine_config(tmp_path, bus=bus, **sections)
    with DrivePeer(config) as peer:
        yield Rig(peer, config)


def sign_test(master: Master) -> None:
    steps.sign_test(master)


def feedforward_test(master: Master) -> None:
    steps.feedforward_test(master)


def proved_watchdog(master: Master) -> None:
    watchdog_test(master, steps.enable)


def rapid(master: Master) -> None:
    bounds = Bounds.of("X", master.config.axis["X"], master.period_s, (-50.0, 50.0), 100.0)
    assert master.target is not None
    with guarded(master):
        goal = master.target + 65536
        move([master], [bounds], straight((master.target,), (goal,), (bounds.speed,), (bounds.acceleration,), 20))


def held_while_asked(master: Master) -> None:
    master.loop._landed.wait(60)
    steps.ramp(master, 33, 1)


def is_heartbeat(frame: Frame) -> bool:
    return frame[0] == HEARTBEAT


def is_held(frame: Frame) -> bool:
    return frame[0] == TARGET and frame[1][:2] == b"\x0f\x00"


STEPS: dict[str, tuple[Callable[[Master], None], Callable[[Frame], bool], int]] = {
    "sign test": (sign_test, is_offset, 0),
    "feed-forward test": (feedforward_test, is_offset, 0),
    "watchdog test": (proved_watchdog, is_heartbeat, 0),
    "question": (held_while_asked, is_held, 0),
    "rapid": (rapid, moves, TO_BRAKE),
}


def led_through(config: MachineConfig, step: Callable[[Master], None]) -> None:
    with Master(config, "X") as master, steps.rolled_back(master):
        steps.prepare(master)
        steps.enable(master)
        step(master)


@pytest.mark.parametrize(("step", "what"), sampled(product(STEPS, FOREIGN), every=5))
def test_another_master_ends_a_step_within_a_few_sync(step: str, what: str, rig: Rig) -> None:
    done, when, braking = STEPS[step]
    with rig.nc(what, when) as nc:
        with pytest.raises(ForeignMaster, match=r"an NC is sending .*; switch it off") as told:
            led_through(rig.config, done)
        rig.require_left_alone(nc, what, braking)
    left = {
        "target": "axis X was left to that master, its offset set to zero",
        "offset": "X was stopped and its drive switched off, and may hold an offset of that master: power it off",
    }
    assert left.get(what, "X was stopped, its offset set to zero and its drive switched off") in str(told.value)
    assert ("0x1016 may be as fdhil wrote" in str(told.value)) is (step in ("watchdog test", "rapid"))


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("virtual_threads", [1, 2, 3], indirect=True)
@pytest.mark.parametrize("step", STEPS)
def test_another_master_is_noticed_in_whatever_order_threads_run(
    step: str, virtual_threads: VirtualThreads, rig: Rig
) -> None:
    test_another_master_ends_a_step_within_a_few_sync(step, "offset", rig)


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("what", FOREIGN)
def test_a_single_frame_of_another_master_is_enough(what: str, rig: Rig) -> None:
    with rig.nc(what, is_offset, often=False) as nc:
        with pytest.raises(ForeignMaster):
            steps.commission(rig.config, "X")
        rig.require_left_alone(nc, what)


def set_pdos(config: MachineConfig) -> None:
    with Master(config, "X") as master:
        pdo_setup.set_up_pdos(master)


@pytest.mark.parametrize("what", FOREIGN)
@pytest.mark.parametrize("ask", [config_check.check_machine, set_pdos])
def test_a_drive_is_asked_no_more_once_another_master_is_heard(
    ask: Callable[[MachineConfig], object], what: str, rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(config_check, "LISTEN_S", 0.1)
    with rig.nc(what, lambda frame: frame[0] == SDO) as nc:
        with pytest.raises(ForeignMaster, match="nothing more was sent"):
            ask(rig.config)
        assert nc.sent == []


def test_a_record_holds_where_an_nc_comes_while_a_guard_starts(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.commissioning.compare.LISTEN_S", 0.1)
    sign_off(rig.config)
    said: list[str] = []
    with rig.nc("SYNC", lambda frame: frame[0] == SDO) as nc:
        compare_again(rig.config, "can0", said.append)
        assert nc.sent == []
    assert said == []


def test_a_heartbeat_like_ours_ends_the_watchdog_test(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """From another fdhil on another computer: the drive would not detect that this one's has stopped."""
    monkeypatch.setitem(FOREIGN, "heartbeat", (HEARTBEAT, b"\x05"))
    with rig.nc("heartbeat", is_heartbeat) as nc:
        with pytest.raises(ForeignMaster, match=r"an NC is sending with identifiers of fdhil; .* COB-ID 764"):
            led_through(rig.config, proved_watchdog)
        rig.require_left_alone(nc, "heartbeat")


def test_a_drive_that_an_nc_stops_and_starts_is_left_without_an_offset(rig: Rig) -> None:
    """An NC first stops the nodes, sets them up and starts them; meanwhile drives ignore all frames."""
    channel = rig.config.bus["can0"].channel

    def stop_and_start() -> None:
        with can.Bus(interface="virtual", channel=channel) as nc:
            nc.send(can.Message(arbitration_id=NMT, data=b"\x80\x01", is_extended_id=False))
            time.sleep(0.2)
            nc.send(can.Message(arbitration_id=NMT, data=b"\x01\x01", is_extended_id=False))
            while not zeroed.wait(0.002):
                nc.send(can.Message(arbitration_id=SYNC, is_extended_id=False))

    def hold(master: Master) -> None:
        steps.ramp(master, 33, 1)
        master.wait_cycles(20)
        thread.start()
        master.wait_cycles(10_000)

    zeroed, thread = threading.Event(), threading.Thread(target=stop_and_start)
    with pytest.raises(ForeignMaster, match=r"NMT commands; .* axis X was left to that master, its offset set to zero"):
        led_through(rig.config, hold)
    assert rig.holds(lambda: rig.peer.drive.dictionary.get_number(0x60B0) == 0)
    zeroed.set()
    thread.join()
    assert rig.peer.heard.count(NMT) == 3  # our start, then the NC's own two


def test_a_drive_that_an_nc_stops_for_good_may_hold_an_offset_and_that_is_reported(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fdhil.commissioning.landing.START_CYCLES", 50)
    monkeypatch.setitem(FOREIGN, "stop", (NMT, b"\x02\x00"))
    with rig.nc("stop", is_offset, often=False) as nc:
        with pytest.raises(ForeignMaster, match="which stopped its node, and may hold an offset: power it off and on"):
            led_through(rig.config, sign_test)
        assert nc.count(TARGET) == 0
        assert nc.count(SYNC) <= A_FEW


def test_no_frame_leaves_before_the_bus_was_listened_to(rig: Rig) -> None:
    """A connection opened next to an NC has not received anything yet."""
    with rig.nc("SYNC", lambda _frame: True) as nc:
        nc.on = True
        with Master(rig.config, "X") as master, pytest.raises(ForeignMaster):
            master.sdo.read_bytes(0x1000)
        assert nc.sent == []
