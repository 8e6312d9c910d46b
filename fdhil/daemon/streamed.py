"""A program longer than the guard's ring: armed with its first seconds, the rest is handed on as it runs.

All of it was checked before; what is handed on are the very rows of the check, so nothing is computed while it runs.
When the daemon falls behind all the same, the guard ramps to zero by itself (``TableStarved``), with a second of
reserve left.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdhil.config import MachineConfig
from fdhil.daemon.program_check import HEADER, ROWS, SCHEMA, reference_blocks
from fdhil.errors import ProgramError, StoreError
from fdhil.program import program_digest

RING_S = 10.0  # of rows that the guard is given ahead of where the machine is; it ramps down below 1 s
FIRST_S = 10.0
NEXT_S = 2.0

Rows = dict[str, list[int]]


class Piece(NamedTuple):
    """Rows from ``first`` on: demand and offset per axis, in increments; ``final``: no more follow."""

    first: int
    demand: Rows
    offset: Rows
    final: bool


@dataclass(frozen=True, slots=True)
class Checked:
    """A program that passed the gate as a whole: where its rows are, and what the check found."""

    rows_file: Path
    header: Mapping[str, Any]

    @staticmethod
    def find(folder: Path, key: str, beside: Path) -> Checked | None:
        """Return what was checked under ``key``; None when nothing was, or its rows are not those of the check.

        ``beside`` is the program's folder: the subroutines there must be those of the check.
        """
        rows_file = folder / (key + ROWS)
        try:
            header = json.loads((folder / (key + HEADER)).read_bytes())
            with rows_file.open("rb") as body:
                digest = hashlib.file_digest(body, "sha256").hexdigest()
            whole = header["schema"] == SCHEMA and header["sha256"] == digest
            whole = whole and all(program_digest(beside / name) == sha for name, sha in header["files"].items())
            os.utime(folder / (key + HEADER))  # what is used is not the oldest
        except (OSError, ValueError, KeyError, TypeError, AttributeError, ProgramError):
            return None
        return Checked(rows_file, header) if whole and not header.get("refused") else None

    @property
    def gain_um(self) -> float:
        """By how much the contour error's RMS is predicted to shrink."""
        return float(self.header["before"]["rms_um"] - self.header["after"]["rms_um"])


class Stream:
    """The rows of one checked program in the guard's increments; ``end`` is one past the last row handed out."""

    def __init__(self, checked: Checked, program_digest: str, sync_period_s: float) -> None:
        """Begin at the first row; nothing is read yet."""
        self.checked, self.program_digest = checked, program_digest
        self.axes: tuple[str, ...] = tuple(checked.header["axes"])
        self.rows = int(checked.header["rows"])
        self.end = 0
        self._period_s = sync_period_s

    def take(self, seconds: float = NEXT_S) -> Piece:
        """Return the rows of the next ``seconds``; none when none is left. StoreError when they are not there."""
        first, columns, file = self.end, 2 * len(self.axes), self.checked.rows_file
        count = min(round(seconds / self._period_s), self.rows - first)
        try:
            with file.open("rb") as body:
                body.seek(4 * columns * first)
                content = body.read(4 * columns * count)
        except OSError as error:
            raise StoreError(f"{file} cannot be read ({error.strerror}); arm again", "StoreFault") from None
        if len(content) != 4 * columns * count:
            raise StoreError(f"{file} ends too early; check the disk, then arm again", "CorruptFile")
        self.end += count
        counts: list[list[int]] = np.frombuffer(content, "<i4").reshape(count, columns).T.tolist()
        size = len(self.axes)
        demand = dict(zip(self.axes, counts[:size], strict=True))
        return Piece(first, demand, dict(zip(self.axes, counts[size:], strict=True)), self.done)

    @property
    def done(self) -> bool:
        """Whether no more rows come."""
        return self.end == self.rows

    def lacks(self, status: Mapping[str, Any]) -> bool:
        """Whether the guard, by its status, holds less than the ring ahead of the machine."""
        if self.done or not status.get("rows"):
            return False
        ahead = int(status["rows"][1]) - int(status.get("row") or 0)
        return ahead * self._period_s < RING_S


def longer_than_ring(program: Path, config: MachineConfig) -> bool:
    """Whether a program is longer than what the guard is given at first; no more of it is read than that takes.

    ProgramError, RecordingError or ConfigError when what was read cannot be used.
    """
    rows = 0
    for block in reference_blocks(program, config):
        rows += block.time_s.size
        if rows * config.machine.sync_period_s > FIRST_S:
            return True
    return False
