"""The error tree. Every message is one sentence that names the cause and the next action.

Expected outcomes (a refused window, a correction that would not help) are values, not exceptions: see
:mod:`fdhil.records`. What is raised here is the unexpected, and ``exit_code`` is what the command line returns for it.
"""

from __future__ import annotations

import errno
from collections.abc import Sequence
from dataclasses import dataclass

MOST_TOLD, MOST_CHARACTERS = 51, 2000  # no file makes a message without end
LONGEST_WORD = 60  # of a program, as it is shown


class FdhilError(Exception):
    """Base of all errors that fdhil raises on purpose; ``str(error)`` is a sentence for the operator."""

    exit_code = 3


@dataclass(frozen=True)
class ConfigFault:
    """One fault of a configuration: where it is, what is wrong, and what to write instead."""

    path: str
    what: str
    suggestion: str = ""

    def __str__(self) -> str:
        hint = f" ({self.suggestion})" if self.suggestion else ""
        return f"{self.path}: {self.what}{hint}"


class ConfigError(FdhilError):
    """The configuration (or an option) cannot be used; carries all faults at once, not only the first."""

    exit_code = 2

    def __init__(self, source: str, faults: Sequence[ConfigFault]) -> None:
        self.source = source
        self.faults = tuple(faults)
        told = [str(fault)[:MOST_CHARACTERS] for fault in self.faults[:MOST_TOLD]]
        if len(self.faults) > MOST_TOLD:
            told.append(f"and {len(self.faults) - MOST_TOLD} more faults; mend these first")
        super().__init__(f"{source}: " + "; ".join(told))


class DeviceError(FdhilError):
    """A drive, sensor, bus or port does not do what it must; ``device`` names it."""

    def __init__(self, device: str, message: str) -> None:
        self.device = device
        super().__init__(f"{device}: {message}")


class ConnectError(DeviceError):
    """A bus, port or peer cannot be reached."""

    @classmethod
    def of_socket(cls, device: str, error: OSError, absent: str) -> ConnectError:
        """Return why ``device`` was not heard at its UNIX socket; ``absent`` says it where nothing listens there."""
        text, cause = absent, error.strerror or error
        if error.errno in (errno.EACCES, errno.EPERM):
            text = f"may not be asked by this user ({cause}), so that whether it runs is not known"
            text += "; ask as a user of its group, or with sudo"
        elif error.errno in (errno.EMFILE, errno.ENFILE):
            text = f"was not asked ({cause}); close other connections or files, then try again"
        return cls(device, text)


class DeviceTimeout(DeviceError):
    """A device did not answer within its deadline."""


class SdoTimeout(DeviceTimeout):
    """A drive did not answer an SDO request in time; its late answer is not taken for another one's."""


class ProtocolError(DeviceError):
    """A device answered something that its protocol does not allow."""


class ForeignMaster(ProtocolError):
    """Another master was heard on a bus on which fdhil was about to send, or sent; it sends no more there."""


class SdoToggle(ProtocolError):
    """A drive's segments of an SDO transfer do not alternate: one was lost, or two masters ask."""


class SdoTooLarge(ProtocolError):
    """An object is longer than a healthy drive's, or takes longer than it may."""


class SdoAbort(ProtocolError):
    """An SDO transfer was aborted; ``code`` is the CiA 301 abort code."""

    def __init__(self, device: str, message: str, code: int) -> None:
        self.code = code
        super().__init__(device, message)


class DriveFault(DeviceError):
    """A drive is in, or fell into, a state in which it must not be used."""


class EdsError(DeviceError):
    """An EDS or DCF file cannot be read."""


class StoreError(FdhilError):
    """The store (recordings, history, journal) cannot be read or written; ``code`` is the class the operator sees."""

    def __init__(self, message: str, code: str = "StoreFault") -> None:
        self.code = code
        super().__init__(message)


class RecordingError(FdhilError):
    """A recording or demand cannot be read: truncated, empty, without a column, or with text where a number belongs."""


class OutputError(FdhilError):
    """A file that a command was asked to write cannot be written; what stood there before is kept."""


class ProgramError(FdhilError):
    """An NC program cannot be interpreted; ``line`` is the 1-based source line (0: the
    whole file), ``word`` the word at fault."""

    def __init__(self, line: int, word: str, message: str) -> None:
        self.line = line
        self.word = word
        shown = word if len(word) <= LONGEST_WORD else f"{word[:LONGEST_WORD]}..."
        place = ", ".join(part for part in (f"line {line}" if line else "", repr(shown) if word else "") if part)
        super().__init__(f"{place}: {message}" if place else message)


class GcodeBudget(ProgramError):
    """An NC program asks for more than one may: blocks, repetitions, depth, names, motions or characters of a line."""
