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
from fdhil.drivers.modbus.rtu import BIT_READS, data_bytes, find_answer, framed, numbers_in
from fdhil.drivers.nc.modbus_coil import ModbusCoil
from fdhil.errors import ConfigError, DeviceError, DeviceTimeout, ProtocolError
from fdhil.records import MoveKind, NcState
from tests.drivers.nc.modbus_peer import ModbusPeer
from tests.drivers.wire import machine


def config_of(**keys: Any) -> MachineConfig:
    return machine(g0={"source": "modbus_coil"}, nc_source={"modbus_coil": {"timeout_s": 60.0, **keys}})


async def once(config: MachineConfig) -> NcState:
    async with ModbusCoil(config) as source:
        return (await source.read())[-1]


@asynccontextmanager
async def answering(answer: Callable[[bytes], bytes | None]) -> AsyncIterator[int]:
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
        await peer.say(MoveKind.ARC, line=7)
        state = await once(config_of(**peer.settings))
    assert (state.motion, state.line) == (MoveKind.ARC, 7)
    assert len(peer.requests) == 2  # four coils, four registers


async def test_a_hold_is_more_than_a_rapid() -> None:
    async with ModbusPeer() as peer:
        peer.coils = {8: True, 9: True}
        assert (await once(config_of(**peer.settings))).motion is MoveKind.HOLD


async def test_bits_may_lie_in_a_register_beside_the_numbers() -> None:
    words = {12: 0b1000, 13: 55}

    def answer(request: bytes) -> bytes:
        _, first, count = struct.unpack(">BHH", request)
        return struct.pack(f">BB{count}H", request[0], 2 * count, *(words[first + k] for k in range(count)))

    async with answering(answer) as port:
        keys = {"port": port, "bits": "input_registers", "numbers": "input_registers", "rapid": "12.3"}
        state = await once(config_of(**keys, feed_override=13))
        assert state.motion is MoveKind.RAPID
        assert state.feed_override == pytest.approx(0.55)
        words[12] = 0b0111
        assert (await once(config_of(**keys))).motion is MoveKind.REST


async def test_the_error_of_a_stamp_is_the_answers_time_and_the_plcs_cycle() -> None:
    async with ModbusPeer() as peer:
        slow = await once(config_of(**{**peer.settings, "renewed_s": 0.4}))
    assert slow.error_ns >= 200_000_000


async def test_a_silent_unit_is_a_time_out_and_one_that_refuses_says_why() -> None:
    async with answering(lambda request: bytes([request[0] | 0x80, 2])) as port:
        with pytest.raises(ProtocolError, match="illegal register address"):
            await once(config_of(port=port))
    async with answering(lambda request: None) as port:
        with pytest.raises(DeviceTimeout, match="was not answered"):
            await once(config_of(port=port, timeout_s=0.05))


@settings(max_examples=40)
@given(st.binary(min_size=1, max_size=12))
def test_whatever_is_answered_a_device_error_or_a_state_comes_of_it(body: bytes) -> None:
    async def ask() -> None:
        async with answering(lambda request: body) as port:
            with contextlib.suppress(DeviceError):
                state = await once(config_of(port=port, timeout_s=0.02, feed_override=5))
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
def test_places_that_cannot_be_are_refused(keys: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        config_of(**keys)


@given(st.lists(st.booleans(), min_size=1, max_size=40), st.sampled_from(BIT_READS), st.integers(1, 247))
def test_bits_come_out_of_an_rtu_frame_as_they_were_put_in(bits: list[bool], function: int, unit: int) -> None:
    data = bytearray(data_bytes(function, len(bits)))
    for place, bit in enumerate(bits):
        data[place // 8] |= bit << place % 8
    frame = framed(unit, bytes([function, len(data), *data]))
    found = find_answer(b"\x00" + frame, unit, function, len(bits))
    assert found is not None
    assert numbers_in(found[2:], function, len(bits)) == tuple(map(int, bits))
