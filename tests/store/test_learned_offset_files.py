"""Learned offsets survive a restart; damaged files are ignored."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fdhil.correction.learned_offsets import LearnedOffset
from fdhil.errors import StoreError
from fdhil.store import learned_offset_files
from fdhil.store.learned_offset_files import MOST_PROGRAMS, make_learned_path, read_learned, write_learned

LESSON = LearnedOffset({"X": np.linspace(-3.0, 3.0, 50), "Y": np.zeros(50)}, 1.5, 0.35, (1.5, 0.6, 0.4))


def test_learned_offsets_are_read_back(tmp_path: Path) -> None:
    path = make_learned_path(tmp_path / "lessons", "ab" * 32, "cd" * 8)
    assert read_learned(path) is None
    write_learned(path, LESSON)
    found = read_learned(path)
    assert found is not None
    assert (found.without_um, found.gain, found.curve_um) == (1.5, 0.35, (1.5, 0.6, 0.4))
    assert all(np.array_equal(found.offset_um[axis], LESSON.offset_um[axis]) for axis in "XY")


@pytest.mark.parametrize("keep", [0, 10, 400])
def test_damaged_file_yields_no_learned_offsets(tmp_path: Path, keep: int) -> None:
    path = tmp_path / "a.npz"
    write_learned(path, LESSON)
    path.write_bytes(path.read_bytes()[:keep])
    assert read_learned(path) is None


def test_non_finite_offsets_are_rejected(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    write_learned(path, LearnedOffset({"X": np.array([1.0, np.nan])}))
    assert read_learned(path) is None


def test_oldest_learned_offsets_are_removed(tmp_path: Path) -> None:
    for number in range(MOST_PROGRAMS + 3):
        write_learned(tmp_path / f"{number}.npz", LearnedOffset({"X": np.zeros(2)}))
    assert len(list(tmp_path.glob("*.npz"))) == MOST_PROGRAMS


def test_unwritable_folder_is_reported(tmp_path: Path) -> None:
    (tmp_path / "lessons").write_text("no folder")
    with pytest.raises(StoreError, match="could not be written"):
        write_learned(tmp_path / "lessons" / "a.npz", LESSON)


def test_file_removed_while_listing_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = [make_learned_path(tmp_path, letter * 64, "d") for letter in "ab"]
    for path in paths:
        write_learned(path, LESSON)
    read = learned_offset_files.read_learned

    def both_go(path: Path) -> LearnedOffset | None:
        found = read(path)
        for each in paths:
            each.unlink(missing_ok=True)
        return found

    monkeypatch.setattr(learned_offset_files, "read_learned", both_go)
    assert len(learned_offset_files.list_learned(tmp_path, "d")) == 1
