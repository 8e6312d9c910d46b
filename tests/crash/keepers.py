"""What the product keeps on disk, kind by kind: keep the record of a number, and say which numbers are there, whole.

The content of each record follows from its number alone, so a record that is there and is another one is seen.
``keep`` returns when the record is acknowledged; it raises FdhilError when the product refused it.
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
from fdhil.arming.code_digest import code_digest
from fdhil.commissioning.progress import Progress
from fdhil.commissioning.record import CommissioningRecord, load_record, save_record
from fdhil.commissioning.void import is_void, void_record
from fdhil.config import MachineConfig
from fdhil.correction.learning import Lesson
from fdhil.daemon import blackbox
from fdhil.daemon.outcome_store import WINDOWS_FOLDER, OutcomeStore
from fdhil.errors import FdhilError, RecordingError, StoreError
from fdhil.records import Notice, Outcome, Window
from fdhil.store import audit, lessons
from fdhil.store.history import History
from fdhil.store.windows import list_windows, read_window
from tests.daemon.machine import config_of
from tests.store.made import outcome, published, same, window

SAMPLES = 150
WINDOWS_KEPT = 2
STEPS = 40
FIRST_TICK = 1000
MUCH_LATER = 10**6  # a number that comes after any other
CODE = code_digest()
_LINE = re.compile(r"\(\d+\.\d{6}\) can0 \d+#\w*$")


class Keeper(Protocol):
    """One kind of record, in the store directory ``folder`` that it was made with."""

    said: list[str]

    def keep(self, number: int) -> None:
        """Keep a record; FdhilError where it was refused."""

    def found(self) -> set[int]:
        """Return the records that are believed; AssertionError where one of them is not what was kept."""

    def close(self) -> None:
        """Let go what is open."""


class Refused(FdhilError):
    """The daemon's store said that it could not keep something."""


def configured(folder: Path) -> MachineConfig:
    """Return the bench's configuration with its store in ``folder``."""
    return config_of(folder, store={"directory": str(folder), "keep_windows": WINDOWS_KEPT})


def believed(file: Path) -> Window | None:
    """Return what a window's file has; None where the product says itself that it is damaged: then it is not there."""
    try:
        return read_window(file)
    except RecordingError as error:
        if "; " not in str(error):
            raise  # it says no more than that
        return None


class OfTheDaemon:
    """Outcomes, as the daemon's store keeps them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.store = OutcomeStore(configured(folder))
        opened = self.store.open()  # a window that was half written when it all ended is told, and is no loss
        self.said = [f"{notice.code}: {notice.text}" for notice in opened if notice.code != "StrayFiles"]

    def outcomes(self, number: int) -> list[Outcome]:
        """Return what is kept under a number."""
        raise NotImplementedError

    def keep(self, number: int) -> None:
        """Keep it, as the daemon would."""
        refused = [notice for notice in self.store.keep(self.outcomes(number)) if notice.severity == "MAJOR"]
        if refused or self.store.fault:
            raise Refused(refused[0].text if refused else f"{self.store.fault}; told before")

    def close(self) -> None:
        """Close the history."""
        self.store.close()


class Rapids(OfTheDaemon):
    """Rapids: a file each, and a row of the history."""

    def outcomes(self, number: int) -> list[Outcome]:
        """Return a rapid of that number."""
        return [outcome(of=window(SAMPLES, seed=number, start_tick=FIRST_TICK + number))]

    def found(self) -> set[int]:
        """Return the rapids with a row, each whole; a file is missing only where newer ones took its place."""
        with History.read(self.folder) as history:
            rows = history.windows("X")
        files = list_windows(self.folder / WINDOWS_FOLDER).windows
        names, refused = {file.path.name for file in files}, set[int]()
        for row in rows:
            number = row.start_tick - FIRST_TICK
            if row.file in names:
                kept = window(SAMPLES, seed=number, start_tick=row.start_tick)
                found = believed(self.folder / WINDOWS_FOLDER / row.file)
                assert found is None or same(found, kept), f"rapid {number} is another"
                if found is None:
                    refused.add(number)
            else:
                newer = [file for file in files if file.path.name > row.file]
                assert len(newer) >= WINDOWS_KEPT, f"rapid {number} has no file, and {len(newer)} are newer"
        return in_order(row.start_tick - FIRST_TICK for row in rows) - refused


class Sets(OfTheDaemon):
    """Published parameters."""

    def outcomes(self, number: int) -> list[Outcome]:
        """Return the set of a revision."""
        return [published(number)]

    def keep(self, number: int) -> None:
        """Keep it; a fault that an earlier set met is over when this one is kept."""
        self.store.fault = None
        super().keep(number)

    def found(self) -> set[int]:
        """Return the revisions."""
        with History.read(self.folder) as history:
            sets = [row.set for row in history.revisions("X")]
        for told in sets:
            kept = published(told.revision)
            equal = told.parameters == kept.parameters and told.covariance.tobytes() == kept.covariance.tobytes()
            assert equal, f"revision {told.revision} is another"
        return in_order(told.revision for told in sets)


class Notices(OfTheDaemon):
    """Notices, each acknowledged by a person as soon as it is kept."""

    def outcomes(self, number: int) -> list[Outcome]:
        """Return a notice that a person must see."""
        return [Notice("Tested", "MAJOR", f"notice {number}", "X", number)]

    def keep(self, number: int) -> None:
        """Keep it and acknowledge it."""
        self.store.fault = None
        super().keep(number)
        waits = self.store.notices.status()["newest"]
        self.store.acknowledge({"by": f"person {number}", "notices": [waits[-1]["number"]]})

    def found(self) -> set[int]:
        """Return the notices that somebody has acknowledged."""
        with History.read(self.folder) as history:
            rows = [row for row in history.notices() if row.notice.code == "Tested" and row.acknowledged]
        for row in rows:
            assert row.notice.text == f"notice {row.notice.tick}", f"notice {row.notice.tick} is another"
        return in_order(row.notice.tick for row in rows)


class Plain:
    """A kind that has nothing open between two records."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.said: list[str] = []

    def close(self) -> None:
        """Nothing is open."""


