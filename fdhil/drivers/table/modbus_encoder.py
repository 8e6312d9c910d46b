"""Polls an encoder at the table behind Modbus, such as an SSI or EnDat module, for the table's position."""

import asyncio

from fdhil.config import TableEncoder
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.modbus.link import ModbusLink
from fdhil.drivers.modbus.meter import ModbusMeter
from fdhil.records import TableSamples, freeze_array

SETTLE_STEPS, SETTLE_STEP_S = 8, 0.01  # wait until the SYNCs around the answer have been drained


class ModbusEncoder:
    """The table encoder of one axis; ``samples`` counts readings, none can be ``lost``."""

    lost = 0

    def __init__(self, axis: str, settings: TableEncoder) -> None:
        self.axis = axis
        self.name = f"table encoder {axis}"
        self.samples = 0
        self._meter = ModbusMeter(self.name, settings)
        self._period_s = settings.period_s

    @property
    def link(self) -> ModbusLink:
        return self._meter.link

    async def poll(self, ticks: TickClock) -> list[TableSamples]:
        """Wait for the period and read once; the value belongs between request and answer. Errors of the link pass."""
        await asyncio.sleep(self._period_s)
        value = await self._meter.value()
        self.samples += 1
        asked_ns, answered_ns = self._meter.asked_ns, self._meter.answered_ns
        for _ in range(SETTLE_STEPS):
            if not ticks.running or ticks.covers(answered_ns):
                break
            await asyncio.sleep(SETTLE_STEP_S)
        between = ticks.bounds(asked_ns, answered_ns)
        if between is None:
            return []
        tick = freeze_array([(between[0] + between[1]) / 2])
        return [TableSamples(self.axis, "table_mm", tick, (between[1] - between[0]) / 2, freeze_array([value]))]

    async def reading(self) -> str:
        return f"{await self._meter.value():.4f} mm"
