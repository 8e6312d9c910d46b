"""Learned offsets survive a restart; damaged files are ignored."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fdhil.correction.learned_offsets import LearnedOffset
from fdhil.errors import StoreError
from fdhil.store import lessons
from fdhil.store.lessons import MOST_PROGRAMS, lesson_path, read_lesson, write_lesson

LESSON = LearnedOffset({"X": np.linspace(-3.0, 3.0, 50), "Y": np.zeros(50)}, 1.5, 0.35, (1.5, 0.6, 0.4))


def test_a_lesson_is_read_as_it_was_written(tmp_path: Path) -> None:
    path = lesson_path(tmp_path / "lessons", "ab" * 32, "cd" * 8)
    assert read_lesson(path) is None
    write_lesson(path, LESSON)
    found = read_lesson(path)
    assert found is not None
    assert (found.without_um, found.gain, found.curve_um) == (1.5, 0.35, (1.5, 0.6, 0.4))
    assert all(np.array_equal(found.offset_um[axis], LESSON.offset_um[axis]) for axis in "XY")


@pytest.mark.parametrize("keep", [0, 10, 400])
def test_a_damaged_lesson_is_none(tmp_path: Path, keep: int) -> None:
    path = tmp_path / "a.npz"
    write_lesson(path, LESSON)
    path.write_bytes(path.read_bytes()[:keep])
    assert read_lesson(path) is None


def test_a_lesson_that_is_not_finite_is_none(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    write_lesson(path, LearnedOffset({"X": np.array([1.0, np.nan])}))
    assert read_lesson(path) is None


def test_the_oldest_lessons_go(tmp_path: Path) -> None:
    for number in range(MOST_PROGRAMS + 3):
        write_lesson(tmp_path / f"{number}.npz", LearnedOffset({"X": np.zeros(2)}))
    assert len(list(tmp_path.glob("*.npz"))) == MOST_PROGRAMS


def test_a_folder_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "lessons").write_text("no folder")
    with pytest.raises(StoreError, match="could not be written"):
        write_lesson(tmp_path / "lessons" / "a.npz", LESSON)


def test_a_lesson_that_goes_while_all_are_listed_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = [lesson_path(tmp_path, letter * 64, "d") for letter in "ab"]
    for path in paths:
        write_lesson(path, LESSON)
    read = lessons.read_lesson

    def both_go(path: Path) -> LearnedOffset | None:
        found = read(path)
        for each in paths:
            each.unlink(missing_ok=True)
        return found

    monkeypatch.setattr(lessons, "read_lesson", both_go)
    assert len(lessons.kept_lessons(tmp_path, "d")) == 1