class Audit(Plain):
    """Lines of the audit."""

    def keep(self, number: int) -> None:
        """Write a line."""
        self.folder.mkdir(exist_ok=True)
        audit.append(self.folder, {"asked": "arm", "number": number})

    def found(self) -> set[int]:
        """Return the lines that are as they were written; others are told by their place."""
        good = [entry for entry, wrong in audit.entries(self.folder) if wrong is None]
        return in_order(entry["number"] for entry in good)


class Lessons(Plain):
    """What a program has taught; the lessons of two programs are kept."""

    def keep(self, number: int) -> None:
        """Write the lesson of a program."""
        lesson = Lesson({"X": np.full(50, float(number))}, float(number), 1.0, (float(number),))
        with patch.object(lessons, "MOST_PROGRAMS", WINDOWS_KEPT):
            lessons.write_lesson(lessons.lesson_path(self.folder / "lessons", f"{number:032d}", "made"), lesson)

    def found(self) -> set[int]:
        """Return the programs with a lesson, and those whose place newer ones took."""
        there = {int(program): lesson for _, program, lesson in lessons.kept_lessons(self.folder / "lessons", "made")}
        for number, lesson in there.items():
            whole = np.array_equal(lesson.offset_um["X"], np.full(50, number)) and lesson.curve_um == (float(number),)
            assert whole, f"lesson {number} is another"
        gone = range(1, max(there, default=0)) if len(there) >= WINDOWS_KEPT else range(0)
        return {*there, *gone}


class Steps(Plain):
    """The steps of a commissioning, all in one file, sealed with a key that the first one makes.

    A commissioning has some dozen: a later one takes the place of the one that is ``STEPS`` older.
    """

    def keep(self, number: int) -> None:
        """Keep a step beside those that were done."""
        Progress(self.folder, "X").keep(f"step {number % STEPS}", "this drive", {"number": number})

    def found(self) -> set[int]:
        """Return the steps that need not be done again, and those whose place they took."""
        progress = Progress(self.folder, "X")
        if progress.doubt:
            self.said.append(progress.doubt)
        numbers = set[int]()
        for name in progress.done():
            number = int((progress.found(name, "this drive") or {})["number"])
            assert name == f"step {number % STEPS}", "a step is another"
            numbers.add(number)
        return numbers | set(range(1, max(numbers, default=STEPS) - STEPS + 1))


