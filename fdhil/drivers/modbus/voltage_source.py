"""Chooses how a voltage sensor on Modbus is read, by its configured registers."""

from fdhil.config import MachineConfig
from fdhil.drivers.meter_voltage import BEYOND_LIMIT, MeterVoltage
from fdhil.drivers.modbus.block_voltage import BlockVoltage
from fdhil.drivers.modbus.register_meter import RegisterMeter
from fdhil.drivers.modbus.sampled_voltage import ModbusVoltage


def create_modbus_voltage(axis: str, config: MachineConfig) -> ModbusVoltage | MeterVoltage:
    """Create the voltage source ``modbus``: a block of samples, one value, or the simulated sensor's registers."""
    settings = config.axis[axis].voltage
    if settings.type is None:
        return ModbusVoltage(axis, config)
    if settings.block is not None:
        return BlockVoltage(axis, config)
    most = BEYOND_LIMIT * config.axis[axis].regulators.voltage_limit_v
    return MeterVoltage(axis, config, RegisterMeter(f"voltage sensor {axis}", settings, most))
