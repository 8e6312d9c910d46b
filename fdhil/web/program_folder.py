"""The NC programs that may be armed from a browser: regular files of one folder, by names without a path."""

import hashlib
import os
import re
from io import BufferedReader
from pathlib import Path

from pydantic import BaseModel, Field

from fdhil.errors import StoreError
from fdhil.store import open_named
from fdhil.web.fault_responses import RequestRefused

NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
MOST = 500
LARGEST = 64 * 1024 * 1024


class Program(BaseModel):
    """A program of the folder: its name, size and modification time; its digest if it was read."""

    name: str
    size_bytes: int
    changed_wall_s: float
    sha256: str = ""
    path: str = Field("", exclude=True)


def list_programs(folder: Path) -> list[Program]:
    """Return the folder's programs, the newest first; none if the folder cannot be read."""
    found = []
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                if re.fullmatch(NAME, entry.name) and entry.is_file(follow_symlinks=False):
                    status = entry.stat(follow_symlinks=False)
                    found.append(Program(name=entry.name, size_bytes=status.st_size, changed_wall_s=status.st_mtime))
    except OSError:
        return []
    return sorted(found, key=lambda program: (-program.changed_wall_s, program.name))[:MOST]


def read_program(folder: Path | None, name: str) -> Program:
    """Return a program with its digest (blocking). Refused if the name is not a file of the folder."""
    with _open_program(folder, name, LARGEST) as file:
        status = os.fstat(file.fileno())
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    assert folder is not None
    path = str(folder.resolve() / name)
    return Program(name=name, size_bytes=status.st_size, changed_wall_s=status.st_mtime, sha256=digest, path=path)


def read_content(folder: Path | None, name: str, most: int) -> bytes:
    """Return the bytes of a program (blocking). Refused if the name is not a file of the folder, or too large."""
    with _open_program(folder, name, most) as file:
        return file.read(most)


def _open_program(folder: Path | None, name: str, most: int) -> BufferedReader:
    if folder is None:
        text = "no folder is configured whose programs may be armed from the browser"
        raise RequestRefused(409, "NoPrograms", text, "set web.programs_directory, or use fdhil arm CONFIG PROGRAM")
    if not re.fullmatch(NAME, name):
        raise RequestRefused(422, "BadName", "invalid program name", "use at most 64 letters, digits, . _ and -")
    try:
        file = open_named(folder, name)
    except StoreError as error:
        if error.code == "BadName":
            raise RequestRefused(
                422, "BadName", f"{name} cannot be armed here: it is not a program file", "use fdhil arm"
            ) from None
        raise RequestRefused(404, "NotFound", f"{name} does not exist or cannot be read", "reload the list") from None
    if os.fstat(file.fileno()).st_size > most:
        file.close()
        raise RequestRefused(422, "BadName", f"{name} is too large for the browser", "use fdhil arm")
    return file
