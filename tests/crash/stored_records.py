"""What the product keeps on disk, kind by kind: store the record of a number, and list the intact numbers.

The content of each record follows from its number alone, so that a wrong record is detected. ``keep`` returns when the
record is acknowledged; it raises FdhilError when the product refused it.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO, Protocol
from unittest.mock import patch

import numpy as np

from fdhil.arming import checked_program, program_check
from fdhil.arming.code_digest import compute_code_digest
from fdhil.commissioning.commissioning_record import CommissioningRecord, load_record, save_record
from fdhil.commissioning.step_progress import StepProgress
from fdhil.commissioning.void_mark import is_record_void, mark_record_void
from fdhil.config import MachineConfig
from fdhil.correction.learned_offsets import LearnedOffset
from fdhil.daemon import black_box
from fdhil.daemon.outcome_store import WINDOWS_FOLDER, OutcomeStore
from fdhil.errors import FdhilError, RecordingError, StoreError
from fdhil.records import Notice, Outcome, Window
from fdhil.store import audit_file, learned_offset_files
from fdhil.store.history_database import History
from fdhil.store.window_file import list_windows, read_window
from tests.daemon.simulated_machine import config_of
from tests.store.sample_records import is_bit_identical, make_outcome, make_published, make_window

SAMPLES = 150
WINDOWS_KEPT = 2
STEPS = 40
FIRST_TICK = 1000
MUCH_LATER = 10**6  # a number that comes after any other
CODE = compute_code_digest()
_LINE = re.compile(r"\(\d+\.\d{6}\) can0 \d+#\w*$")


class Keeper(Protocol):
    said: list[str]

    def keep(self, number: int) -> None:
        """Keep a record; FdhilError where it was refused."""

    def found(self) -> set[int]:
        """Return the records that are accepted; AssertionError where one differs from what was stored."""

    def close(self) -> None:
        """Let go what is open."""


class Refused(FdhilError):
    """The daemon's store said that it could not keep something."""


def configured(folder: Path) -> MachineConfig:
    return config_of(folder, store={"directory": str(folder), "keep_windows": WINDOWS_KEPT})


def check_readable(file: Path) -> Window | None:
    try:
        return read_window(file)
    except RecordingError as error:
        if "; " not in str(error):
            raise  # it says no more than that
        return None


class DaemonKeeper:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.store = OutcomeStore(configured(folder))
        opened = self.store.open()  # a window that was half written when it all ended is told, and is no loss
        self.said = [f"{notice.code}: {notice.text}" for notice in opened if notice.code != "StrayFiles"]

    def outcomes(self, number: int) -> list[Outcome]:
        raise NotImplementedError

    def keep(self, number: int) -> None:
        refused = [notice for notice in self.store.store_outcomes(self.outcomes(number)) if notice.severity == "MAJOR"]
        if refused or self.store.fault:
            raise Refused(refused[0].text if refused else f"{self.store.fault}; told before")

    def close(self) -> None:
        self.store.close()


class Rapids(DaemonKeeper):
    def outcomes(self, number: int) -> list[Outcome]:
        return [make_outcome(of=make_window(SAMPLES, seed=number, start_tick=FIRST_TICK + number))]

    def found(self) -> set[int]:
        with History.open_read_only(self.folder) as history:
            rows = history.read_windows("X")
        files = list_windows(self.folder / WINDOWS_FOLDER).windows
        names, refused = {file.path.name for file in files}, set[int]()
        for row in rows:
            number = row.start_tick - FIRST_TICK
            if row.file in names:
                kept = make_window(SAMPLES, seed=number, start_tick=row.start_tick)
                found = check_readable(self.folder / WINDOWS_FOLDER / row.file)
                assert found is None or is_bit_identical(found, kept), f"rapid {number} is another"
                if found is None:
                    refused.add(number)
            else:
                newer = [file for file in files if file.path.name > row.file]
                assert len(newer) >= WINDOWS_KEPT, f"rapid {number} has no file, and {len(newer)} are newer"
        return in_order(row.start_tick - FIRST_TICK for row in rows) - refused


class Sets(DaemonKeeper):
    def outcomes(self, number: int) -> list[Outcome]:
        return [make_published(number)]

    def keep(self, number: int) -> None:
        self.store.fault = None
        super().keep(number)

    def found(self) -> set[int]:
        with History.open_read_only(self.folder) as history:
            sets = [row.set for row in history.read_revisions("X")]
        for result in sets:
            kept = make_published(result.revision)
            equal = result.parameters == kept.parameters and result.covariance.tobytes() == kept.covariance.tobytes()
            assert equal, f"revision {result.revision} is another"
        return in_order(result.revision for result in sets)


class Notices(DaemonKeeper):
    def outcomes(self, number: int) -> list[Outcome]:
        return [Notice("Tested", "MAJOR", f"notice {number}", "X", number)]

    def keep(self, number: int) -> None:
        self.store.fault = None
        super().keep(number)
        waits = self.store.notices.build_status()["newest"]
        self.store.store_acknowledgement({"by": f"person {number}", "notices": [waits[-1]["number"]]})

    def found(self) -> set[int]:
        with History.open_read_only(self.folder) as history:
            rows = [row for row in history.read_notices() if row.notice.code == "Tested" and row.acknowledged]
        for row in rows:
            assert row.notice.text == f"notice {row.notice.tick}", f"notice {row.notice.tick} is another"
        return in_order(row.notice.tick for row in rows)


class Plain:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.said: list[str] = []

    def close(self) -> None:
        """Nothing is open."""


class Audit(Plain):
    def keep(self, number: int) -> None:
        self.folder.mkdir(exist_ok=True)
        audit_file.append_entry(self.folder, {"asked": "arm", "number": number})

    def found(self) -> set[int]:
        good = [entry for entry, wrong in audit_file.read_entries(self.folder) if wrong is None]
        return in_order(entry["number"] for entry in good)


