"""Acknowledged records are there after any failing or final call, and on full and read-only disks."""

from __future__ import annotations

import errno
import os
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from fdhil.commissioning.step_progress import StepProgress
from fdhil.daemon import black_box
from fdhil.errors import StoreError
from fdhil.store import atomic_file
from fdhil.system_clock import Clock
from tests.crash import call_faults, clocks, disks
from tests.crash.loops import KINDS, Kind, tried
from tests.crash.stored_records import KEEPERS, Plain

OF_EACH = 8  # faults, of the hundreds that the study tries


@pytest.mark.debian
@pytest.mark.parametrize("name", KINDS)
@pytest.mark.fault("F1", "F3", "F4", "F6")
def test_acknowledged_records_survive_any_failing_or_final_system_call(name: str, tmp_path: Path) -> None:
    found = tried(name, tmp_path, OF_EACH)
    assert found.wrong == []
    assert found.acknowledged > 0
    assert sum(found.runs.values()) > 0


class Careless(Plain):
    def keep(self, number: int) -> None:
        numbers = {*self.found(), number}
        (self.folder / "numbers").write_text(" ".join(map(str, sorted(numbers))))

    def found(self) -> set[int]:
        file = self.folder / "numbers"
        return set(map(int, file.read_text().split())) if file.exists() else set()


@pytest.mark.debian
def test_store_that_truncates_before_writing_is_detected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keep = partial(call_faults.keep_some, Careless)
    monkeypatch.setitem(KINDS, "careless", Kind(Careless, keep))
    found = tried("careless", tmp_path)
    assert found.lost > 0
    assert any(text.startswith("write 2 killed: [1] lost") for text in found.wrong)


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("name", KEEPERS)
@pytest.mark.fault("F3")
def test_full_disk_loses_no_acknowledged_record(name: str, tmp_path: Path) -> None:
    make = KEEPERS[name]
    result = disks.filled(make, tmp_path, free_bytes=0)
    assert (result.wrong, result.ended) == ([], True)
    assert set(result.kept) - {9} <= set(result.found)
    assert 1 in result.found
    assert all(
        "the disk is full" in text or "No space left" in text or "told before" in text for text in result.refused
    )
    assert result.refused or name == "audit"  # a line may still fit into the page that the file has


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("name", KEEPERS)
@pytest.mark.fault("F5")
def test_read_only_disk_refuses_and_loses_nothing(name: str, tmp_path: Path) -> None:
    result = disks.read_only(KEEPERS[name], tmp_path)
    assert (result.wrong, result.ended) == ([], True)
    assert (result.kept, {1, 2} <= set(result.found)) == ([1, 2, 9], True)
    (text,) = result.refused
    assert any(words in text for words in ("it is read-only", "Read-only file system", "told before"))


def test_unreadable_steps_are_not_overwritten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    StepProgress(tmp_path, "X").save_step("sign test", "this drive", {"um": 10.0})

    def refuses(*_: Any, **__: Any) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with monkeypatch.context() as patched:
        patched.setattr(Path, "open", refuses)
        with pytest.raises(StoreError, match=r"cannot be read .* check the disk, or move it away"):
            StepProgress(tmp_path, "X")
    assert StepProgress(tmp_path, "X").list_step_times().keys() == {"sign test"}


@pytest.mark.fault("F9")
def test_newest_black_box_is_kept_with_any_clock(tmp_path: Path) -> None:
    class BackwardClock(Clock):
        shown_s = datetime(2026, 11, 23, tzinfo=UTC).timestamp()

        def wall_s(self) -> float:
            self.shown_s -= timedelta(days=1).total_seconds()
            return self.shown_s

    clock = BackwardClock()
    (tmp_path / black_box.BLACK_BOX_FOLDER).mkdir()
    (tmp_path / black_box.BLACK_BOX_FOLDER / "20261120T010203.000004Z-Old.log").write_text(
        "of before there were numbers"
    )
    for number in range(12):
        assert black_box.write_black_box(tmp_path, f"Made{number}", dict, clock).code == "BlackBox"
    assert [box.code for box in black_box.find_black_boxes(tmp_path)] == [f"Made{number}" for number in range(4, 12)]


@pytest.mark.fault("F9")
def test_newest_file_is_kept_with_any_clock(tmp_path: Path) -> None:
    for number in range(6):
        file = tmp_path / str(number)
        others = list(tmp_path.iterdir())
        file.touch()
        os.utime(file, (1000.0 - number, 1000.0 - number))
        atomic_file.keep_newest(file, others, most=3)
    assert {file.name for file in tmp_path.iterdir()} == {"3", "4", "5"}


@pytest.mark.debian
@pytest.mark.parametrize("name", ["set on an hour", "set back to 1970"])
@pytest.mark.fault("A28", "F9")
def test_ramp_frames_do_not_depend_on_the_wall_clock(name: str, tmp_path: Path) -> None:
    usual = clocks.ramp(tmp_path / "usual", clocks.NEVER_SET)
    assert len(usual) > clocks.FAULT_ROW - clocks.FIRST_ROW
    assert clocks.ramp(tmp_path / "set", clocks.CLOCKS[name]) == usual
