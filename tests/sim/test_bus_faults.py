"""Faults of the simulated bus, by script or panel: all parties on the hub get the same affected frames."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest
from can.interfaces.socketcand import socketcand

from fdhil.config import CanBus, parse_config
from fdhil.drivers.can import bus_listener
from fdhil.errors import ConnectError
from fdhil.pytest_plugin import FeedDriveBench
from fdhil.sim import fault_script
from fdhil.sim.frame_faults import FrameFault
from tests.bench import bench_document
from tests.drivers.test_receive_ports import wait_for
from tests.sim.bench_simulator import SteppedSimulator

STRANGER = 0x123


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[FeedDriveBench]:
    with FeedDriveBench(tmp_path, axes="X", bus="hub", pace="lockstep") as running:
        yield running


def build_message(can_id: int, data: bytes = b"") -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)


def receive_until(party: can.BusABC, can_id: int, data: bytes | None = None) -> list[can.Message]:
    received: list[can.Message] = []
    for each in party:
        received.append(each)
        if each.arbitration_id == can_id and data in (None, bytes(each.data)):
            return received
    raise AssertionError


def record_cycles(bench: FeedDriveBench, party: can.BusABC, count: int) -> list[list[int]]:
    """Run the NC for this number of cycles; return the identifiers received in each."""
    bench.command("nc", on=True)
    bench.wait_for("nc")
    receive_until(party, 0x80)
    found = [[each.arbitration_id for each in receive_until(party, 0x80)[:-1]] for _ in range(count)]
    return [[can_id for can_id in cycle if can_id < 0x700] for cycle in found]


def test_machine_frames_are_dropped_delayed_and_injected_for_all_clients(bench: FeedDriveBench) -> None:
    buses = [bench.join(), bench.join()]
    bench.fault("bus_drop", None, can_id=0x181)
    bench.fault("bus_inject", None, can_id=0x81, data="1032", value=3)
    bench.fault("bus_delay", None, can_id=0x201, value=1, way="sent")
    for party in buses:
        received = record_cycles(bench, party, 8)
        for cycle in received[2:]:
            assert 0x181 not in cycle
            assert 0x281 in cycle
            assert cycle.count(0x81) == 3
            assert cycle.index(0x201) < cycle.index(0x281)  # the set-point of the cycle before comes with this one
    bench.command("nc", on=False)


def test_client_frames_are_corrupted_for_drives_and_other_clients(
    bench: FeedDriveBench,
) -> None:
    sender, other = bench.join(), bench.join()
    bench.fault("bus_truncate", None, can_id=STRANGER, value=1, way="received")
    bench.fault("bus_late", None, can_id=STRANGER + 1, value=0.05)
    for _ in range(2):
        bench.wait_for("fault")
    together = [build_message(can_id, b"\1\2") for can_id in (STRANGER, STRANGER + 1, STRANGER + 2)]
    line: Any = sender
    line._tcp_send("".join(map(socketcand.convert_can_message_to_ascii_message, together)))
    received = receive_until(other, STRANGER + 1)
    reported = [(each.arbitration_id, bytes(each.data)) for each in received if each.arbitration_id < 0x700]
    assert reported == [(STRANGER, b"\1"), (STRANGER + 2, b"\1\2"), (STRANGER + 1, b"\1\2")]
    sender.send(build_message(0x601, bytes.fromhex("40 00 10 00 00 00 00 00")))
    assert not [each for each in receive_until(sender, 0x581) if STRANGER <= each.arbitration_id <= STRANGER + 2]


def test_fault_on_axis_applies_to_all_frames_of_its_drive(bench: FeedDriveBench) -> None:
    party = bench.join()
    bench.fault("bus_drop", "X", way="received", duration_s=0.02)
    for _ in range(3):
        party.send(build_message(0x601, bytes.fromhex("40 00 10 00 00 00 00 00")))
    assert {can_id for cycle in record_cycles(bench, party, 40) for can_id in cycle} >= {0x181, 0x201}
    party.send(build_message(0x601, bytes.fromhex("40 18 10 01 00 00 00 00")))
    assert bytes(receive_until(party, 0x581)[-1].data[1:4]) == b"\x18\x10\x01"


def test_bus_down_disconnects_clients_and_accepts_them_afterwards(bench: FeedDriveBench) -> None:
    place = CanBus(**bench.bus_arguments)
    bench.command("nc", on=True)
    bench.wait_for("nc")
    with bus_listener.ListeningBus("can0", place) as listening:
        wait_for(lambda: listening.read_counters()["frames"] > 20)
        bench.fault("bus_down", None, duration_s=0.1)
        wait_for(lambda: listening.end_reason is not None)
    assert "the CAN hub ended the connection" in str(listening.end_reason)
    wait_for(lambda: _can_receive(place))


def _can_receive(place: CanBus) -> bool:
    with contextlib.suppress(ConnectError), bus_listener.ListeningBus("can0", place) as listening:
        wait_for(lambda: listening.read_counters()["frames"] > 20 or listening.end_reason is not None)
        return listening.end_reason is None
    return False


@pytest.mark.parametrize("listed", [[], ["X:2"]])
def test_lockstep_does_not_wait_for_frames_lost_by_fault(listed: list[str]) -> None:
    document = bench_document("X")
    document["sim"] = {"pace": "lockstep", "lockstep_rpdo": listed}
    twin = SteppedSimulator(parse_config(document))
    twin.switch_on()
    for _ in range(3):
        twin.send_frame(0x301, bytes(4))
        twin.run_cycles(1)
    assert twin.machine.is_waiting_for_rpdo()
    twin.machine.mark_frame_lost("can0", 0x301)
    assert not twin.machine.is_waiting_for_rpdo()
    twin.run_cycles(1)
    assert twin.machine.is_waiting_for_rpdo()  # the next one may come


@pytest.mark.usefixtures("real_time")
def test_script_and_plan_in_documentation_are_valid(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "rehearse-a-fault.md").read_text("utf-8")
    (script,) = re.findall(r"^```toml\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    (tmp_path / "faults.toml").write_text(script, "utf-8")
    entries = fault_script.load_script(tmp_path / "faults.toml", ("X", "Y"))
    assert [entry.fault for entry in entries] == ["bus_drop", "bus_delay", "sensor_flipped"]
    (program,) = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    reported: list[str] = []
    exec(program, {"print": lambda *words: reported.append(" ".join(map(str, words)))})
    assert reported == ["0 frames dropped as planned"]


def test_faults_of_one_connection_do_not_affect_other_clients(bench: FeedDriveBench) -> None:
    party = bench.join([FrameFault("drop", can_ids={0x181}, way="received")])
    other = bench.join()
    assert all(0x181 not in cycle and 0x281 in cycle for cycle in record_cycles(bench, party, 4)[1:])
    assert all(0x181 in cycle for cycle in record_cycles(bench, other, 4)[1:])
