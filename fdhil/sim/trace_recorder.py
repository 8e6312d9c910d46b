"""Records the true motion of a played file: one CSV row per SYNC, with the true table position."""

import os
from collections.abc import Sequence
from pathlib import Path

from fdhil.errors import StoreError


class TraceRecorder:
    """A CSV of ``time_s`` and per axis reference and table (mm) and offset (um), written row by row.

    The rows go to a temporary file next to ``path``; :meth:`finish` renames it. StoreError when the folder cannot be
    written.
    """

    def __init__(self, path: Path, axes: Sequence[str], period_s: float) -> None:
        self.path = path
        self._period_s = period_s
        self._rows = 0
        if path.exists() and not path.is_file():
            raise StoreError(f"the trace {path} is not a regular file and is not replaced; name another file")
        self._part = path.with_name(f".{path.name}.{os.getpid()}.part")
        try:
            self._file = self._part.open("w", encoding="ascii", newline="\n")
            columns = [f"{axis}_{what}" for axis in axes for what in ("reference_mm", "table_mm", "offset_um")]
            self._file.write(",".join(["time_s", *columns]) + "\n")
        except OSError as error:
            raise _build_write_error(path, error) from None

    def write_row(self, values: Sequence[tuple[float, float, float]]) -> None:
        """Write one row: reference (mm), table (mm) and offset (um) of each axis. StoreError when that fails."""
        cells = [f"{reference:.9f},{table:.9f},{offset:.6f}" for reference, table, offset in values]
        try:
            self._file.write(f"{self._rows * self._period_s:.9g},{','.join(cells)}\n")
        except OSError as error:
            raise _build_write_error(self.path, error) from None
        self._rows += 1

    def finish_file(self) -> None:
        """Close the file and rename it; StoreError when that fails."""
        try:
            self._file.close()
            self._part.replace(self.path)
        except OSError as error:
            raise _build_write_error(self.path, error) from None

    def abandon_file(self) -> None:
        self._file.close()
        self._part.unlink(missing_ok=True)


def _build_write_error(path: Path, error: OSError) -> StoreError:
    return StoreError(f"the trace {path} cannot be written ({error.strerror or error}); choose a writable folder")
