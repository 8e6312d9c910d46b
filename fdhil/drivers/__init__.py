"""Receives from the machine's buses and sensors and turns it into records."""

from fdhil.drivers.machine_source import MachineSource, Record, open_machine

__all__ = ["MachineSource", "Record", "open_machine"]
