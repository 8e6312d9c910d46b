"""An NC that shows its state in coils and registers, served by pymodbus."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any, Self

from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from fdhil.records import MoveKind

COILS = {MoveKind.RAPID: 8, MoveKind.HOLD: 9, MoveKind.FEED: 10, MoveKind.ARC: 11}
REGISTERS = {"line": 100, "feed_override": 101, "rapid_override": 102, "tool": 103}
_PLC = 1


class ModbusPeer:
    """Coils 8 to 11 for rapid, hold, feed and arc, holding registers from 100 on for the numbers."""

    tells = frozenset(REGISTERS)
    knows = frozenset({*COILS, MoveKind.REST})

    def __init__(self) -> None:
        self._server: ModbusTcpServer | None = None
        self.coils = dict.fromkeys(COILS.values(), False)
        self.registers = dict.fromkeys(REGISTERS.values(), 100)
        self.requests: list[tuple[int, int, int]] = []

    @property
    def settings(self) -> Mapping[str, Any]:
        coils = {kind.value: str(place) for kind, place in COILS.items()}
        return {"port": self._port, "period_s": 0.005, "timeout_s": 60.0, **coils, **REGISTERS}

    async def _access(
        self, function: int, start: int, address: int, count: int, current: list[int], values: object
    ) -> None:
        """Copy the state into pymodbus's registers before it reads them; a coil is one bit."""
        self.requests.append((function, address, count))
        for place in range(len(current)):
            at = start + place
            if function == _PLC:
                bits = [self.coils.get(16 * at + bit, False) for bit in range(16)]
                current[place] = sum(set_ << bit for bit, set_ in enumerate(bits))
            else:
                current[place] = self.registers.get(at, 0)

    async def __aenter__(self) -> Self:
        coils = SimData(0, values=[False] * 64, datatype=DataType.BITS)
        inputs = SimData(0, values=[False] * 64, datatype=DataType.BITS)
        numbers = SimData(0, values=[0] * 200, datatype=DataType.REGISTERS)
        device = SimDevice(id=1, simdata=([coils], [inputs], [numbers], [numbers]), action=self._access)
        self._server = ModbusTcpServer(device, address=("127.0.0.1", 0))
        await self._server.serve_forever(background=True)
        listener = self._server.transport
        assert isinstance(listener, asyncio.Server)
        self._port = int(listener.sockets[0].getsockname()[1])
        return self

    async def __aexit__(self, *exception: object) -> None:
        assert self._server is not None
        self._server.serving.cancel()
        self._server.close()

    async def set_state(self, motion: MoveKind, **fields: Any) -> None:
        self.coils |= {place: kind is motion for kind, place in COILS.items()}
        for name, value in fields.items():
            scale = 100 if name.endswith("override") else 1
            self.registers[REGISTERS[name]] = round(scale * value)

    async def send_invalid_data(self) -> None:
        self.coils = dict.fromkeys(COILS.values(), True)
        self.registers = dict.fromkeys(REGISTERS.values(), 0xFFFF)
