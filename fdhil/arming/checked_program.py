"""Holds the checked table rows of a program: it is armed with its first seconds, the rest follows as it runs.

The rows are those of the check, each block compared with the digest that the check reported, so that nothing is
computed while the program runs. The check may still run ahead of the motion; blocks that it has not passed yet do not
exist here. If no more rows arrive, the guard ramps to zero on its own (``TableStarved``) with one second of reserve.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import weakref
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdhil.arming.code_digest import compute_code_digest
from fdhil.arming.program_check import HEADER, ROWS, SCHEMA, compute_header_digest
from fdhil.correction import check_gain
from fdhil.errors import ProgramError, StoreError
from fdhil.program import compute_program_digest
from fdhil.records import Reason

RING_S = 10.0  # of rows held by the guard ahead of the machine; below 1 s it ramps down
FIRST_S = 10.0

NO_ERROR: Mapping[str, float] = {"rms_um": 0.0, "max_um": 0.0}

Rows = dict[str, list[int]]


class TablePiece(NamedTuple):
    """Table rows from row ``first`` on: demand and offset per axis, in increments; ``final``: no more rows follow."""

    first: int
    demand: Rows
    offset: Rows
    final: bool


class CheckedBlock(NamedTuple):
    """A block of checked rows, up to row ``end``; ``last``: the program ends with it."""

    end: int
    sha256: str
    last: bool


class CheckedProgram:
    """The rows of one program that passed the gate: all of them, or those checked so far.

    ``header`` holds the results of the whole check, None before its end; ``refused`` says why the rows end where they
    end. ``half_um`` is half the 95 % interval of the residual error as the plan of the whole program predicts it, None
    if only the skill of the last moves is known. The file stays open, so that renaming it does no harm.
    """

    def __init__(self, rows: Path | int, axes: Sequence[str]) -> None:
        """Open the rows, or take over the file descriptor of rows in memory. Raises OSError if there are none."""
        self.axes = tuple(axes)
        self.method = "inverse"
        self.half_um: float | None = None
        self.warnings: tuple[Reason, ...] = ()
        self.blocks: list[CheckedBlock] = []
        self.errors: Mapping[str, Mapping[str, float]] = {"before": NO_ERROR, "after": NO_ERROR}
        self.header: Mapping[str, Any] | None = None
        self.refused: tuple[Reason, ...] = ()
        self._descriptor = rows if isinstance(rows, int) else os.open(rows, os.O_RDONLY | os.O_CLOEXEC)
        weakref.finalize(self, os.close, self._descriptor)

    @staticmethod
    def find_checked(folder: Path, key: str, program_folder: Path) -> CheckedProgram | None:
        """Return the result stored under ``key``; None if there is none, other code made it, or rows are missing.

        The subroutines in ``program_folder`` must be those of the check.
        """
        try:
            header = json.loads((folder / (key + HEADER)).read_bytes())
            if header.pop("digest") != compute_header_digest(header):
                return None
            found = CheckedProgram(folder / (key + ROWS), header["axes"])
            good = header["schema"] == SCHEMA and header["code"] == compute_code_digest() and not header["refused"]
            good = good and all(
                compute_program_digest(program_folder / name) == sha for name, sha in header["files"].items()
            )
            blocks = [CheckedBlock(end, sha256, end == header["rows"]) for end, sha256 in header["blocks"]]
            for k, block in enumerate(blocks if good else []):
                found.blocks.append(block)
                found.read_block(k)
            os.utime(folder / (key + HEADER))  # the oldest results are deleted
            found.set_header(header)
        except (OSError, StoreError, ValueError, LookupError, TypeError, AttributeError, RecursionError, ProgramError):
            return None
        return found if good and blocks and blocks[-1].last else None

    def add_block(self, block: CheckedBlock, errors: Mapping[str, Mapping[str, float]]) -> None:
        """Add a block that passed; ``errors`` is the contour error so far, without and with the correction."""
        self.blocks.append(block)
        self.errors = errors

    def set_header(self, header: Mapping[str, Any]) -> None:
        self.errors = {which: header[which] for which in ("before", "after")}
        self.header = header

    @property
    def row_count(self) -> int:
        return self.blocks[-1].end if self.blocks else 0

    @property
    def is_complete(self) -> bool:
        return self.header is not None and not self.refused

    @property
    def gain_um(self) -> float:
        """The predicted reduction of the contour error's RMS in these rows; 0 if the gate refuses it."""
        then, now = self.errors["before"]["rms_um"], self.errors["after"]["rms_um"]
        return 0.0 if check_gain(then, now) else then - now

    @property
    def largest_um(self) -> float:
        """The largest offset; infinite while the check goes on."""
        return float(self.header["largest_um"]) if self.header is not None else math.inf

    def read_block(self, k: int) -> bytes:
        """Return the rows of a block. Raises StoreError if they are not those that the check reported."""
        block, first = self.blocks[k], self.blocks[k - 1].end if k else 0
        size = 8 * len(self.axes)
        try:
            content = os.pread(self._descriptor, size * (block.end - first), size * first)
        except OSError as error:
            raise StoreError(f"the checked rows cannot be read ({error.strerror}); arm again", "StoreFault") from None
        if hashlib.sha256(content).hexdigest() != block.sha256:
            raise StoreError("the checked rows are damaged; check the disk, then arm again", "CorruptFile")
        return content


