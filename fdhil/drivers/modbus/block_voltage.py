"""Reads a voltage sensor that numbers its newest samples, at the configured registers."""

import math

from fdhil.config import MachineConfig, compute_block_registers
from fdhil.drivers.modbus.register_values import count_registers, decode_numbers, describe_other_orders
from fdhil.drivers.modbus.sampled_voltage import ModbusVoltage, SensorBlock
from fdhil.errors import ProtocolError
from fdhil.records import freeze_array


class BlockVoltage(ModbusVoltage):
    """The voltage source ``modbus`` with a section ``block``: samples and count come with one request."""

    def __init__(self, axis: str, config: MachineConfig) -> None:
        super().__init__(axis, config)
        settings = config.axis[axis].voltage
        assert settings.block is not None
        assert settings.type is not None
        self._settings, self._map, self._kind = settings, settings.block, settings.type
        self._orders = settings.word_order, settings.byte_order
        self._first, self._registers = compute_block_registers(settings)
        self._modulus = 1 << 16 * count_registers(self._map.counter_type)
        self._newest: int | None = None

    async def latch_samples(self) -> None:
        if self._map.trigger_address is not None:
            await self.link.write_register(self._map.trigger_address, 1)

    async def read_block(self) -> SensorBlock:
        """Read samples and count with one request; ProtocolError when they are implausible."""
        settings, block = self._settings, self._map
        registers = await self.link.read_registers(settings.function, self._first, self._registers)

        def select_words(address: int, count: int) -> list[int]:
            return registers[address - self._first : address - self._first + count]

        available = block.samples if block.count_address is None else select_words(block.count_address, 1)[0]
        if available > block.samples:
            text = f"register {block.count_address} gives {available} samples in a block of {block.samples}"
            raise ProtocolError(self.name, f"{text}; compare voltage.block with the sensor's register map")
        raw = decode_numbers(
            select_words(settings.address, available * count_registers(self._kind)), self._kind, *self._orders
        )
        raw = raw[::-1] if block.newest_first else raw
        volts = settings.scale * raw + settings.offset
        if not all(math.isfinite(v) and abs(v) <= self.limit_v for v in volts):
            text = f"registers {settings.address} on give {float(volts[0]):g} V as {self._kind}"
            text += describe_other_orders(
                select_words(settings.address, count_registers(self._kind)), self._kind, settings, self.limit_v
            )
            text += "; compare type, word_order, byte_order and scale with its register map"
            raise ProtocolError(self.name, text)
        count = count_registers(block.counter_type)
        counted = int(decode_numbers(select_words(block.counter_address, count), block.counter_type, *self._orders)[0])
        newest = self._unwrap_count(counted + (available - 1 if block.counter_of == "oldest" else 0))
        if block.count_address is not None and newest + 1 < available:  # it had wrapped before the first poll
            self._newest = newest = newest + self._modulus
        available = min(available, newest + 1)  # fewer, just switched on
        volts = volts[volts.size - available :]
        shown = float(volts[-1]) if available else 0.0
        return SensorBlock(newest, block.rate_hz, math.nan, False, newest + 1 - available, freeze_array(volts), shown)

    def _unwrap_count(self, newest: int) -> int:
        """Continue the count where the sensor's wraps to 0; any other decrease is a restart."""
        if self._newest is not None:
            ahead = (newest - self._newest) % self._modulus
            newest = self._newest + ahead if ahead < self._modulus // 2 else newest
        self._newest = newest
        return newest
