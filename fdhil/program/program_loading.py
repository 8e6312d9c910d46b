"""Load a file that commands motion: a demand CSV by its suffix, else an NC program."""

from __future__ import annotations

import hashlib
import os
import stat
from pathlib import Path

from fdhil.config import MachineConfig
from fdhil.errors import ProgramError
from fdhil.program.budget import Budget
from fdhil.program.demand_csv import read_demand_csv, require_digest
from fdhil.program.interpreter import Interpreter
from fdhil.program.planner import plan
from fdhil.program.program_source import MAX_BYTES
from fdhil.records import Trajectory

_PIECE_BYTES = 1 << 20


def load_trajectory(path: Path, config: MachineConfig, sha256: str | None = None) -> Trajectory:
    """Return the machine's reference in a file.

    ``.csv`` is a demand CSV (RecordingError, ConfigError), anything else an NC program (ProgramError). ``sha256``: the
    required digest of the file; ProgramError if its content has another.
    """
    if is_demand(path):
        return read_demand_csv(path, config, sha256)
    return plan(open_program(path, config, sha256).run(), config)


def is_demand(path: Path) -> bool:
    """Return whether a file is a demand CSV, by its suffix."""
    return path.suffix.lower() == ".csv"


def open_program(path: Path, config: MachineConfig, sha256: str | None = None) -> Interpreter:
    """Return the interpreter of an NC program in the machine's dialect; ``sha256`` as in :func:`load_trajectory`."""
    interpreter = Interpreter(path, Budget.create_from_config(config.nc), block_delete=False)
    try:
        require_digest(path, interpreter.files[0][1], sha256)
    except ProgramError:
        interpreter.close()
        raise
    return interpreter


def compute_program_digest(path: Path) -> str:
    """Return the SHA-256 of a program's or demand's bytes, 64 hexadecimal digits.

    ProgramError if it is missing, larger than any program, or not a regular file: a pipe might never end and could not
    be read again.
    """
    digest, left = hashlib.sha256(), MAX_BYTES
    try:
        with open(path, "rb", opener=_open_nonblocking) as file:
            found = os.fstat(file.fileno())
            if not stat.S_ISREG(found.st_mode):
                raise ProgramError(0, "", f"{path} is a pipe or a device; use a regular file")
            left -= found.st_size  # a sparse file has a size without using the disk
            while left >= 0 and (piece := file.read(_PIECE_BYTES)):
                digest.update(piece)
                left = min(left, MAX_BYTES - file.tell())  # it may grow
    except OSError as error:
        raise ProgramError(0, "", f"{path} cannot be read ({error.strerror}); check the path") from None
    if left < 0:
        text = f"{path} is larger than {MAX_BYTES >> 20} MiB, so it was not read; use a program, or split it"
        raise ProgramError(0, "", text)
    return digest.hexdigest()


def _open_nonblocking(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NONBLOCK)
