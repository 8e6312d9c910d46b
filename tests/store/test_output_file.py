"""Output files are written completely or not at all."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fdhil.errors import OutputError
from fdhil.store.output_file import check_output, open_output


def write_output(path: Path, content: bytes) -> None:
    with open_output(path) as file:
        file.write(content)


def test_file_is_replaced_through_link_with_same_permissions(tmp_path: Path) -> None:
    old, link = tmp_path / "old.csv", tmp_path / "link.csv"
    old.write_bytes(b"old")
    old.chmod(0o640)
    link.symlink_to(old)
    write_output(link, b"new")
    assert link.is_symlink()
    assert old.read_bytes() == b"new"
    assert old.stat().st_mode & 0o777 == 0o640
    assert {path.name for path in tmp_path.iterdir()} == {"old.csv", "link.csv"}


def write_partially(path: Path) -> None:
    with open_output(path) as file:
        file.write(b"half")
        assert path.read_bytes() == b"old"
        raise OSError(28, "No space left on device")


def test_old_file_is_kept_when_writing_fails(tmp_path: Path) -> None:
    old = tmp_path / "old.csv"
    old.write_bytes(b"old")
    with pytest.raises(OutputError, match=r"No space left.*unchanged"):
        write_partially(old)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"old"]


@pytest.mark.parametrize("kind", ["folder", "pipe", "socket", "device", "protected"])
def test_special_file_is_never_replaced(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "it"
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        import socket

        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind(str(path))
    elif kind == "device":
        path = Path("/dev/zero")
    else:
        path.touch()
        monkeypatch.setattr(os, "access", lambda *_: False)  # root may write everywhere
    before = path.lstat()
    with pytest.raises(OutputError, match=str(path)):
        write_output(path, b"new")
    assert os.path.samestat(path.lstat(), before)


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("name", ["/dev/stdout", "answer.txt", "/dev/null"])
def test_standard_output_is_appended_to(name: str, tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from fdhil.store.output_file import open_output\n"
        "print('before')\nwith open_output(Path(sys.argv[1])) as file:\n    file.write(b'written\\n')\nprint('after')"
    )
    with (tmp_path / "answer.txt").open("w") as answer:
        subprocess.run([sys.executable, "-c", code, name], stdout=answer, cwd=tmp_path, check=True)
    reported = (tmp_path / "answer.txt").read_text().split()
    assert reported == ["before", "written", "after"] if name != "/dev/null" else ["before", "after"]
    assert [path.name for path in tmp_path.iterdir()] == ["answer.txt"]


def test_missing_folder_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for path in (tmp_path / "file" / "out.csv", tmp_path / "absent" / "out.csv", tmp_path / ("x" * 300)):
        with pytest.raises(OutputError, match="cannot be written"):
            check_output(path)
