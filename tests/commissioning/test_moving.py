"""Motions of a simulated drive: played to their end, and braked on every interruption."""

from __future__ import annotations

import uuid
from collections.abc import Iterator

import pytest

from fdhil.cia402 import PowerState
from fdhil.commissioning.master import Master
from fdhil.commissioning.moving import following, move
from fdhil.commissioning.set_points import Bounds, straight
from fdhil.commissioning.steps import enable, prepare, rolled_back
from fdhil.config import MachineConfig
from fdhil.errors import DriveFault
from fdhil.records import Float
from tests.drivers.frame_builder import build_machine_config
from tests.drivers.peer import DrivePeer

pytestmark = pytest.mark.usefixtures("quick_commissioning")
SPEED_MM_S, ACCELERATION_MM_S2 = 20.0, 4000.0  # slow enough that a delay of the host by a second changes nothing


class Enabled:
    def __init__(self, peer: DrivePeer, config: MachineConfig, master: Master) -> None:
        self.peer, self.master = peer, master
        self.bounds = Bounds.of("X", config.axis["X"], config.machine.sync_period_s, (-50.0, 50.0), SPEED_MM_S)

    def way(self, mm: float) -> Float:
        goal = self.master.config.axis["X"].scaling.convert_to_increments(mm)
        assert self.master.target is not None
        return straight((self.master.target,), (goal,), (self.bounds.speed,), (self.bounds.acceleration,), 20)


@pytest.fixture
def enabled() -> Iterator[Enabled]:
    config = build_machine_config(
        bus={"interface": "virtual", "channel": uuid.uuid4().hex}, guard={"clock": "sync"}, drive={"sign": -1}
    )
    with DrivePeer(config) as peer, Master(config, "X") as master, rolled_back(master):
        prepare(master)
        enable(master)
        yield Enabled(peer, config, master)


@pytest.mark.usefixtures("long_computation")
def test_an_axis_is_moved_and_held_there(enabled: Enabled) -> None:
    move([enabled.master], [enabled.bounds], enabled.way(5.0))
    enabled.master.wait_cycles(200)
    assert enabled.peer.drive.table_mm == pytest.approx(5.0, abs=0.01)
    move([enabled.master], [enabled.bounds], enabled.way(-2.0))
    enabled.master.wait_cycles(200)
    assert enabled.peer.drive.table_mm == pytest.approx(-2.0, abs=0.01)


def test_ctrl_c_brakes_before_it_is_raised(enabled: Enabled) -> None:
    def impatient() -> None:
        if enabled.master.loop.path is not None and abs(enabled.master.loop.path.position[0]) > 3 * 3276.8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        move([enabled.master], [enabled.bounds], enabled.way(40.0), impatient)
    held = enabled.master.target
    assert held is not None
    assert 3.0 < -held / 3276.8 < 25.0
    enabled.master.wait_cycles(300)
    assert enabled.peer.drive.table_mm == pytest.approx(-held / 3276.8, abs=0.01)


@pytest.mark.usefixtures("long_computation")
def test_a_way_out_of_the_travel_is_refused(enabled: Enabled) -> None:
    with pytest.raises(DriveFault, match="could not be braked inside its travel; find the cause"):
        move([enabled.master], [enabled.bounds], enabled.way(60.0))
    enabled.master.wait_cycles(200)
    assert enabled.peer.drive.table_mm < 50.01


def test_a_drive_that_trips_ends_the_motion(enabled: Enabled) -> None:
    def trip() -> None:
        path = enabled.master.loop.path
        if path is not None and path.cycles > 30 and enabled.master.state() is PowerState.OPERATION_ENABLED:
            enabled.peer.drive.trip_fault(0x3210)

    with pytest.raises(DriveFault, match="its drive fell from Operation enabled"):
        move([enabled.master], [enabled.bounds], enabled.way(40.0), trip)


def test_nothing_is_moved_that_is_not_held() -> None:
    config = build_machine_config(bus={"interface": "virtual", "channel": uuid.uuid4().hex})
    with (
        Master(config, "X") as master,
        pytest.raises(DriveFault, match="it holds no position"),
        following([master], []),
    ):
        pass
