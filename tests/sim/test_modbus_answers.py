"""Corrupted answers of the simulated Modbus units, over TCP and serial lines: no wrong value is accepted."""

from __future__ import annotations

import contextlib
import socket
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest

from fdhil.config.sensor_sections import ModbusDevice
from fdhil.drivers.modbus import rtu_line
from fdhil.drivers.modbus.modbus_unit import ModbusUnit
from fdhil.errors import DeviceError
from fdhil.sim.wire.modbus_answers import ANSWER_FAULTS, answer_request, apply_answer_faults
from fdhil.sim.wire.modbus_tcp_servers import SensorServers
from fdhil.sim.wire.sensor_faults import SensorFaults
from fdhil.sim.wire.serial_lines import RtuUnits, SerialLines
from tests.drivers.serial_peer import build_frame
from tests.sim.test_modbus_sensor import create_sensor

READ = struct.pack(">BHH", 4, 0, 2)


class CountingRegisters:
    """Two registers with a 32-bit number that grows with each read; 10 may be written."""

    trigger: int | None = 10

    def __init__(self) -> None:
        self.read = 0x0001_FFF0

    def list_words(self) -> dict[int, int]:
        self.read += 7
        return {0: self.read >> 16, 1: self.read & 0xFFFF, 10: 0}

    def latch_samples(self) -> None:
        self.read = 0


def build_body(registers: CountingRegisters, faults: SensorFaults) -> bytes:
    return answer_request(registers, faults, READ)


@pytest.mark.parametrize(
    ("request_body", "code"),
    [
        (b"\x07", 1),
        (b"\x04\x00", 3),
        (struct.pack(">BHH", 3, 0, 0), 3),
        (struct.pack(">BHH", 3, 0, 126), 3),
        (struct.pack(">BHH", 3, 1, 2), 2),
        (struct.pack(">BHH", 6, 11, 1), 2),
        (struct.pack(">BHH", 6, 10, 2), 3),
        (struct.pack(">BHHBHH", 16, 10, 2, 4, 1, 1), 2),
    ],
)
def test_unsupported_requests_return_exception_code(request_body: bytes, code: int) -> None:
    assert answer_request(CountingRegisters(), SensorFaults(), request_body) == bytes([request_body[0] | 0x80, code])


@pytest.mark.parametrize("written", [struct.pack(">BHH", 6, 10, 1), struct.pack(">BHHBH", 16, 10, 1, 2, 1)])
def test_trigger_accepts_single_and_multiple_write(written: bytes) -> None:
    registers = CountingRegisters()
    assert answer_request(registers, SensorFaults(), written) == written[:5]
    assert registers.read == 0


def test_same_seed_corrupts_same_share_of_answers() -> None:
    def collect_pieces() -> list[list[bytes]]:
        registers, faults = CountingRegisters(), SensorFaults(answers={"flipped": 20.0})
        return [apply_answer_faults(faults, build_frame, 1, build_body(registers, faults)) for _ in range(500)]

    registers, faults = CountingRegisters(), SensorFaults()
    clean = [[build_frame(1, build_body(registers, faults))] for _ in range(500)]
    assert collect_pieces() == collect_pieces()
    assert sum(a != b for a, b in zip(collect_pieces(), clean, strict=True)) == pytest.approx(100, abs=40)


def test_torn_number_mixes_words_of_two_instants() -> None:
    registers, faults = CountingRegisters(), SensorFaults(answers={"torn": 100.0})
    reported = [
        apply_answer_faults(faults, lambda _unit, data: data, 1, build_body(registers, faults))[0] for _ in range(4)
    ]
    numbers = [int.from_bytes(data[2:], "big") for data in reported]
    assert numbers == [0x1FFF7, 0x1FFFE, 0x10005, 0x2000C]  # the high word of the answer before, the low one of now


