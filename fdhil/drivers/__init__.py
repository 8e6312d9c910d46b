"""Listens to the machine's wires and makes records of them: buses, drives, sensors, event sources."""

from fdhil.drivers.machine import MachineSource, Record, open_machine

__all__ = ["MachineSource", "Record", "open_machine"]