class RowStream:
    """The rows of a checked program in the guard's increments; ``end`` is one past the last row handed out."""

    def __init__(self, checked: CheckedProgram, program_digest: str, sync_period_s: float) -> None:
        self.checked, self.program_digest = checked, program_digest
        self.axes = checked.axes
        self.end = 0
        self.period_s = sync_period_s
        self._next = 0

    @property
    def has_block(self) -> bool:
        """Whether a block can be handed out; the last one only after the check has ended."""
        blocks = self.checked.blocks
        return self._next < len(blocks) and (self.checked.is_complete or not blocks[self._next].last)

    @property
    def checked_until_s(self) -> float:
        """The end of the rows that passed and may be handed out, in seconds of the program."""
        blocks, whole = self.checked.blocks, self.checked.is_complete
        return max((block.end for block in blocks[-2:] if whole or not block.last), default=0) * self.period_s

    @property
    def is_finished(self) -> bool:
        return self.checked.is_complete and self._next == len(self.checked.blocks)

    def take_rows(self, seconds: float = 0.0) -> TablePiece:
        """Return the next block, or more blocks covering ``seconds``. Raises StoreError if the rows cannot be read."""
        first, content = self.end, [self._take_block()]
        while self.has_block and (self.end - first) * self.period_s < seconds:
            content.append(self._take_block())
        size = len(self.axes)
        rows = np.frombuffer(b"".join(content), "<i4").reshape(-1, 2 * size).T.tolist()
        demand, offset = (dict(zip(self.axes, part, strict=True)) for part in (rows[:size], rows[size:]))
        return TablePiece(first, demand, offset, self.is_finished)

    def _take_block(self) -> bytes:
        content = self.checked.read_block(self._next)
        self.end = self.checked.blocks[self._next].end
        self._next += 1
        return content

    def has_too_few_rows(self, status: Mapping[str, Any]) -> bool:
        """Return whether the guard, by its status, holds less than the ring ahead of the machine."""
        return not self.is_finished and self.compute_remaining_s(status) < RING_S

    def compute_remaining_s(self, status: Mapping[str, Any]) -> float:
        """Return the seconds of rows that the guard, by its status, holds ahead of the machine."""
        rows = status.get("rows")
        return (int(rows[1]) - int(status.get("row") or 0)) * self.period_s if rows else math.inf

    def report_progress(self) -> dict[str, Any]:
        """Return how far the check is, whether all passed, and what was refused."""
        checked = self.checked
        return {
            "checked_s": round(checked.row_count * self.period_s, 3),
            "whole": checked.is_complete,
            "refused": [str(reason) for reason in checked.refused],
        }
