"""The audit log: lines are chained, and every change of the file is detected."""

from __future__ import annotations

import errno
import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fdhil.errors import StoreError
from fdhil.store import audit_file

ENTRIES = [{"asked": "arm", "program": f"part{number}.ngc"} for number in range(4)]


@pytest.fixture
def audit_folder(tmp_path: Path) -> Path:
    for entry in ENTRIES:
        audit_file.append_entry(tmp_path, entry)
    return tmp_path


def count_broken_entries(folder: Path) -> list[int]:
    return [number for number, (_, fault) in enumerate(audit_file.read_entries(folder)) if fault]


def test_entries_are_read_back_and_file_is_private(audit_folder: Path) -> None:
    read = list(audit_file.read_entries(audit_folder))
    assert [entry["program"] for entry, fault in read if fault is None] == [entry["program"] for entry in ENTRIES]
    assert (audit_folder / audit_file.AUDIT_FILE_NAME).stat().st_mode & 0o007 == 0


def test_folder_without_audit_has_no_entries(tmp_path: Path) -> None:
    assert list(audit_file.read_entries(tmp_path)) == []


def _change_file(lines: list[bytes]) -> list[bytes]:
    return [lines[0], lines[1].replace(b"part1", b"part9"), *lines[2:]]


CHANGES = {
    "a line changed": (_change_file, [1]),
    "a line left out": (lambda lines: [lines[0], *lines[2:]], [1]),
    "two lines exchanged": (lambda lines: [lines[0], lines[2], lines[1], lines[3]], [1, 2, 3]),
    "the first left out": (lambda lines: lines[1:], [0]),
    "a line twice": (lambda lines: [*lines[:2], lines[1], *lines[2:]], [2]),
    "nonsense between": (lambda lines: [*lines[:2], b"\xff{[", *lines[2:]], [2, 3]),
}


@pytest.mark.parametrize("name", list(CHANGES))
def test_every_change_of_the_file_is_detected(name: str, audit_folder: Path) -> None:
    change, expected = CHANGES[name]
    path = audit_folder / audit_file.AUDIT_FILE_NAME
    path.write_bytes(b"\n".join(change(path.read_bytes().splitlines())) + b"\n")
    assert count_broken_entries(audit_folder) == expected


@pytest.mark.fault("F1")
def test_truncated_line_is_reported_and_next_one_is_intact(audit_folder: Path) -> None:
    path = audit_folder / audit_file.AUDIT_FILE_NAME
    whole = path.read_bytes()
    begin = len(whole.rstrip(b"\n").rpartition(b"\n")[0]) + 1
    for size in range(begin + 1, len(whole) - 1):
        path.write_bytes(whole[:size])
        audit_file.append_entry(audit_folder, {"asked": "disarm"})
        assert count_broken_entries(audit_folder) == [3], size
        assert list(audit_file.read_entries(audit_folder))[4] == (
            {**list(audit_file.read_entries(audit_folder))[4][0], "asked": "disarm"},
            None,
        )


@pytest.mark.usefixtures("processes")
def test_two_writing_processes_make_one_chain(tmp_path: Path) -> None:
    code = "import sys; from pathlib import Path; from fdhil.store import audit_file\n"
    code += "audit_file.LOCKED_S = 300.0\n"  # the other may have all its turns first, on a slow disk
    code += "for k in range(50): audit_file.append_entry(Path(sys.argv[1]), {'asked': 'arm', 'number': k})"
    writers = [subprocess.Popen([sys.executable, "-c", code, str(tmp_path)]) for _ in range(2)]
    assert [writer.wait(300) for writer in writers] == [0, 0]
    assert len(list(audit_file.read_entries(tmp_path))) == 100
    assert count_broken_entries(tmp_path) == []


@pytest.mark.fault("F3", "F4")
@pytest.mark.parametrize(
    ("call", "number", "code"), [("write", errno.ENOSPC, "DiskFull"), ("fsync", errno.EIO, "StoreFault")]
)
def test_write_error_is_reported(
    call: str, number: int, code: str, audit_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuses(*_: object) -> int:
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patched:
        patched.setattr(os, call, refuses)
        with pytest.raises(StoreError) as refused:
            audit_file.append_entry(audit_folder, {"asked": "arm"})
    assert refused.value.code == code
    audit_file.append_entry(audit_folder, {"asked": "arm"})
    assert count_broken_entries(audit_folder) == []


def test_symbolic_link_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / audit_file.AUDIT_FILE_NAME).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(StoreError):
        audit_file.append_entry(tmp_path, {"asked": "arm"})
    assert not (tmp_path / "elsewhere").exists()


def test_entry_after_a_long_line_is_read(tmp_path: Path) -> None:
    for length in (10, 100_000, 20_000):
        audit_file.append_entry(tmp_path, {"asked": "x" * length})
        audit_file.append_entry(tmp_path, {"asked": "arm"})
    assert count_broken_entries(tmp_path) == []


def test_locked_audit_is_awaited_and_then_reported(audit_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(audit_file, "LOCKED_S", 0.05)
    with (audit_folder / audit_file.AUDIT_FILE_NAME).open() as reader:  # anyone who may read it may lock it, too
        fcntl.flock(reader, fcntl.LOCK_EX)
        with pytest.raises(StoreError, match="another process holds its lock"):
            audit_file.append_entry(audit_folder, {"asked": "arm"})
    audit_file.append_entry(audit_folder, {"asked": "arm"})
    assert len(list(audit_file.read_entries(audit_folder))) == len(ENTRIES) + 1
