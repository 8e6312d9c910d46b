"""Reads and plays the fault script: which fault starts when, on which axis, with which value and duration.

    [[fault]]
    at_s = 2.5                 # or at_sync, counted from the first SYNC; or at_row, from a played file's first row
    axis = "X"
    fault = "load_torque"
    value = 5.0                # its meaning depends on the fault, see fault_kinds
    duration_s = 0.3           # default: permanent

Invalid entries raise one ConfigError that lists all of them.
"""

from collections.abc import Mapping
from pathlib import Path

from pydantic import ValidationError

from fdhil.config import read_toml
from fdhil.errors import ConfigError, ConfigFault
from fdhil.sim.fault_kinds import FAULTS, FaultEntry
from fdhil.sim.simulated_axis import SimulatedAxis


def load_script(path: Path, axes: tuple[str, ...]) -> list[FaultEntry]:
    """Read a fault script for a machine with these axes; ConfigError with all errors."""
    document = read_toml(path, "a fault script")
    faults = [ConfigFault(key, "unknown key of a fault script", "use [[fault]]") for key in document if key != "fault"]
    entries: list[FaultEntry] = []
    listed = document.get("fault", [])
    for number, item in enumerate(listed if isinstance(listed, list) else [listed]):
        try:
            entries.append(parse_entry(item, axes))
        except ConfigError as error:
            faults += [ConfigFault(f"fault[{number}].{f.path}", f.what, f.suggestion) for f in error.faults]
    if faults:
        raise ConfigError(str(path), faults)
    return entries


def parse_entry(item: object, axes: tuple[str, ...]) -> FaultEntry:
    """Check one entry; ConfigError with all errors."""
    try:
        entry = FaultEntry.model_validate(item)
    except ValidationError as error:
        faults = [
            ConfigFault(".".join(map(str, e["loc"])) or "entry", e["msg"].removeprefix("Value error, "))
            for e in error.errors()
        ]
        raise ConfigError("fault", faults) from None
    if entry.axis is not None and entry.axis not in axes:
        raise ConfigError("fault", [ConfigFault("axis", f"unknown axis {entry.axis!r}", f"use {', '.join(axes)}")])
    return entry


class FaultSchedule:
    """Starts and ends faults by SYNC."""

    def __init__(self, units: Mapping[str, SimulatedAxis], period_s: float) -> None:
        self._units, self._period_s = units, period_s
        self._waiting: list[FaultEntry] = []
        self._running: list[tuple[int, FaultEntry]] = []  # with the SYNC at which it ends

    def add_entry(self, entry: FaultEntry) -> None:
        """Add an entry to the schedule; ConfigError when its object cannot hold its value."""
        if entry.fault == "object":
            wrong = self._select_axis(entry).explain_rejected_value(entry.index or 0, entry.sub, int(entry.number))
            if wrong:
                raise ConfigError("fault", [ConfigFault("object", wrong, "see the drive's EDS for its objects")])
        self._waiting.append(entry)

    @property
    def is_idle(self) -> bool:
        return not self._waiting and not self._running

    def run_due_faults(self, tick: int, row: int | None) -> list[FaultEntry]:
        """Start and end the faults due at this SYNC; return those started. ``row`` counts a played file's rows."""
        for end, entry in [item for item in self._running if item[0] <= tick]:
            self._running.remove((end, entry))
            self._apply_fault(entry, on=False)
        return self._start_faults([entry for entry in self._waiting if self._is_due(entry, tick, row)], tick)

    def start_immediate_faults(self, tick: int) -> list[FaultEntry]:
        """Start the entries without a condition, where no SYNC may ever come; return them."""
        return self._start_faults(
            [entry for entry in self._waiting if entry.start_conditions == (None, None, None)], tick
        )

    def _start_faults(self, due: list[FaultEntry], tick: int) -> list[FaultEntry]:
        for entry in due:
            self._waiting.remove(entry)
            self._apply_fault(entry, on=True)
            if entry.duration_s is not None:
                self._running.append((tick + max(1, round(entry.duration_s / self._period_s)), entry))
        return due

    def _is_due(self, entry: FaultEntry, tick: int, row: int | None) -> bool:
        if entry.at_row is not None:
            return row is not None and row >= entry.at_row
        at = entry.at_sync if entry.at_sync is not None else round((entry.at_s or 0.0) / self._period_s)
        return tick >= at

    def _apply_fault(self, entry: FaultEntry, *, on: bool) -> None:
        FAULTS[entry.fault].apply(self._select_axis(entry), entry, on)

    def _select_axis(self, entry: FaultEntry) -> SimulatedAxis:
        return self._units[entry.axis if entry.axis is not None else next(iter(self._units))]
