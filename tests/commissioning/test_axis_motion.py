"""Motions of a simulated drive: played to their end, and braked on every interruption."""

from __future__ import annotations

import uuid
from collections.abc import Iterator

import pytest

from fdhil.cia402 import PowerState
from fdhil.commissioning.axis_motion import follow_path, move_axes
from fdhil.commissioning.commissioning_steps import enable_drive, prepare_drive, roll_back_afterwards
from fdhil.commissioning.master import Master
from fdhil.commissioning.set_points import AxisBounds, plan_straight_move
from fdhil.config import MachineConfig
from fdhil.errors import DriveFault
from fdhil.records import Float
from tests.drivers.frame_builder import build_machine_config
from tests.drivers.peer import DrivePeer

pytestmark = pytest.mark.usefixtures("fast_commissioning")
SPEED_MM_S, ACCELERATION_MM_S2 = 20.0, 4000.0  # slow enough that a delay of the host by a second changes nothing


class EnabledDrive:
    def __init__(self, peer: DrivePeer, config: MachineConfig, master: Master) -> None:
        self.peer, self.master = peer, master
        self.bounds = AxisBounds.create_for_axis(
            "X", config.axis["X"], config.machine.sync_period_s, (-50.0, 50.0), SPEED_MM_S
        )

    def plan_move(self, mm: float) -> Float:
        goal = self.master.config.axis["X"].scaling.convert_to_increments(mm)
        assert self.master.target is not None
        return plan_straight_move((self.master.target,), (goal,), (self.bounds.speed,), (self.bounds.acceleration,), 20)


@pytest.fixture
def enabled_drive() -> Iterator[EnabledDrive]:
    config = build_machine_config(
        bus={"interface": "virtual", "channel": uuid.uuid4().hex}, guard={"clock": "sync"}, drive={"sign": -1}
    )
    with DrivePeer(config) as peer, Master(config, "X") as master, roll_back_afterwards(master):
        prepare_drive(master)
        enable_drive(master)
        yield EnabledDrive(peer, config, master)


@pytest.mark.usefixtures("long_computation")
def test_axis_moves_and_holds_end_position(enabled_drive: EnabledDrive) -> None:
    move_axes([enabled_drive.master], [enabled_drive.bounds], enabled_drive.plan_move(5.0))
    enabled_drive.master.wait_cycles(200)
    assert enabled_drive.peer.drive.table_mm == pytest.approx(5.0, abs=0.01)
    move_axes([enabled_drive.master], [enabled_drive.bounds], enabled_drive.plan_move(-2.0))
    enabled_drive.master.wait_cycles(200)
    assert enabled_drive.peer.drive.table_mm == pytest.approx(-2.0, abs=0.01)


def test_ctrl_c_is_raised_after_braking(enabled_drive: EnabledDrive) -> None:
    def interrupt_again() -> None:
        if enabled_drive.master.loop.path is not None and abs(enabled_drive.master.loop.path.position[0]) > 3 * 3276.8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        move_axes([enabled_drive.master], [enabled_drive.bounds], enabled_drive.plan_move(40.0), interrupt_again)
    held = enabled_drive.master.target
    assert held is not None
    assert 3.0 < -held / 3276.8 < 25.0
    enabled_drive.master.wait_cycles(300)
    assert enabled_drive.peer.drive.table_mm == pytest.approx(-held / 3276.8, abs=0.01)


@pytest.mark.usefixtures("long_computation")
def test_move_out_of_travel_is_refused(enabled_drive: EnabledDrive) -> None:
    with pytest.raises(DriveFault, match="could not be braked inside its travel; find the cause"):
        move_axes([enabled_drive.master], [enabled_drive.bounds], enabled_drive.plan_move(60.0))
    enabled_drive.master.wait_cycles(200)
    assert enabled_drive.peer.drive.table_mm < 50.01


def test_drive_fault_ends_motion(enabled_drive: EnabledDrive) -> None:
    def trip() -> None:
        path = enabled_drive.master.loop.path
        if (
            path is not None
            and path.cycles > 30
            and enabled_drive.master.get_power_state() is PowerState.OPERATION_ENABLED
        ):
            enabled_drive.peer.drive.trip_fault(0x3210)

    with pytest.raises(DriveFault, match="its drive fell from Operation enabled"):
        move_axes([enabled_drive.master], [enabled_drive.bounds], enabled_drive.plan_move(40.0), trip)


def test_axis_without_held_target_is_not_moved() -> None:
    config = build_machine_config(bus={"interface": "virtual", "channel": uuid.uuid4().hex})
    with (
        Master(config, "X") as master,
        pytest.raises(DriveFault, match="it holds no position"),
        follow_path([master], []),
    ):
        pass
