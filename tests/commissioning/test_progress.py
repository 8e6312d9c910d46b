"""Completed steps are reused only for the same drive and configuration, and only from an unmodified file."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from fdhil.commissioning.commissioning_record import KEY_NAME
from fdhil.commissioning.step_progress import CompletedStep, StepProgress, build_steps_path
from fdhil.errors import StoreError

FOUND = {"moved_um": 10.07, "jog": "5 mm"}


def write_progress(folder: Path) -> StepProgress:
    progress = StepProgress(folder, "X")
    progress.save_step("sign test", "this drive", FOUND)
    return progress


def test_step_is_reused_for_same_drive_only(tmp_path: Path) -> None:
    write_progress(tmp_path)
    reported: list[tuple[str, CompletedStep]] = []
    again = StepProgress(tmp_path, "X")
    again.on_reused = lambda name, step: reported.append((name, step))
    assert again.reuse_step("sign test", "another drive") is None
    assert again.reuse_step("watchdog test", "this drive") is None
    assert reported == []
    assert again.reuse_step("sign test", "this drive") == FOUND
    assert [name for name, _ in reported] == ["sign test"]
    assert again.list_step_times().keys() == {"sign test"}
    assert StepProgress(tmp_path, "Y").list_step_times() == {}


def test_undetermined_step_is_repeated(tmp_path: Path) -> None:
    progress = write_progress(tmp_path)
    progress.save_step("feed-forward test", "this drive", {"in_feedforward": None})
    assert progress.list_step_times().keys() == {"sign test"}


def test_forget_deletes_all_steps(tmp_path: Path) -> None:
    write_progress(tmp_path).forget_steps()
    assert not build_steps_path(tmp_path, "X").exists()
    assert StepProgress(tmp_path, "X").list_step_times() == {}


def change_content(path: Path) -> None:
    path.write_text(path.read_text().replace("10.07", "10.08"))


def use_file_of_another_axis(path: Path) -> None:
    path.write_text(path.read_text().replace('"axis": "X"', '"axis": "Y"'))


def truncate_file(path: Path) -> None:
    path.write_text(path.read_text()[:40])


def write_list(path: Path) -> None:
    path.write_text("[1, 2]")


def write_other_fields(path: Path) -> None:
    document = json.loads(path.read_text())
    document["steps"]["sign test"]["more"] = 1
    path.write_text(json.dumps(document))


def write_binary(path: Path) -> None:
    path.write_bytes(b"\xff\xfe\x00" * 9)


def remove_key(path: Path) -> None:
    path.with_name(KEY_NAME).unlink()


@pytest.mark.parametrize(
    "spoil",
    [change_content, use_file_of_another_axis, truncate_file, write_list, write_other_fields, write_binary, remove_key],
)
def test_foreign_or_damaged_file_is_rejected(spoil: Callable[[Path], None], tmp_path: Path) -> None:
    write_progress(tmp_path)
    spoil(build_steps_path(tmp_path, "X"))
    progress = StepProgress(tmp_path, "X")
    assert progress.list_step_times() == {}
    assert progress.rejection.startswith("commissioning-X.steps.json was rejected (")
    assert progress.rejection.endswith("every step is repeated")
    progress.save_step("sign test", "this drive", FOUND)
    assert StepProgress(tmp_path, "X").reuse_step("sign test", "this drive") == FOUND


def test_unwritable_store_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    progress = StepProgress(tmp_path / "file" / "store", "X")
    with pytest.raises(StoreError, match=r"cannot be written .* check the rights"):
        progress.save_step("sign test", "this drive", FOUND)


def test_step_beyond_size_limit_is_refused_and_previous_ones_stay(tmp_path: Path) -> None:
    progress, room = StepProgress(tmp_path, "X"), {"told": "x" * 21_000}
    for number in range(12):
        progress.save_step(f"step {number}", "this drive", room)
    with pytest.raises(StoreError, match="no room for another step"):
        progress.save_step("one too many", "this drive", room)
    again = StepProgress(tmp_path, "X")
    assert (again.rejection, len(again.list_step_times()), len(progress.list_step_times())) == ("", 12, 12)
