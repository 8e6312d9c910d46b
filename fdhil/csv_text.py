"""Reads the text of a CSV file within a limit, so that no declared or repeated content exhausts memory."""

from collections.abc import Sequence
from pathlib import Path

from fdhil.errors import RecordingError

MAX_BYTES = 256 * 1024 * 1024  # an hour of six columns at 1 kHz
MAX_ROWS = 8_000_000  # more than two hours at 1 kHz
MAX_LINE_CHARS = 64 * 1024
SHOWN_CHARS = 40
LINE_ENDS = "\n\r\v\f\x1c\x1d\x1e\x85\u2028\u2029"  # of str.splitlines


def read_csv_text(path: Path) -> str:
    """Return a file's text; RecordingError when it is unreadable, not text, or exceeds the size of a recording."""
    return decode_text(read_content(path), str(path))


def read_content(path: Path) -> bytes:
    """Return a file's bytes; RecordingError when it is unreadable or exceeds the size of a recording."""
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise RecordingError(f"{path} cannot be read ({error.strerror}): check the path") from None
    if len(raw) > MAX_BYTES:
        raise _make_size_error(str(path))
    return raw


def decode_text(raw: bytes, source: str, encoding: str = "utf-8-sig") -> str:
    """Decode a file's bytes; RecordingError when they are not text, or have too many rows for a recording."""
    if any(raw.count(end.encode()) > MAX_ROWS for end in LINE_ENDS):
        raise _make_size_error(source)
    try:
        return raw.decode(encoding)
    except UnicodeDecodeError:
        raise RecordingError(f"{source} is not a text file: export it as CSV in UTF-8") from None


def _make_size_error(source: str) -> RecordingError:
    return RecordingError(f"{source} is larger than {MAX_BYTES >> 20} MiB or {MAX_ROWS} rows: cut it into parts")


def check_lengths(lines: Sequence[str], first: int, source: str) -> None:
    """Refuse a line that is too long before it is split; ``first`` is its 1-based number."""
    for number, line in enumerate(lines, first):
        if len(line) > MAX_LINE_CHARS:
            raise RecordingError(
                f"{source} line {number} has {len(line)} characters, which no valid row has: export it again"
            )


def quote_cell(text: str) -> str:
    """Return a cell or header for an error message, shortened."""
    return repr(text if len(text) <= SHOWN_CHARS else f"{text[:SHOWN_CHARS]}...")
