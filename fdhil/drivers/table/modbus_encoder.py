"""Polls an encoder at the table behind Modbus, such as an SSI or EnDat module, for the table's position."""

import asyncio

from fdhil.config import TableEncoder
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.modbus.modbus_unit import ModbusUnit
from fdhil.drivers.modbus.register_meter import RegisterMeter
from fdhil.records import TableSamples, freeze_array

SETTLE_STEPS, SETTLE_STEP_S = 8, 0.01  # wait until the SYNCs around the answer have been drained


class ModbusEncoder:
    """The table encoder of one axis; ``samples`` counts readings, none can be ``lost``."""

    lost = 0

    def __init__(self, axis: str, settings: TableEncoder) -> None:
        self.axis = axis
        self.name = f"table encoder {axis}"
        self.samples = 0
        self._meter = RegisterMeter(self.name, settings)
        self._period_s = settings.period_s

    @property
    def link(self) -> ModbusUnit:
        return self._meter.link

    async def poll_samples(self, ticks: TickClock) -> list[TableSamples]:
        """Wait for the period and read once; the value belongs between request and answer. Errors of the link pass."""
        await asyncio.sleep(self._period_s)
        value = await self._meter.read_value()
        self.samples += 1
        asked_ns, answered_ns = self._meter.asked_ns, self._meter.answered_ns
        for _ in range(SETTLE_STEPS):
            if not ticks.is_running or ticks.is_covered(answered_ns):
                break
            await asyncio.sleep(SETTLE_STEP_S)
        between = ticks.bound_ticks(asked_ns, answered_ns)
        if between is None:
            return []
        tick = freeze_array([(between[0] + between[1]) / 2])
        return [TableSamples(self.axis, "table_mm", tick, (between[1] - between[0]) / 2, freeze_array([value]))]

    async def format_reading(self) -> str:
        return f"{await self._meter.read_value():.4f} mm"
