"""Read the lines of a program, a file or any iterable of lines, once, with positions to return to.

Only positions for loops and calls are kept, so memory use is independent of the program's length.
"""

from __future__ import annotations

import codecs
import hashlib
import os
import stat
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, NamedTuple, cast

from fdhil.errors import GcodeBudget, ProgramError

_SPOOL_BYTES = 4_000_000
MAX_BYTES = 1 << 30  # of a corrected program: ten million lines of a hundred characters
_READ_AHEAD_BYTES = 1 << 18
_MAX_KEPT = 2000
_BYTE_ORDER_MARK = codecs.BOM_UTF8.decode("latin-1")  # Windows editors begin UTF-8 files with it


class SourcePlace(NamedTuple):
    """A position before a line of a source: its byte offset and the number of lines before it."""

    source: ProgramSource
    offset: int
    lines: int


class ProgramSource:
    """A program that is read line by line and can return to a position; ProgramError if it cannot be read.

    ``line`` is the 1-based number of the line last read; ``folder`` is where its subroutines are, None for an iterable.
    ``sha256`` is the digest of the open file, even if it is renamed; empty for a device and a file larger than
    ``MAX_BYTES``.
    """

    __slots__ = (
        "_begin",
        "_end",
        "_feed",
        "_file",
        "_kept",
        "_max_chars",
        "_moved",
        "_open",
        "folder",
        "line",
        "name",
        "sha256",
    )

    def __init__(self, program: Path | Iterable[str], max_line_chars: int) -> None:
        self._max_chars = max_line_chars
        self._feed: Iterator[str] | None = None
        self._open = ExitStack()
        self._begin = self._end = 0
        self._moved = False
        self._kept: dict[int, tuple[str, int]] = {}
        self.line = 0
        self.name = ""
        self.folder: Path | None = None
        self.sha256 = ""
        if isinstance(program, Path):
            self.name, self.folder = program.name, program.parent
            try:
                file = self._open.enter_context(program.open("rb", buffering=_READ_AHEAD_BYTES))
                found = os.fstat(file.fileno())
                if stat.S_ISREG(found.st_mode) and found.st_size <= MAX_BYTES:
                    digest = hashlib.sha256()
                    while piece := file.read(_READ_AHEAD_BYTES):
                        digest.update(piece)
                    self.sha256 = digest.hexdigest()
                    file.seek(0)
            except OSError as error:
                raise ProgramError(0, "", f"{program} cannot be read ({error.strerror}); check the path") from None
            self._file: IO[bytes] = file
        else:
            self._file = self._open.enter_context(_open_spool())
            self._feed = iter(program)

    def close(self) -> None:
        """Close the file."""
        self._open.close()

    def get_place_before(self) -> SourcePlace:
        """Return the position before the line last read."""
        return SourcePlace(self, self._begin, self.line - 1)

    def get_place_after(self) -> SourcePlace:
        """Return the position after the line last read."""
        return SourcePlace(self, self._end, self.line)

    def go_to(self, place: SourcePlace) -> None:
        """Return to a position of this source."""
        self._begin = self._end = place.offset
        self._moved = True
        self.line = place.lines

    def read_next_line(self, again: bool = False) -> str | None:
        """Return the next line without its end, None after the last one; repeated lines (``again``) are kept."""
        kept = self._kept.get(self._end) if again else None
        if kept is not None:
            self._moved = True
            text, length = kept
        else:
            raw = self._read_raw_line()
            if not raw:
                return None
            text, length = raw.decode("latin-1").rstrip("\r\n"), len(raw)
            if self._end == 0:
                text = text.removeprefix(_BYTE_ORDER_MARK)
        if again and kept is None:
            if len(self._kept) >= _MAX_KEPT:
                self._kept.clear()
            self._kept[self._end] = (text, length)
        self._begin = self._end
        self._end += length
        self.line += 1
        return text

    def _read_raw_line(self) -> bytes:
        try:
            if self._moved:
                self._file.seek(self._end)
                self._moved = False
            raw = self._file.readline(self._max_chars + 2)
        except OSError as error:
            raise ProgramError(self.line + 1, "", f"cannot be read ({error.strerror}); check the disk") from None
        if not raw and self._feed is not None:
            raw = self._draw_line(self._feed)
        if len(raw) > self._max_chars and len(raw.rstrip(b"\r\n")) > self._max_chars:
            word = raw[:12].decode("latin-1")
            raise GcodeBudget(self.line + 1, word, f"the line is longer than {self._max_chars} characters; split it")
        if self._end == 0 and raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            raise ProgramError(1, "", "the file is UTF-16, which no NC reads; save it as ASCII or UTF-8")
        if b"\0" in raw:
            raise ProgramError(self.line + 1, "\\0", "is a zero byte, so the file is not text; use an NC program")
        return raw

    def _draw_line(self, feed: Iterator[str]) -> bytes:
        line = next(feed, None)
        if line is None:
            return b""
        raw = (line.rstrip("\r\n").replace("\n", " ") + "\n").encode("utf-8", "replace")
        raw = raw[: self._max_chars + 2]
        self._file.write(raw)
        return raw


@contextmanager
def _open_spool() -> Iterator[IO[bytes]]:
    with tempfile.SpooledTemporaryFile(_SPOOL_BYTES) as file:
        yield cast(IO[bytes], file)
