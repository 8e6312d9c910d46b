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

from fdhil.commissioning import commissioning_steps, config_check, pdo_setup
from fdhil.commissioning.axis_motion import move_axes
from fdhil.commissioning.axis_trial import enable_heartbeat_watch
from fdhil.commissioning.master import Master
from fdhil.commissioning.record_comparison import verify_commissioned_drives
from fdhil.commissioning.set_points import AxisBounds, plan_straight_move
from fdhil.commissioning.watchdog import run_watchdog_test
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
    decode_offset,
    is_moving_frame,
    is_offset_frame,
)
from tests.drivers.frame_builder import build_machine_config
from tests.drivers.peer import DrivePeer
from tests.integration.conftest import sign_off
from tests.tiers import sampled
from tests.virtual_threads import VirtualThreads

pytestmark = pytest.mark.usefixtures("fast_commissioning")


@dataclass(frozen=True)
class Rig:
    peer: DrivePeer
    config: MachineConfig

    def start_nc(self, what: str, when: Callable[[Frame], bool], *, often: bool = True) -> ForeignNc:
        return ForeignNc(self.config.bus["can0"].channel, FOREIGN[what], when, often)

    def require_drive_released(self, nc: ForeignNc, what: str, braking: int = 0) -> None:
        """fdhil may send only a few SYNC after the other master, and the drive must be stopped or left to it."""
        assert nc.on
        assert nc.count_frames(OFFSET) <= A_FEW + braking
        assert nc.count_frames(SYNC) <= A_FEW + braking
        assert nc.count_frames(TARGET) <= A_FEW + braking
        assert nc.count_frames(NMT) == 0
        assert nc.count_frames(SDO) <= 1  # it was in flight
        assert nc.count_frames(HEARTBEAT) <= 2
        if what in LEFT_TO_IT:
            assert nc.count_frames(LEFT_TO_IT[what]) <= 1
        if what != "offset":
            assert [decode_offset(frame) for frame in nc.sent if frame[0] == OFFSET][-1:] in ([], [0])
            assert self.has_settled(lambda: self.peer.drive.dictionary.get_number(0x60B0) == 0)
        if what != "target":
            off = ("SWITCH_ON_DISABLED", "FAULT", "FAULT_REACTION_ACTIVE")
            assert self.has_settled(lambda: self.peer.drive.power.state.name in off)

    def has_settled(self, condition: Callable[[], bool]) -> bool:
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


def start_sign_test(master: Master) -> None:
    commissioning_steps.run_sign_test(master)


def start_feedforward_test(master: Master) -> None:
    commissioning_steps.run_feedforward_test(master)


def start_watchdog_test(master: Master) -> None:
    run_watchdog_test(master, commissioning_steps.enable_drive)


def start_rapid(master: Master) -> None:
    bounds = AxisBounds.create_for_axis("X", master.config.axis["X"], master.period_s, (-50.0, 50.0), 100.0)
    assert master.target is not None
    with enable_heartbeat_watch(master):
        goal = master.target + 65536
        move_axes(
            [master],
            [bounds],
            plan_straight_move((master.target,), (goal,), (bounds.speed,), (bounds.acceleration,), 20),
        )


def hold_during_question(master: Master) -> None:
    master.loop._landed.wait(60)
    commissioning_steps.ramp_offset(master, 33, 1)


def is_heartbeat_frame(frame: Frame) -> bool:
    return frame[0] == HEARTBEAT


def is_hold_frame(frame: Frame) -> bool:
    return frame[0] == TARGET and frame[1][:2] == b"\x0f\x00"


STEPS: dict[str, tuple[Callable[[Master], None], Callable[[Frame], bool], int]] = {
    "sign test": (start_sign_test, is_offset_frame, 0),
    "feed-forward test": (start_feedforward_test, is_offset_frame, 0),
    "watchdog test": (start_watchdog_test, is_heartbeat_frame, 0),
    "question": (hold_during_question, is_hold_frame, 0),
    "rapid": (start_rapid, is_moving_frame, TO_BRAKE),
}


def run_step(config: MachineConfig, step: Callable[[Master], None]) -> None:
    with Master(config, "X") as master, commissioning_steps.roll_back_afterwards(master):
        commissioning_steps.prepare_drive(master)
        commissioning_steps.enable_drive(master)
        step(master)


