"""A frame of a bus log in any file format, and functions common to the formats."""

import itertools
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from fdhil.drivers.can.frame_ring import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from fdhil.errors import RecordingError

IDENTIFIER_MASK = 0x1FFFFFFF
BUS_ERROR = ERROR_FLAG | 0x80  # an error frame without a class, as in can-utils
RATE_SWITCH, ERROR_STATE = 1, 2  # the flags of CAN FD that candump writes
FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)  # by DLC
CLASSIC_BYTES = 8
_MOST_NUMBERED = 254
_MOST_CHARACTERS = 4096  # of a line
_BY_NUMBER = re.compile(r"can(0|[1-9]\d{0,2})")


def encode_fd_dlc(count: int) -> int:
    """Return the data length code of a CAN FD frame; ValueError for an impossible byte count."""
    if count not in FD_LENGTHS:
        raise ValueError(f"{count} bytes in a CAN FD frame, which has 0 to 8, 12, 16, 20, 24, 32, 48 or 64")
    return FD_LENGTHS.index(count)


@dataclass(frozen=True, slots=True)
class LoggedFrame:
    """A frame at ``t_ns`` (since 1970, or the log's own zero) on ``bus``; ``can_id`` has the flags of SocketCAN.

    ``dlc`` is the data length code; of a remote frame the requested length. ``fd`` are the flags of a CAN FD frame,
    None for a classic one. ``sent`` is None where the log does not distinguish sent from received frames.
    """

    t_ns: int
    bus: str
    can_id: int
    dlc: int
    data: bytes = b""
    fd: int | None = None
    sent: bool | None = None

    def __post_init__(self) -> None:
        """Raise ValueError for a frame that no bus can carry."""
        if self.identifier > (IDENTIFIER_MASK if self.can_id & (EXTENDED_FLAG | ERROR_FLAG) else 0x7FF):
            raise ValueError(f"identifier {self.identifier:X} is too large")
        length = 0 if self.is_remote else FD_LENGTHS[self.dlc] if self.fd is not None else min(self.dlc, CLASSIC_BYTES)
        if not 0 <= self.dlc < len(FD_LENGTHS) or len(self.data) != length:
            raise ValueError(f"{len(self.data)} bytes of data do not match DLC {self.dlc}")

    @property
    def identifier(self) -> int:
        """Identifier without flags; class of an error frame."""
        return self.can_id & IDENTIFIER_MASK

    @property
    def is_error(self) -> bool:
        return bool(self.can_id & ERROR_FLAG)

    @property
    def is_remote(self) -> bool:
        return bool(self.can_id & REMOTE_FLAG)

    @property
    def is_extended(self) -> bool:
        """Whether its identifier has 29 bits."""
        return bool(self.can_id & EXTENDED_FLAG)


def create_error_frame(t_ns: int, bus: str, sent: bool | None = None) -> LoggedFrame:
    return LoggedFrame(t_ns, bus, BUS_ERROR, CLASSIC_BYTES, bytes(CLASSIC_BYTES), sent=sent)


@dataclass(frozen=True, slots=True)
class LogHeader:
    """Header of a log: ``start_ns`` is whole milliseconds and not after any frame; ``buses`` are numbered from 1."""

    start_ns: int
    buses: Mapping[str, int]
    shows_received: bool
    digits: int = 6


def assign_bus_numbers(names: Iterable[str]) -> dict[str, int]:
    """Number the buses from 1: ``can0`` is 1, as in can-utils; other names get the free numbers.

    >>> assign_bus_numbers(["vcan0", "can1", "can0"])
    {'can1': 2, 'can0': 1, 'vcan0': 3}
    """
    numbers, others = {}, []
    for name in names:
        match = _BY_NUMBER.fullmatch(name)
        if match is not None and int(match[1]) < _MOST_NUMBERED:
            numbers[name] = int(match[1]) + 1
        else:
            others.append(name)
    free = (number for number in range(1, 1 << 16) if number not in numbers.values())
    return numbers | dict(zip(others, free, strict=False))


def format_bus_name(number: int) -> str:
    """Return the name of a bus by its number from 1; some programs write 0 for an unknown bus."""
    return f"can{number - 1}" if number > 0 else "can"


_REMARK = re.compile(r"\W*fdhil: bus (\d+) is (\S+)")


def format_name_remarks(header: LogHeader) -> list[str]:
    """Return remarks with the names of those buses that their number does not imply."""
    return [
        f"fdhil: bus {number} is {name}" for name, number in header.buses.items() if format_bus_name(number) != name
    ]


def parse_name_remark(line: str) -> Iterator[tuple[int, str]]:
    """Yield number and name of a bus if the line is such a remark."""
    if (match := _REMARK.match(line)) is not None:
        yield int(match[1]), match[2]


def explain_parse_error(error: Exception) -> str:
    text = str(error)
    if text.startswith("invalid literal for int()"):  # Python's own words
        return f"{text.rpartition(': ')[2][:40]} where a number belongs (record with numbers, not names)"
    return text if isinstance(error, ValueError) else "it ends in the middle of a frame"


def read_lines(path: Path, encoding: str) -> Iterator[tuple[int, str]]:
    """Yield the lines of a log with their numbers; RecordingError for an overlong line."""
    try:
        with path.open(encoding=encoding, errors="replace") as file:
            for number in itertools.count(1):
                if not (line := file.readline(_MOST_CHARACTERS)):
                    return
                if len(line) == _MOST_CHARACTERS:
                    text = f"line {number} has {_MOST_CHARACTERS} characters or more"
                    raise RecordingError(f"{path}, {text}: it is not a bus log; copy it again")
                yield number, line
    except OSError as error:
        raise RecordingError(f"{path} cannot be read ({error.strerror}); check the file and its permissions") from None


def parse_decimal_ns(seconds: str) -> int:
    """Convert a decimal number of seconds to ns, exactly.

    >>> parse_decimal_ns("1714557600.249713")
    1714557600249713000
    """
    whole, _, fraction = seconds.partition(".")
    return int(whole) * 1_000_000_000 + int(fraction[:9].ljust(9, "0"))


def round_to_us(ns: int) -> int:
    return (ns + 500) // 1000
