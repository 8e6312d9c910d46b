"""The guard's process with drives of other makes: it receives and sends as their profiles define."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import canopen
import pytest

from tests.bench import bench_axis
from tests.eds import write_eds
from tests.integration.conftest import Bench
from tests.integration.test_guard import every_offset_is_applied_in_its_own_cycle, guarded
from tests.vendor_drives.vendor_machines import set_up_drive

pytestmark = pytest.mark.usefixtures("processes")


@pytest.fixture(params=["hub", pytest.param("socketcan", marks=pytest.mark.socketcan)])
def transport(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def sections(tmp_path: Path) -> dict[str, Any]:
    eds = str(write_eds("epos4", tmp_path))
    axis = bench_axis(drive={"profile": "epos4", "dc_link_v": 300.0})
    sim = {"pace": "lockstep", "modbus": False, "axis": {name: {"eds": eds} for name in "XY"}}
    return {"axis": {"X": axis, "Y": axis}, "sim": sim, "guard": {"clock": "sync"}}


def test_every_offset_is_applied_in_its_own_cycle(bench: Bench, tmp_path: Path) -> None:
    network = canopen.Network(bus=bench.join())
    network.connect()
    try:
        for axis in bench.config.axis:
            node = network.add_node(bench.config.get_node_id(axis), str(tmp_path / "epos4.eds"))
            node.sdo.RESPONSE_TIMEOUT = 60.0

            def write(index: int, sub: int, value: int, size: int, node: canopen.RemoteNode = node) -> None:
                node.sdo.download(index, sub, value.to_bytes(size, "little"))

            set_up_drive(bench.config, axis, node.object_dictionary.__contains__, write)
    finally:
        network.disconnect()
    with guarded(bench, tmp_path) as client:
        every_offset_is_applied_in_its_own_cycle(bench, client, tmp_path)