@pytest.mark.parametrize(
    ("request_", "answered"),
    [
        ("010300000001", "03"),
        ("01100000000102000a", "9002"),  # only what may be written
        ("0107", "8701"),
        ("012b0e0100", "ab01"),
        ("01170000000100000001020007", "9701"),
        ("01080000a537", "8801"),
        ("0100", "8001"),
    ],
)
def test_serial_units_answer_every_function_like_tcp(request_: str, answered: str) -> None:
    party, (registers, faults) = RtuUnits(), (CountingRegisters(), SensorFaults())
    party.units[1] = registers, faults
    (frame,) = party.receive_bytes(build_frame(1, bytes.fromhex(request_)[1:]))
    assert frame.hex().startswith(f"01{answered}")
    assert build_frame(1, frame[1:-2]) == frame
    assert answer_request(registers, faults, bytes.fromhex(request_)[1:])[:1] == frame[1:2]


# -- through the driver


@pytest.fixture
def serial_unit(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[ModbusDevice, SensorFaults]]:
    """A served unit, with its address and faults."""
    registers = CountingRegisters()
    if request.param == "tcp":
        sensor = create_sensor()
        servers = SensorServers({"X": sensor}, {"X": ("127.0.0.1", 0)}, {"X": registers})
        servers.start()
        yield ModbusDevice(port=servers.ports["X"], timeout_s=60.0), sensor.faults
        servers.stop()
        return
    party, faults = RtuUnits(), SensorFaults()
    party.units[1] = registers, faults
    lines = SerialLines({str(tmp_path / "line"): party})
    lines.start()
    yield ModbusDevice(device=str(tmp_path / "line"), timeout_s=60.0, baud_rate=115200), faults
    lines.stop()


HARMLESS = {"tcp": {"split", "stale"}, "rtu": {"noisy", "split"}}
# TCP has a checksum of its own; an answer on a line names no request, and comes late by the sensor's slowness alone
NOT_MET = {("tcp", "flipped"), ("rtu", "stale"), ("tcp", "torn"), ("rtu", "torn")}


@pytest.mark.usefixtures("real_time")
@pytest.mark.parametrize(
    ("serial_unit", "kind"),
    [(wire, kind) for wire in HARMLESS for kind in ANSWER_FAULTS if (wire, kind) not in NOT_MET],
    indirect=["serial_unit"],
)
async def test_corrupted_answer_is_retried_or_reported_and_next_is_correct(
    kind: str, serial_unit: tuple[ModbusDevice, SensorFaults], monkeypatch: pytest.MonkeyPatch
) -> None:
    place, faults = serial_unit
    wire = "rtu" if place.device else "tcp"
    link = ModbusUnit("sensor", place)
    await link.connect()
    before = await read_number(link)
    faults.answers[kind] = 100.0
    if kind in HARMLESS[wire]:
        monkeypatch.setattr(rtu_line, "ADAPTER_S", 10.0)  # the other thread may take its time between two pieces
        assert before < await read_number(link) < before + 100
        monkeypatch.undo()
    else:
        link._timeout_s = 0.3
        with pytest.raises(DeviceError, match="sensor"):
            await read_number(link)
        link._timeout_s = 60.0
    faults.answers.clear()
    for _ in range(3):
        with contextlib.suppress(DeviceError):
            await link.connect()
            assert before < await read_number(link) < before + 200
            break
    else:
        raise AssertionError(kind)
    link.close()


async def read_number(link: ModbusUnit) -> int:
    high, low = await link.read_input_registers(0, 2)
    return high << 16 | low


def test_client_violating_modbus_is_disconnected() -> None:
    servers = SensorServers({"X": create_sensor()}, {"X": ("127.0.0.1", 0)})
    servers.start()
    try:
        for nonsense in (b"GET / HTTP/1.1\r\n\r\n", bytes(7), b"\0\1\0\0\xff\xff\1"):
            with socket.create_connection(("127.0.0.1", servers.ports["X"]), 60.0) as client:
                client.sendall(nonsense)
                with contextlib.suppress(ConnectionError):
                    assert client.recv(100) == b""
    finally:
        servers.stop()