@pytest.mark.parametrize(("step", "what"), sampled(product(STEPS, FOREIGN), every=5))
def test_step_ends_within_few_syncs_of_another_master(step: str, what: str, rig: Rig) -> None:
    done, when, braking = STEPS[step]
    with rig.start_nc(what, when) as nc:
        with pytest.raises(ForeignMaster, match=r"an NC is sending .*; switch it off") as reported:
            run_step(rig.config, done)
        rig.require_drive_released(nc, what, braking)
    left = {
        "target": "axis X was left to that master, its offset set to zero",
        "offset": "X was stopped and its drive switched off, and may hold an offset of that master: power it off",
    }
    assert left.get(what, "X was stopped, its offset set to zero and its drive switched off") in str(reported.value)
    assert ("0x1016 may be as fdhil wrote" in str(reported.value)) is (step in ("watchdog test", "rapid"))


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("virtual_threads", [1, 2, 3], indirect=True)
@pytest.mark.parametrize("step", STEPS)
def test_another_master_is_detected_in_every_thread_order(step: str, virtual_threads: VirtualThreads, rig: Rig) -> None:
    test_step_ends_within_few_syncs_of_another_master(step, "offset", rig)


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("what", FOREIGN)
def test_single_frame_of_another_master_is_detected(what: str, rig: Rig) -> None:
    with rig.start_nc(what, is_offset_frame, often=False) as nc:
        with pytest.raises(ForeignMaster):
            commissioning_steps.commission_axis(rig.config, "X")
        rig.require_drive_released(nc, what)


def start_pdo_setup(config: MachineConfig) -> None:
    with Master(config, "X") as master:
        pdo_setup.set_up_pdos(master)


@pytest.mark.parametrize("what", FOREIGN)
@pytest.mark.parametrize("ask", [config_check.check_machine, start_pdo_setup])
def test_sdo_requests_end_when_another_master_is_detected(
    ask: Callable[[MachineConfig], object], what: str, rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(config_check, "LISTEN_S", 0.1)
    with rig.start_nc(what, lambda frame: frame[0] == SDO) as nc:
        with pytest.raises(ForeignMaster, match="nothing more was sent"):
            ask(rig.config)
        assert nc.sent == []


def test_record_stays_valid_when_nc_starts_during_guard_start(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.commissioning.record_comparison.LISTEN_S", 0.1)
    sign_off(rig.config)
    message: list[str] = []
    with rig.start_nc("SYNC", lambda frame: frame[0] == SDO) as nc:
        verify_commissioned_drives(rig.config, "can0", message.append)
        assert nc.sent == []
    assert message == []


def test_watchdog_test_ends_on_foreign_heartbeat_with_own_id(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """From another fdhil on another computer: the drive would not detect that this one's has stopped."""
    monkeypatch.setitem(FOREIGN, "heartbeat", (HEARTBEAT, b"\x05"))
    with rig.start_nc("heartbeat", is_heartbeat_frame) as nc:
        with pytest.raises(ForeignMaster, match=r"an NC is sending with identifiers of fdhil; .* COB-ID 764"):
            run_step(rig.config, start_watchdog_test)
        rig.require_drive_released(nc, "heartbeat")


def test_drive_restarted_by_nc_has_zero_offset(rig: Rig) -> None:
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
        commissioning_steps.ramp_offset(master, 33, 1)
        master.wait_cycles(20)
        thread.start()
        master.wait_cycles(10_000)

    zeroed, thread = threading.Event(), threading.Thread(target=stop_and_start)
    with pytest.raises(ForeignMaster, match=r"NMT commands; .* axis X was left to that master, its offset set to zero"):
        run_step(rig.config, hold)
    assert rig.has_settled(lambda: rig.peer.drive.dictionary.get_number(0x60B0) == 0)
    zeroed.set()
    thread.join()
    assert rig.peer.heard.count(NMT) == 3  # our start, then the NC's own two


def test_drive_stopped_by_nc_is_reported_with_possible_offset(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.commissioning.foreign_master_stop.START_CYCLES", 50)
    monkeypatch.setitem(FOREIGN, "stop", (NMT, b"\x02\x00"))
    with rig.start_nc("stop", is_offset_frame, often=False) as nc:
        with pytest.raises(ForeignMaster, match="which stopped its node, and may hold an offset: power it off and on"):
            run_step(rig.config, start_sign_test)
        assert nc.count_frames(TARGET) == 0
        assert nc.count_frames(SYNC) <= A_FEW


def test_no_frame_is_sent_before_bus_was_listened_to(rig: Rig) -> None:
    """A connection opened next to an NC has not received anything yet."""
    with rig.start_nc("SYNC", lambda _frame: True) as nc:
        nc.on = True
        with Master(rig.config, "X") as master, pytest.raises(ForeignMaster):
            master.sdo.read_bytes(0x1000)
        assert nc.sent == []