class Records(Plain):
    """The commissioning record of a drive, made anew again and again."""

    def keep(self, number: int) -> None:
        """Sign off a drive with this serial number."""
        save_record(_record(number), self.folder)

    def found(self) -> set[int]:
        """Return the record that is in force and all before it."""
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
    """Marks that a commissioning record is void: here one for each of several axes."""

    def keep(self, number: int) -> None:
        """Mark an axis' record."""
        void_record(self.folder, str(number), "the drive has rebooted")

    def found(self) -> set[int]:
        """Return the axes whose record is void."""
        numbers = {int(path.stem.partition("-")[2]) for path in self.folder.glob("commissioning-*.void")}
        return {number for number in numbers if is_void(self.folder, str(number))}


class Programs(Plain):
    """Programs that have passed the check; the rows of the newest are kept."""

    def keep(self, number: int) -> None:
        """Keep the rows of a program that has passed."""
        with patch.object(program_check, "KEPT", WINDOWS_KEPT):
            program_check.keep(self.folder / "programs", str(number), lambda body: _checked(body, number))

    def found(self) -> set[int]:
        """Return the programs that need no check, and those whose place newer ones took."""
        folder = self.folder / "programs"
        there = {}
        for number in sorted(int(file.stem) for file in folder.glob(f"*{program_check.HEADER}")):
            with patch.object(checked_program, "code_digest", lambda: CODE):  # all of the package is read for it
                found = checked_program.CheckedProgram.find(folder, str(number), folder)
            if found is not None:
                there[number] = found
                assert found.content(0) == _rows(number), f"program {number} is another"
        gone = range(1, max(there, default=0)) if len(there) >= WINDOWS_KEPT else range(0)
        return {*there, *gone}


def _rows(number: int) -> bytes:
    return np.full((100, 2), number, "<i4").tobytes()


def _checked(body: BinaryIO, number: int) -> dict[str, Any]:
    """Write the rows of a program and return the header that a check would."""
    body.write(_rows(number))
    blocks = [[100, hashlib.sha256(_rows(number)).hexdigest()]]
    errors = {"rms_um": float(number), "max_um": 1.0}
    told: dict[str, Any] = {"schema": program_check.SCHEMA, "code": CODE, "refused": [], "files": {}}
    return told | {"axes": ["X"], "rows": 100, "blocks": blocks, "before": errors, "after": errors, "largest_um": 1.0}


class Boxes(Plain):
    """The frames that were on the buses when the guard stopped a correction; eight files are kept."""

    def keep(self, number: int) -> None:
        """Write the frames of a trip."""
        told = blackbox.dump(self.folder, f"Tested{number}", lambda: {"can0": _log(number)})
        if told.code != "BlackBox":
            raise Refused(told.text)

    def found(self) -> set[int]:
        """Return the trips whose frames are there, and those whose place newer ones took."""
        numbers = []
        for box in blackbox.kept(self.folder):
            lines, number = box.path.read_text("ascii"), int(box.code.removeprefix("Tested"))
            if all(map(_LINE.match, lines.splitlines())):  # else no reader takes it
                assert lines == _log(number), f"box {number} is another, of {len(lines)} bytes"
                numbers.append(number)
        gone = range(1, max(numbers)) if len(numbers) >= blackbox.KEPT_FILES else range(0)
        return in_order(numbers) | set(gone)


def _log(number: int) -> str:
    return "".join(f"(0.{k:06d}) can0 {number:03d}#00\n" for k in range(2000))


KEEPERS: Mapping[str, Callable[[Path], Keeper]] = {
    "rapids": Rapids,
    "parameters": Sets,
    "notices": Notices,
    "audit": Audit,
    "lessons": Lessons,
    "commissioning steps": Steps,
    "commissioning records": Records,
    "void marks": Voids,
    "checked programs": Programs,
    "black boxes": Boxes,
}


def place_of(name: str) -> str:
    """Return the folder of a kind of record where all kinds are kept side by side."""
    return name.replace(" ", "-")


def in_order(numbers: Iterable[int]) -> set[int]:
    """Return the numbers as a set; AssertionError where they are not in the order in which they were kept."""
    listed = list(numbers)
    assert listed == sorted(listed), f"records are out of order: {listed}"
    return set(listed)
