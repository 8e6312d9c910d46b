"""Modbus RTU on a pseudo terminal: frames, silent intervals, several units on one line, and damaged answers."""

from __future__ import annotations

import asyncio
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdhil.config.sensor_sections import ModbusDevice
from fdhil.drivers.modbus import rtu_line
from fdhil.drivers.modbus.modbus_unit import ModbusUnit
from fdhil.drivers.modbus.rtu_frames import build_frame, classify_fault, compute_crc16, find_answer
from fdhil.drivers.modbus.rtu_line import RtuLine
from fdhil.errors import ConnectError, DeviceError, DeviceTimeout, ProtocolError
from tests.drivers import serial_peer
from tests.drivers.serial_peer import RtuPeer, run_patiently, run_rtu_peer, wait_until


def connect_unit(peer: RtuPeer, unit: int = 1, timeout_s: float = 10.0, baud_rate: int = 115200) -> ModbusUnit:
    place = ModbusDevice(device=peer.device, unit=unit, timeout_s=timeout_s, baud_rate=baud_rate)
    return ModbusUnit(f"sensor {unit}", place)


@given(st.integers(1, 247), st.binary(max_size=40))
def test_checksum_matches_published_values(unit: int, body: bytes) -> None:
    assert build_frame(unit, body) == serial_peer.build_frame(unit, body)
    assert compute_crc16(build_frame(unit, body)) == 0


def build_answer(unit: int, *registers: int) -> bytes:
    return build_frame(unit, struct.pack(f">BB{len(registers)}H", 4, 2 * len(registers), *registers))


@given(st.binary(max_size=12), st.binary(max_size=6))
def test_an_answer_is_found_within_noise(before: bytes, after: bytes) -> None:
    found = find_answer(before + build_answer(1, 7, 9) + after, 1, 4, 2)
    assert found is not None
    assert found[0] in (4, 0x84)


