"""Records in the store that an offset may be applied in the drives, so that the next daemon knows without a guard."""

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from fdhil.arming.residual_offset import START_AND_ADOPT, ResidualOffset, read_residual_offset
from fdhil.errors import StoreError
from fdhil.store import write_file

FILE_NAME = "may_stand.json"
MOST_BYTES = 64 * 1024


class ResidualOffsetFile:
    """``left``: what the previous daemon left, as the status of a lost guard; None: nothing."""

    def __init__(self, store_directory: Path) -> None:
        self._path = store_directory / FILE_NAME
        self.stored_status = self._read_status()
        self._kept = self.stored_status is not None

    def _read_status(self) -> Mapping[str, Any] | None:
        try:
            with open(self._path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
                offsets = json.loads(file.read(MOST_BYTES) or b"")  # None: a pipe in its place without a writer
        except FileNotFoundError:
            return None
        except (OSError, ValueError, RecursionError):
            offsets = None  # the file exists, so the offset is unknown
        left = {"state": "lost", "may_stand_um": offsets if isinstance(offsets, dict) else {}}
        return {**left, "text": f"no guard has run since; {read_residual_offset(left)}; {START_AND_ADOPT}"}

    def store(self, residual: ResidualOffset) -> None:
        """Record what may be applied: before it is sent, or as soon as it is reported.

        A store that cannot be written reports that itself, and nothing can be armed then.
        """
        if not self._kept:
            offset_um = {**residual.offset_um, **dict.fromkeys(residual.feedforward_axes)}
            with suppress(StoreError):
                write_file(self._path, json.dumps(offset_um).encode())
                self._kept = True

    def remove(self) -> None:
        if self._kept:
            with suppress(OSError):
                self._path.unlink(missing_ok=True)
                self._kept = False
