"""Invariants of a machine at every SYNC, independent of the guard's decisions."""

from __future__ import annotations

import json
import re
import sqlite3
from collections import Counter
from contextlib import closing
from typing import Any

from fdhil.guard.guard_protocol import AT_REST
from fdhil.guard.offset_adoption import list_applied_offsets
from fdhil.store.audit_file import read_entries
from tests.guard.frame_checks import Wire
from tests.machine.complete_machine import CompleteMachine

OFFSET = 0x60B000
LAG_SYNC = 150  # ten read-backs and more: by then the guard has seen what a drive holds
STATUS_LAG_S = 1.5  # the daemon asks the guard twice a second
WINDOW_LINE = re.compile(r" ([A-Z]): G0 [+-] at ")
TABLES = ("windows", "revisions", "notices", "skills", "loops")


class InvariantChecker:
    """Checks one machine and appends violations to its ``wrong``; ``counted`` is the number of checks."""

    def __init__(self, machine: CompleteMachine) -> None:
        self._machine = machine
        self.counted = Counter[str]()
        self._numbers = [unit.drive.dictionary.numbers for unit in machine.plant.units.values()]
        self._wires: dict[int, tuple[Any, Wire]] = {}
        self._sent: set[int] = set()
        self._guard: object = None
        self._untrue = Counter[str]()
        self._held_since_s: float | None = None
        machine.at_sync = self._check_sync
        machine.at_guard_frame = self._check_guard_frame
        machine.at_foreign_frame = self._check_foreign_frame

    def list_violations(self, text: str) -> None:
        """Report a violated invariant with the time."""
        self._machine.wrong.append(f"{self._machine.clock.now_s():.3f} s: {text}")

    def _check_offset_step(self) -> None:
        guard = self._machine.guard
        if guard is self._guard or guard is None:
            return
        self._guard, self._wires = guard, {}
        for axis in guard.settings.axes:
            unit = self._machine.plant.units[axis.name]
            self._wires[axis.offset.cob_id] = unit, Wire(axis.limits, self._has_offset(unit))

    @staticmethod
    def _has_offset(unit: Any) -> int:
        return int(unit.drive.dictionary.numbers[OFFSET])

    @property
    def _has_any_offset(self) -> bool:
        return any(numbers[OFFSET] for numbers in self._numbers)

    def _check_guard_frame(self, cob_id: int, data: bytes) -> None:
        self._check_offset_step()
        if cob_id not in self._wires:
            return
        unit, wire = self._wires[cob_id]
        self.counted["offset frames"] += 1
        self._sent.add(cob_id)
        value = int.from_bytes(data, "little", signed=True)
        if (wrong := wire.ours(value, self._has_offset(unit))) is not None:
            self.list_violations(f"axis {unit.axis}: {wrong}")

    def _check_foreign_frame(self, cob_id: int, data: bytes) -> None:
        if cob_id in self._wires and len(data) >= 4:
            self._wires[cob_id][1].foreign(int.from_bytes(data[:4], "little", signed=True))

    def _check_sync(self) -> None:
        self.counted["SYNC"] += 1
        self._check_offset_step()
        for cob_id, (_, wire) in self._wires.items():
            if cob_id not in self._sent:
                wire.nothing()
        self._sent.clear()
        self._check_guard_status()
        now_s = self._machine.clock.time_s
        if self._has_any_offset:
            self._held_since_s = now_s if self._held_since_s is None else self._held_since_s
        else:
            self._held_since_s = None

    def _check_guard_status(self) -> None:
        """Check that an idle guard reports the drive's true offset once it has read it back."""
        guard = self._machine.guard
        if guard is None or guard.state.mode not in AT_REST or guard._silent:
            self._untrue.clear()
            return
        for (unit, _), reported in zip(self._wires.values(), list_applied_offsets(guard.state), strict=True):
            held = self._has_offset(unit)
            is_true = reported in (None, held) or held == 0  # more than there is may be feared
            self._untrue[unit.axis] = 0 if is_true else self._untrue[unit.axis] + 1
            if self._untrue[unit.axis] == LAG_SYNC:
                self.list_violations(f"the guard reports that axis {unit.axis} holds {reported}, it holds {held}")

    def check_status(self) -> dict[str, Any]:
        """Request the daemon's status; its report of applied offsets must be true."""
        status = self._machine.request_daemon("status")
        self.counted["statuses"] += 1
        now_s = self._machine.clock.now_s()
        since_s = now_s if self._held_since_s is None else self._held_since_s
        if status["may_stand"]["nothing"] and now_s - since_s > STATUS_LAG_S:
            self.list_violations(
                f"the daemon reports that nothing is applied, the drives hold {self._machine.read_offset_um()} um"
            )
        return status

    def check_end(self) -> None:
        """Check the final state: drives at zero, no record lost or duplicated, no traceback in the log."""
        machine = self._machine
        if self._has_any_offset:
            self.list_violations(f"in the end the drives hold {machine.read_offset_um()} um")
        log = machine.log.getvalue()
        for word in ("Traceback", "InternalError"):
            if word in log:
                self.list_violations(f"the log has {word}: {log[log.index(word) - 200 : log.index(word) + 400]}")
        for line in machine.journal.splitlines():
            event = json.loads(line)
            if event["event"] == "failed":
                self.list_violations(f"the guard's loop failed: {event['text']}")
        self._check_records(log)

    def _check_records(self, log: str) -> None:
        logged = Counter(WINDOW_LINE.findall(log))
        history = self._machine.config.store.directory / "history.sqlite"
        key = "axis, start_tick, monotonic_ns"
        with closing(sqlite3.connect(history)) as db:
            rows = {table: db.execute(f"SELECT * FROM {table}").fetchall() for table in TABLES}
            kept = Counter(axis for (axis,) in db.execute("SELECT axis FROM windows"))
            doubled = db.execute(f"SELECT {key} FROM windows GROUP BY {key} HAVING count(*) > 1").fetchall()
            (sound,) = db.execute("PRAGMA integrity_check").fetchone()
        self.counted["records"] += sum(map(len, rows.values()))
        for axis, count in logged.items():
            if kept[axis] < count:
                self.list_violations(f"axis {axis}: {count} windows were acknowledged, {kept[axis]} are in the history")
        if doubled:
            self.list_violations(f"doubled windows: {doubled}")
        if sound != "ok":
            self.list_violations(f"the history is damaged: {sound}")
        for entry, trouble in read_entries(self._machine.config.store.directory):
            self.counted["audit lines"] += 1
            if trouble is not None:
                self.list_violations(f"the audit: {trouble}: {entry}")