@given(st.data())
def test_one_damaged_bit_is_never_an_answer(data: st.DataObject) -> None:
    frame = bytearray(build_answer(1, 0x4248, 0))
    at = data.draw(st.integers(0, 8 * len(frame) - 1))
    frame[at // 8] ^= 1 << at % 8
    assert find_answer(bytes(frame), 1, 4, 2) is None
    assert classify_fault(bytes(frame), 1, 4, 2)[0] in ("ModbusCrc", "ModbusShape", "ModbusUnit")


async def test_two_units_on_one_line_wait_for_each_other() -> None:
    async with run_rtu_peer(u1=[10, 11], u2=[20, 21]) as peer:
        links = [connect_unit(peer, unit) for unit in (1, 2)]
        assert links[0].line is links[1].line
        for link in links:
            await link.connect()
        read = await asyncio.gather(*(links[k % 2].read_registers(3 + k % 2, 0, 2) for k in range(20)))
        assert read == [[10, 11], [20, 21]] * 10
        assert [request[0] for request in peer.requests].count(1) == 10
        links[0].close()
        assert not links[0].is_connected
        assert links[1].is_connected
        assert await links[1].read_input_registers(1, 1) == [21]
        links[1].close()


@pytest.mark.parametrize(
    ("baud_rate", "silence_s"), [(9600, 3.5 * 11 / 9600), (19200, 3.5 * 11 / 19200), (115200, 1.75e-3)]
)
async def test_the_line_is_silent_between_frames(baud_rate: int, silence_s: float) -> None:
    async with run_rtu_peer(u1=[1]) as peer:
        link = connect_unit(peer, baud_rate=baud_rate)
        await link.connect()
        for _ in range(10):
            await link.read_input_registers(0, 1)
        link.close()
    assert isinstance(link.line, RtuLine)
    assert link.line.silence_s == pytest.approx(silence_s)
    gaps = [came - left for left, came in zip(peer.left_ns, peer.came_ns[1:], strict=False)]
    assert min(gaps) >= silence_s * 1e9


async def test_time_stamps_enclose_the_reading() -> None:
    async with run_rtu_peer(u1=[1]) as peer:
        link = connect_unit(peer)
        await link.connect()
        await link.read_input_registers(0, 1)
        link.close()
    assert link.asked_ns <= peer.came_ns[0] + 200_000
    assert link.answered_ns >= peer.left_ns[0]


SPOILT: dict[str, serial_peer.Spoil] = {
    "ModbusCrc": lambda frame: [frame[:-3] + bytes([frame[-3] ^ 4]) + frame[-2:]],
    "ModbusShape": lambda frame: [frame[:-4]],
    "noise": lambda frame: [b"\xff\x00\x13\x37\x80"],
    "too many": lambda frame: [serial_peer.build_frame(1, b"\x04\x06\x00\x01\x00\x02\x00\x03")],
}


@pytest.mark.usefixtures("real_time")
@pytest.mark.parametrize("what", SPOILT)
@pytest.mark.fault("B3", "B4", "B8")
@run_patiently
async def test_damaged_answer_is_requested_again_and_counted(what: str) -> None:
    kind = what if what.startswith("Modbus") else "ModbusShape"
    async with run_rtu_peer(u1=[7, 8]) as peer:
        link = connect_unit(peer, timeout_s=0.4 if what in ("noise", "ModbusShape") else 10.0)  # ours may still come
        await link.connect()
        peer.spoil = [SPOILT[what]] * 2
        assert await link.read_input_registers(0, 2) == [7, 8]
        assert link.line.fault_counts[kind] == 2
        peer.spoil = [SPOILT[what]] * 3
        with pytest.raises(ProtocolError) as caught:
            await link.read_input_registers(0, 2)
        assert link.classify_fault(caught.value) == kind
        assert len(peer.requests) == (7 if what in ("noise", "ModbusShape") else 6)  # one was a probe
        assert await link.read_input_registers(0, 2) == [7, 8]
        link.close()


@pytest.mark.parametrize(
    "pieces",
    [
        lambda frame: [b"\x00", frame],
        lambda frame: [frame[:3], frame[3:]],
        lambda frame: [serial_peer.build_frame(1, bytes.fromhex("0400000002")), frame],  # an adapter that hears itself
    ],
)
@pytest.mark.fault("B4")
async def test_noise_and_fragments_before_an_answer_are_skipped(
    pieces: serial_peer.Spoil, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rtu_line, "ADAPTER_S", 10.0)  # the kernel may take its time from one piece to the next
    async with run_rtu_peer(u1=[7, 8]) as peer:
        link = connect_unit(peer)
        await link.connect()
        peer.spoil = [pieces]
        assert await link.read_input_registers(0, 2) == [7, 8]
        assert len(peer.requests) == 1
        link.close()


@pytest.mark.fault("B4", "B7")
async def test_answer_after_noise_belongs_to_its_own_request() -> None:
    async with run_rtu_peer(u1=[7, 8]) as peer:
        link = connect_unit(peer, timeout_s=60.0)
        await link.connect()
        peer.spoil = [lambda frame: [b"\xff\x00\x13\x37\x80"]]
        asking = asyncio.create_task(link.read_input_registers(0, 2))
        await peer.heard.wait()
        await asyncio.sleep(0.1)
        peer.send_bytes(build_answer(1, 7, 8))
        assert await asking == [7, 8]
        assert len(peer.requests) == 1
        link.close()


@pytest.mark.fault("B4", "B7")
@run_patiently
async def test_noise_does_not_end_the_wait_for_a_late_answer() -> None:
    async with run_rtu_peer(u1=[7, 8]) as peer:
        link = connect_unit(peer, timeout_s=0.4)
        line = link.line
        assert isinstance(line, RtuLine)
        await link.connect()
        peer.spoil = [lambda frame: []]
        with pytest.raises(DeviceTimeout):
            await link.read_input_registers(0, 2)
        asking = asyncio.create_task(link.read_input_registers(0, 2))
        peer.send_bytes(b"\xff")
        await wait_until(lambda: not line._port._chunks and line._port._kept == 0 and len(peer.requests) == 1)
        peer.send_bytes(build_answer(1, 1, 1))
        assert await asking == [7, 8]
        link.close()


@pytest.mark.fault("B6")
async def test_answer_of_another_unit_is_ignored() -> None:
    async with run_rtu_peer(u1=[7, 8]) as peer:
        link = connect_unit(peer, timeout_s=60.0)
        await link.connect()
        peer.spoil = [lambda frame: [serial_peer.build_frame(2, b"\x04\x04\x00\x63\x00\x63")]]
        asking = asyncio.create_task(link.read_input_registers(0, 2))
        await wait_until(lambda: link.line.fault_counts["ModbusUnit"])
        peer.send_bytes(build_answer(1, 7, 8))
        assert await asking == [7, 8]
        assert link.line.fault_counts["ModbusUnit"] == 1
        link.close()


@pytest.mark.usefixtures("real_time")
@pytest.mark.fault("B7")
@run_patiently
async def test_late_answer_is_not_used_for_the_next_request() -> None:
    async with run_rtu_peer(u1=[7, 8]) as peer:
        link = connect_unit(peer, timeout_s=3.0)  # a pseudo terminal of a busy computer may take half a second
        line = link.line
        assert isinstance(line, RtuLine)
        await link.connect()
        peer.spoil = [lambda frame: []]
        with pytest.raises(DeviceTimeout, match=r"was not answered within 3 s"):
            await link.read_input_registers(0, 2)
        asking = asyncio.create_task(link.read_input_registers(0, 2))
        await asyncio.sleep(0.01)
        assert len(peer.requests) == 1  # the line is heard before anybody asks again
        peer.send_bytes(build_answer(1, 1, 1))
        assert await asking == [7, 8]
        assert link.line.fault_counts["ModbusStale"] == 1
        peer.send_bytes(build_answer(1, 2, 2))  # and later still
        await wait_until(lambda: line._port._chunks)
        assert await link.read_input_registers(0, 2) == [7, 8]
        assert link.line.fault_counts["ModbusStale"] == 2
        link.close()


@pytest.mark.fault("B2")
async def test_refusal_names_the_register() -> None:
    async with run_rtu_peer(u1=[7]) as peer:
        link = connect_unit(peer)
        await link.connect()
        with pytest.raises(ProtocolError, match=r"register 5 is refused \(illegal register address\)"):
            await link.read_input_registers(5, 2)
        await link.write_register(3, 9)
        assert peer.written == [(3, 9)]
        link.close()


@pytest.mark.fault("B5")
async def test_unplugged_adapter_is_reported_until_it_returns(tmp_path: Path) -> None:
    async with run_rtu_peer(u1=[7]) as peer:
        adapter = tmp_path / "adapter"  # the number of a terminal that is gone is the next one's, of whichever program
        adapter.symlink_to(peer.device)
        peer.device = str(adapter)
        link = connect_unit(peer, timeout_s=60.0)
        await link.connect()
        asking = asyncio.create_task(link.read_registers(3, 0, 1))
        peer.spoil = [lambda frame: []]
        await peer.heard.wait()
        peer.unplug()
        adapter.unlink()
        with pytest.raises(ConnectError, match=f"the serial device {adapter} is gone"):
            await asking
        assert not link.is_connected
        with pytest.raises(DeviceError, match="serial device"):
            await link.connect()
        link.close()


async def test_device_in_use_is_reported() -> None:
    async with run_rtu_peer(u1=[7]) as peer:
        link = connect_unit(peer)
        await link.connect()
        other = ModbusUnit("sensor 2", ModbusDevice(device=peer.device, baud_rate=9600))
        with pytest.raises(ConnectError, match="is used by another program"):
            await other.connect()
        link.close()
