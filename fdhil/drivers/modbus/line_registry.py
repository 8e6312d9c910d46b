"""Shares one line per device: two sensors on it must wait for each other, wherever they were created."""

import asyncio
from collections.abc import Hashable
from weakref import WeakValueDictionary

from fdhil.config import ModbusDevice
from fdhil.drivers.modbus.modbus_line import ModbusLine
from fdhil.drivers.modbus.rtu_line import RtuLine
from fdhil.drivers.modbus.tcp_line import TcpLine

_IN_USE: WeakValueDictionary[Hashable, ModbusLine] = WeakValueDictionary()


def get_line(place: ModbusDevice) -> ModbusLine:
    """Return the line to a device: the existing one, else a new one, not yet connected."""
    where = (
        (place.device, place.baud_rate, place.parity, place.stop_bits)
        if place.device
        else (place.host, place.port, place.framing)
    )
    key = (_get_running_loop(), where)  # a line belongs to one event loop
    line = _IN_USE.get(key)
    if line is None:
        line = RtuLine(place) if place.is_rtu else TcpLine(place.host, place.port)
        _IN_USE[key] = line
    return line


def _get_running_loop() -> asyncio.AbstractEventLoop | None:
    try:
        return asyncio.get_running_loop()
    except RuntimeError:
        return None
