"""Serves simulated sensors by Modbus TCP, in their own thread.

Source: MODBUS messaging on TCP/IP implementation guide V1.0b, 3.1.
"""

import asyncio
import struct
import threading
import time
from collections.abc import Awaitable, Callable, Mapping
from functools import partial

from fdhil.errors import ConnectError
from fdhil.sim.wire.modbus_answers import Seal, answer_request, apply_answer_faults
from fdhil.sim.wire.modbus_sensor import VoltageSensor
from fdhil.sim.wire.register_maps import RegisterMap
from fdhil.sim.wire.sensor_faults import SensorFaults
from fdhil.sim.wire.serial_lines import RtuUnits

_HEADER = struct.Struct(">HHHB")  # transaction, protocol (0), bytes that follow, unit
_MOST_BYTES = 254
_GATEWAY_TARGET = 11  # exception of a gateway whose unit does not answer
_PIECES_S = 0.005
ANY_UNIT = 0
_Units = Mapping[int, tuple[RegisterMap, SensorFaults]]
_Conversation = Callable[[asyncio.StreamReader, asyncio.StreamWriter, _Units], Awaitable[None]]


class SensorServers:
    """The Modbus TCP servers of a machine, in one thread; ``ports`` by axis once :meth:`start` has returned.

    Any unit identifier is answered, as TCP sensors do, except behind a gateway.
    """

    def __init__(
        self,
        sensors: Mapping[str, VoltageSensor],
        addresses: Mapping[str, tuple[str, int]],
        maps: Mapping[str, RegisterMap] | None = None,
        units: Mapping[str, int] | None = None,
        over_rtu: frozenset[str] = frozenset(),
    ) -> None:
        """Serve the sensors that have an address, with the registers of ``maps`` in place of their own.

        Sensors that share an address are behind a gateway: each answers to its own number of ``units`` only. Those of
        ``over_rtu`` are behind a serial server, which passes RTU frames.
        """
        self._over_rtu = over_rtu
        self._sensors, self._addresses, self._units = sensors, addresses, units or {}
        self._maps: Mapping[str, RegisterMap] = sensors if maps is None else maps
        self._servers: list[asyncio.Server] = []
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run_loop, name="sim-modbus", daemon=True)
        self.ports: dict[str, int] = {}

    def start(self) -> None:
        """Open every port; ConnectError when one cannot be opened."""
        self._thread.start()
        try:
            asyncio.run_coroutine_threadsafe(self._open_servers(), self._loop).result()
        except ConnectError:
            self.stop()
            raise

    def stop(self) -> None:
        asyncio.run_coroutine_threadsafe(self._close_servers(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def _run_loop(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_forever()

    async def _open_servers(self) -> None:
        for axes in self._group_by_address():
            port = await self._start_server(axes)
            self.ports |= dict.fromkeys(axes, port)

    def _group_by_address(self) -> list[list[str]]:
        """Return the axes by shared server; port 0 is never shared."""
        shared: dict[tuple[str, int | str], list[str]] = {}
        for axis, (host, port) in self._addresses.items():
            shared.setdefault((host, port or axis), []).append(axis)
        return list(shared.values())

    async def _start_server(self, axes: list[str]) -> int:
        host, port = self._addresses[axes[0]]
        units = {
            self._units[axis] if len(axes) > 1 else ANY_UNIT: (self._maps[axis], self._sensors[axis].faults)
            for axis in axes
        }
        if axes[0] in self._over_rtu:
            units = {self._units[axis]: (self._maps[axis], self._sensors[axis].faults) for axis in axes}
        converse = _pass_rtu_frames if axes[0] in self._over_rtu else _serve_requests
        try:
            server = await asyncio.start_server(partial(self._serve_client, converse, units), host, port)
        except OSError:
            raise ConnectError(
                f"voltage sensor {axes[0]}",
                f"TCP port {port} of {host} cannot be opened; end the program that uses it, or set "
                f"axis.{axes[0]}.voltage.port to another one (0 lets the simulator choose one)",
            ) from None
        self._servers.append(server)
        return int(server.sockets[0].getsockname()[1])

    @staticmethod
    async def _serve_client(
        converse: _Conversation, units: _Units, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        try:
            await converse(reader, writer, units)
        except (asyncio.IncompleteReadError, OSError, asyncio.CancelledError):
            return  # the client has left, or the simulator stops
        finally:
            writer.close()

    async def _close_servers(self) -> None:
        for server in self._servers:
            server.close()
        others = asyncio.all_tasks(self._loop) - {asyncio.current_task(self._loop)}
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)


async def _pass_rtu_frames(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, units: _Units) -> None:
    """Pass requests to units on a serial line, and their answers back, until the client leaves."""
    line = RtuUnits()
    line.units = dict(units)
    while data := await reader.read(_MOST_BYTES):
        pieces = line.receive_bytes(data)
        if (due_s := line.find_due_s()) < float("inf"):
            await asyncio.sleep(due_s - time.monotonic())
            pieces = line.send_unprompted()
        await _write_pieces(writer, pieces)


async def _write_pieces(writer: asyncio.StreamWriter, pieces: list[bytes]) -> None:
    for n, piece in enumerate(pieces):
        await asyncio.sleep(_PIECES_S if n else 0.0)
        writer.write(piece)
        await writer.drain()


async def _serve_requests(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, units: _Units) -> None:
    """Answer the requests of one client in order, until it leaves or violates the protocol."""
    while True:
        transaction, protocol, size, unit = _HEADER.unpack(await reader.readexactly(_HEADER.size))
        if protocol != 0 or not 2 <= size <= _MOST_BYTES:
            return
        request = await reader.readexactly(size - 1)
        seal = _create_framing(transaction)
        served = units.get(ANY_UNIT) or units.get(unit)
        if served is None:
            pieces = [seal(unit, bytes([request[0] | 0x80, _GATEWAY_TARGET]))]
        else:
            registers, faults = served
            await asyncio.sleep(faults.slow_s)
            pieces = apply_answer_faults(faults, seal, unit, answer_request(registers, faults, request))
        await _write_pieces(writer, pieces)


def _create_framing(transaction: int) -> Seal:
    return lambda unit, body: _HEADER.pack(transaction, 0, len(body) + 1, unit) + body
