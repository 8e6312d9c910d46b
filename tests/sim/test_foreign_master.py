"""A foreign master (`canopen`) uses the running machine as servo drives, without any SYNC."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import canopen
import pytest

from tests.sim.test_simulator_service import load_corner_demand, run_service

PATIENCE = 20_000  # polls; each waits for its answer
TARGET_REACHED, ATTAINED = 1 << 10, 1 << 12


@contextmanager
def start_master(folder: Path) -> Iterator[Any]:
    """Return the machine and its first node, enabled without a mode."""
    with run_service(load_corner_demand, folder, "realtime", interface="virtual", channel="foreign-master") as twin:
        eds = twin.wait_for_event("ready")["drives"]["X"]["eds"]
        network = canopen.Network()
        network.connect(interface="virtual", channel="foreign-master")
        try:
            node: Any = network.add_node(1, eds)
            node.sdo.RESPONSE_TIMEOUT = 20
            node.nmt.state = "OPERATIONAL"
            for word in (0x06, 0x07, 0x0F):
                node.sdo[0x6040].raw = word
            yield node
        finally:
            network.disconnect()


def wait_for(node: Any, bits: int) -> None:
    for _ in range(PATIENCE):
        if node.sdo[0x6041].raw & bits == bits:
            return
    raise AssertionError(f"{node.sdo[0x6041].raw:04X}")


def test_profile_position_homing_velocity_and_quick_stop_without_sync(tmp_path: Path) -> None:
    with start_master(tmp_path) as node:
        node.sdo[0x6060].raw = 1
        node.sdo[0x607A].raw = 16384
        node.sdo[0x6040].raw = 0x1F
        wait_for(node, ATTAINED)  # here: acknowledged
        node.sdo[0x6040].raw = 0x0F
        wait_for(node, TARGET_REACHED)
        assert node.sdo[0x6064].raw == pytest.approx(16384, abs=400)
        node.sdo[0x6060].raw = 6
        node.sdo[0x607C].raw = -500
        node.sdo[0x6040].raw = 0x1F
        wait_for(node, TARGET_REACHED | ATTAINED)
        assert node.sdo[0x6064].raw == pytest.approx(-500, abs=400)
        node.sdo[0x60FF].raw = 65536
        node.sdo[0x6060].raw = 3
        wait_for(node, TARGET_REACHED)
        assert node.sdo[0x606C].raw == pytest.approx(65536, rel=0.3)
        node.sdo[0x6040].raw = 0x02
        for _ in range(PATIENCE):
            if node.sdo[0x6041].raw & 0x4F == 0x40:
                break
        assert node.sdo[0x6041].raw & 0x4F == 0x40


def test_node_guarding_and_emergency_work_without_sync(tmp_path: Path) -> None:
    reported = threading.Event()
    with start_master(tmp_path) as node:
        node.emcy.add_callback(lambda _: reported.set())
        node.nmt.start_node_guarding(0.02)
        node.sdo[0x100C].raw = 60_000
        node.sdo[0x6065].raw = 1  # any motion is too much
        node.sdo[0x6066].raw = 0
        node.sdo[0x60FF].raw = 0
        node.sdo[0x6060].raw = 1
        node.sdo[0x607A].raw = 65536
        node.sdo[0x6040].raw = 0x1F
        assert reported.wait(60)
        node.nmt.stop_node_guarding()
        assert node.emcy.active[0].code == 0x8611
        assert node.nmt.wait_for_heartbeat(60) == "OPERATIONAL"
