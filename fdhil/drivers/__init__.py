"""Adapters between the machine's wires and the records: buses, drives, sensors, event sources."""

from fdhil.drivers.machine import MachineSource, Record, open_machine

__all__ = ["MachineSource", "Record", "open_machine"]
