"""Chooses how a voltage sensor on Modbus is read, by its configured registers."""

from fdhil.config import MachineConfig
from fdhil.drivers.meter import BEYOND_LIMIT, MeterVoltage
from fdhil.drivers.modbus.block import BlockVoltage
from fdhil.drivers.modbus.meter import ModbusMeter
from fdhil.drivers.modbus.voltage import ModbusVoltage


def modbus_voltage(axis: str, config: MachineConfig) -> ModbusVoltage | MeterVoltage:
    """Create the voltage source ``modbus``: a block of samples, one value, or the simulated sensor's registers."""
    settings = config.axis[axis].voltage
    if settings.type is None:
        return ModbusVoltage(axis, config)
    if settings.block is not None:
        return BlockVoltage(axis, config)
    most = BEYOND_LIMIT * config.axis[axis].regulators.voltage_limit_v
    return MeterVoltage(axis, config, ModbusMeter(f"voltage sensor {axis}", settings, most))