class LearnedOffsets(Plain):
    def keep(self, number: int) -> None:
        learned = LearnedOffset({"X": np.full(50, float(number))}, float(number), 1.0, (float(number),))
        with patch.object(learned_offset_files, "MOST_PROGRAMS", WINDOWS_KEPT):
            learned_offset_files.write_learned(
                learned_offset_files.make_learned_path(self.folder / "lessons", f"{number:032d}", "made"), learned
            )

    def found(self) -> set[int]:
        there = {
            int(program): lesson
            for _, program, lesson in learned_offset_files.list_learned(self.folder / "lessons", "made")
        }
        for number, learned in there.items():
            whole = np.array_equal(learned.offset_um["X"], np.full(50, number)) and learned.curve_um == (float(number),)
            assert whole, f"lesson {number} is another"
        gone = range(1, max(there, default=0)) if len(there) >= WINDOWS_KEPT else range(0)
        return {*there, *gone}


class Steps(Plain):
    def keep(self, number: int) -> None:
        StepProgress(self.folder, "X").save_step(f"step {number % STEPS}", "this drive", {"number": number})

    def found(self) -> set[int]:
        progress = StepProgress(self.folder, "X")
        if progress.rejection:
            self.said.append(progress.rejection)
        numbers = set[int]()
        for name in progress.list_step_times():
            number = int((progress.find_result(name, "this drive") or {})["number"])
            assert name == f"step {number % STEPS}", "a step is another"
            numbers.add(number)
        return numbers | set(range(1, max(numbers, default=STEPS) - STEPS + 1))


class Records(Plain):
    def keep(self, number: int) -> None:
        save_record(_record(number), self.folder)

    def found(self) -> set[int]:
        try:
            record = load_record(self.folder, "X")
        except StoreError as error:
            self.said.append(str(error))
            return set()
        if record is None:
            return set()
        assert record == _record(record.serial), "the record is another"
        return set(range(1, record.serial + 1))


def _record(number: int) -> CommissioningRecord:
    proofs = (1e3, None, 10.0, True, "proven", "2026-11-23T00:00:00+00:00")
    return CommissioningRecord("X", 1, 2, 3, number, "config", "mapping", {"6007": 1}, *proofs)


class Voids(Plain):
    def keep(self, number: int) -> None:
        mark_record_void(self.folder, str(number), "the drive has rebooted")

    def found(self) -> set[int]:
        numbers = {int(path.stem.partition("-")[2]) for path in self.folder.glob("commissioning-*.void")}
        return {number for number in numbers if is_record_void(self.folder, str(number))}


class Programs(Plain):
    def keep(self, number: int) -> None:
        with patch.object(program_check, "KEPT", WINDOWS_KEPT):
            program_check.store_checked(self.folder / "programs", str(number), lambda body: _checked(body, number))

    def found(self) -> set[int]:
        folder = self.folder / "programs"
        there = {}
        for number in sorted(int(file.stem) for file in folder.glob(f"*{program_check.HEADER}")):
            with patch.object(
                checked_program, "compute_code_digest", lambda: CODE
            ):  # all of the package is read for it
                found = checked_program.CheckedProgram.find_checked(folder, str(number), folder)
            if found is not None:
                there[number] = found
                assert found.read_block(0) == _rows(number), f"program {number} is another"
        gone = range(1, max(there, default=0)) if len(there) >= WINDOWS_KEPT else range(0)
        return {*there, *gone}


def _rows(number: int) -> bytes:
    return np.full((100, 2), number, "<i4").tobytes()


def _checked(body: BinaryIO, number: int) -> dict[str, Any]:
    body.write(_rows(number))
    blocks = [[100, hashlib.sha256(_rows(number)).hexdigest()]]
    errors = {"rms_um": float(number), "max_um": 1.0}
    refused: dict[str, Any] = {"schema": program_check.SCHEMA, "code": CODE, "refused": [], "files": {}}
    return refused | {
        "axes": ["X"],
        "rows": 100,
        "blocks": blocks,
        "before": errors,
        "after": errors,
        "largest_um": 1.0,
    }


class Boxes(Plain):
    def keep(self, number: int) -> None:
        result = black_box.write_black_box(self.folder, f"Tested{number}", lambda: {"can0": _log(number)})
        if result.code != "BlackBox":
            raise Refused(result.text)

    def found(self) -> set[int]:
        numbers = []
        for box in black_box.find_black_boxes(self.folder):
            lines, number = box.path.read_text("ascii"), int(box.code.removeprefix("Tested"))
            if all(map(_LINE.match, lines.splitlines())):  # else no reader takes it
                assert lines == _log(number), f"box {number} is another, of {len(lines)} bytes"
                numbers.append(number)
        gone = range(1, max(numbers)) if len(numbers) >= black_box.KEPT_FILES else range(0)
        return in_order(numbers) | set(gone)


def _log(number: int) -> str:
    return "".join(f"(0.{k:06d}) can0 {number:03d}#00\n" for k in range(2000))


KEEPERS: Mapping[str, Callable[[Path], Keeper]] = {
    "rapids": Rapids,
    "parameters": Sets,
    "notices": Notices,
    "audit": Audit,
    "lessons": LearnedOffsets,
    "commissioning steps": Steps,
    "commissioning records": Records,
    "void marks": Voids,
    "checked programs": Programs,
    "black boxes": Boxes,
}


def place_of(name: str) -> str:
    return name.replace(" ", "-")


def in_order(numbers: Iterable[int]) -> set[int]:
    listed = list(numbers)
    assert listed == sorted(listed), f"records are out of order: {listed}"
    return set(listed)
