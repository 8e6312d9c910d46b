"""An NC with its state in coils or registers: the requests, the meaning of the answers, and the faults."""

from __future__ import annotations

import asyncio
import contextlib
import struct
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.config import MachineConfig
from fdhil.drivers.modbus.rtu_frames import BIT_READS, build_frame, count_data_bytes, find_answer, unpack_values
from fdhil.drivers.nc.modbus_coil import ModbusCoilSource
from fdhil.errors import ConfigError, DeviceError, DeviceTimeout, ProtocolError
from fdhil.records import MoveKind, NcState
from tests.drivers.frame_builder import build_machine_config
from tests.drivers.nc.modbus_peer import ModbusPeer


def build_config(**keys: Any) -> MachineConfig:
    return build_machine_config(g0={"source": "modbus_coil"}, nc_source={"modbus_coil": {"timeout_s": 60.0, **keys}})


async def read_once(config: MachineConfig) -> NcState:
    async with ModbusCoilSource(config) as source:
        return (await source.read_states())[-1]


@asynccontextmanager
async def run_answering_server(answer: Callable[[bytes], bytes | None]) -> AsyncIterator[int]:
    """Serve a unit that gives this answer (function and data, None: none) to each request, and yield its port."""
    writers = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writers.append(writer)
        with contextlib.suppress(OSError, asyncio.IncompleteReadError):
            while True:
                head = await reader.readexactly(7)
                body = answer(await reader.readexactly(struct.unpack(">H", head[4:6])[0] - 1))
                if body is not None:
                    writer.write(head[:4] + struct.pack(">HB", len(body) + 1, head[6]) + body)

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()
        for writer in writers:
            writer.close()
        await server.wait_closed()


async def test_bits_of_one_kind_are_read_with_one_request() -> None:
    async with ModbusPeer() as peer:
        await peer.set_state(MoveKind.ARC, line=7)
        state = await read_once(build_config(**peer.settings))
    assert (state.motion, state.line) == (MoveKind.ARC, 7)
    assert len(peer.requests) == 2  # four coils, four registers


async def test_feed_hold_outranks_rapid() -> None:
    async with ModbusPeer() as peer:
        peer.coils = {8: True, 9: True}
        assert (await read_once(build_config(**peer.settings))).motion is MoveKind.HOLD


async def test_bits_and_numbers_can_share_registers() -> None:
    words = {12: 0b1000, 13: 55}

    def answer(request: bytes) -> bytes:
        _, first, count = struct.unpack(">BHH", request)
        return struct.pack(f">BB{count}H", request[0], 2 * count, *(words[first + k] for k in range(count)))

    async with run_answering_server(answer) as port:
        keys = {"port": port, "bits": "input_registers", "numbers": "input_registers", "rapid": "12.3"}
        state = await read_once(build_config(**keys, feed_override=13))
        assert state.motion is MoveKind.RAPID
        assert state.feed_override == pytest.approx(0.55)
        words[12] = 0b0111
        assert (await read_once(build_config(**keys))).motion is MoveKind.REST


async def test_time_stamp_error_includes_answer_time_and_plc_cycle() -> None:
    async with ModbusPeer() as peer:
        slow = await read_once(build_config(**{**peer.settings, "renewed_s": 0.4}))
    assert slow.error_ns >= 200_000_000


async def test_silent_unit_times_out_and_refusal_gives_its_reason() -> None:
    async with run_answering_server(lambda request: bytes([request[0] | 0x80, 2])) as port:
        with pytest.raises(ProtocolError, match="illegal register address"):
            await read_once(build_config(port=port))
    async with run_answering_server(lambda request: None) as port:
        with pytest.raises(DeviceTimeout, match="was not answered"):
            await read_once(build_config(port=port, timeout_s=0.05))


@settings(max_examples=40)
@given(st.binary(min_size=1, max_size=12))
def test_any_answer_gives_a_state_or_a_device_error(body: bytes) -> None:
    async def ask() -> None:
        async with run_answering_server(lambda request: body) as port:
            with contextlib.suppress(DeviceError):
                state = await read_once(build_config(port=port, timeout_s=0.02, feed_override=5))
                # the one answer that is whole: a coil and a register cannot both be read of it
                raise AssertionError(f"{body!r} was read as {state}")

    asyncio.run(ask())


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({"rapid": "3.1"}, "coils have no bits"),
        ({"bits": "holding_registers", "rapid": "3"}, "register without a bit"),
        ({"bits": "holding_registers", "rapid": "3.16"}, "at 15"),
        ({"rapid": "70000"}, "65535"),
        ({"rapid": "0", "hold": "2500"}, "too far apart"),
        ({"line": 0, "tool": 200}, "too far apart"),
        ({"rapid": "x"}, "rapid"),
        ({"period_s": 1.5}, "half of silence_s"),
        ({"device": "/dev/ttyUSB0", "period_s": 0.005}, "of the time of /dev/ttyUSB0"),
    ],
)
def test_invalid_addresses_are_refused(keys: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        build_config(**keys)


@given(st.lists(st.booleans(), min_size=1, max_size=40), st.sampled_from(BIT_READS), st.integers(1, 247))
def test_bits_survive_an_rtu_frame(bits: list[bool], function: int, unit: int) -> None:
    data = bytearray(count_data_bytes(function, len(bits)))
    for place, bit in enumerate(bits):
        data[place // 8] |= bit << place % 8
    frame = build_frame(unit, bytes([function, len(data), *data]))
    found = find_answer(b"\x00" + frame, unit, function, len(bits))
    assert found is not None
    assert unpack_values(found[2:], function, len(bits)) == tuple(map(int, bits))
