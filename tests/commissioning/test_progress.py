"""Completed steps are reused only for the same drive and configuration, and only from an unmodified file."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from fdhil.commissioning.progress import Progress, Step, steps_path
from fdhil.commissioning.record import KEY_NAME
from fdhil.errors import StoreError

FOUND = {"moved_um": 10.07, "jog": "5 mm"}


def begun(folder: Path) -> Progress:
    progress = Progress(folder, "X")
    progress.keep("sign test", "this drive", FOUND)
    return progress


def test_a_step_is_kept_for_the_same_drive_alone(tmp_path: Path) -> None:
    begun(tmp_path)
    told: list[tuple[str, Step]] = []
    again = Progress(tmp_path, "X")
    again.on_kept = lambda name, step: told.append((name, step))
    assert again.kept("sign test", "another drive") is None
    assert again.kept("watchdog test", "this drive") is None
    assert told == []
    assert again.kept("sign test", "this drive") == FOUND
    assert [name for name, _ in told] == ["sign test"]
    assert again.done().keys() == {"sign test"}
    assert Progress(tmp_path, "Y").done() == {}


def test_what_could_not_be_told_is_asked_again(tmp_path: Path) -> None:
    progress = begun(tmp_path)
    progress.keep("feed-forward test", "this drive", {"in_feedforward": None})
    assert progress.done().keys() == {"sign test"}


def test_all_is_forgotten_on_demand(tmp_path: Path) -> None:
    begun(tmp_path).forget()
    assert not steps_path(tmp_path, "X").exists()
    assert Progress(tmp_path, "X").done() == {}


def changed(path: Path) -> None:
    path.write_text(path.read_text().replace("10.07", "10.08"))


def of_another_axis(path: Path) -> None:
    path.write_text(path.read_text().replace('"axis": "X"', '"axis": "Y"'))


def half(path: Path) -> None:
    path.write_text(path.read_text()[:40])


def a_list(path: Path) -> None:
    path.write_text("[1, 2]")


def other_fields(path: Path) -> None:
    document = json.loads(path.read_text())
    document["steps"]["sign test"]["more"] = 1
    path.write_text(json.dumps(document))


def not_text(path: Path) -> None:
    path.write_bytes(b"\xff\xfe\x00" * 9)


def without_a_key(path: Path) -> None:
    path.with_name(KEY_NAME).unlink()


@pytest.mark.parametrize("spoil", [changed, of_another_axis, half, a_list, other_fields, not_text, without_a_key])
def test_a_file_that_is_not_ours_is_not_believed(spoil: Callable[[Path], None], tmp_path: Path) -> None:
    begun(tmp_path)
    spoil(steps_path(tmp_path, "X"))
    progress = Progress(tmp_path, "X")
    assert progress.done() == {}
    assert progress.doubt.startswith("commissioning-X.steps.json was rejected (")
    assert progress.doubt.endswith("every step is repeated")
    progress.keep("sign test", "this drive", FOUND)
    assert Progress(tmp_path, "X").kept("sign test", "this drive") == FOUND


def test_a_store_that_takes_nothing_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    progress = Progress(tmp_path / "file" / "store", "X")
    with pytest.raises(StoreError, match=r"cannot be written .* check the rights"):
        progress.keep("sign test", "this drive", FOUND)


def test_a_step_for_which_there_is_no_room_is_refused_and_those_before_it_stay(tmp_path: Path) -> None:
    progress, room = Progress(tmp_path, "X"), {"told": "x" * 21_000}
    for number in range(12):
        progress.keep(f"step {number}", "this drive", room)
    with pytest.raises(StoreError, match="no room for another step"):
        progress.keep("one too many", "this drive", room)
    again = Progress(tmp_path, "X")
    assert (again.doubt, len(again.done()), len(progress.done())) == ("", 12, 12)
