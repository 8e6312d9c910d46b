"""The tree of errors. Every message names the cause and the next action in one sentence.

Expected outcomes (a refused window, a correction that would not help) are values, not exceptions: see
:mod:`fdhil.records`. Errors here are unexpected; ``exit_code`` is what the command line returns for them.
"""

from __future__ import annotations

import errno
from collections.abc import Sequence
from dataclasses import dataclass

MOST_FAULTS, MOST_CHARACTERS = 51, 2000  # bounds of a message, whatever the file
LONGEST_WORD = 60  # of a program, in a message


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
    """The configuration (or an option) is invalid; reports all faults at once."""

    exit_code = 2

    def __init__(self, source: str, faults: Sequence[ConfigFault]) -> None:
        self.source = source
        self.faults = tuple(faults)
        shown_faults = [str(fault)[:MOST_CHARACTERS] for fault in self.faults[:MOST_FAULTS]]
        if len(self.faults) > MOST_FAULTS:
            shown_faults.append(f"and {len(self.faults) - MOST_FAULTS} more faults; fix these first")
        super().__init__(f"{source}: " + "; ".join(shown_faults))


class DeviceError(FdhilError):
    """A drive, sensor, bus or port fails; ``device`` names it."""

    def __init__(self, device: str, message: str) -> None:
        self.device = device
        super().__init__(f"{device}: {message}")


class ConnectError(DeviceError):
    """A bus, port or peer cannot be reached."""

    @classmethod
    def from_socket_error(cls, device: str, error: OSError, absent: str) -> ConnectError:
        """Return why ``device`` did not answer at its UNIX socket; ``absent`` is the text when nothing listens."""
        text, cause = absent, error.strerror or error
        if error.errno in (errno.EACCES, errno.EPERM):
            text = f"does not accept this user ({cause}), so that it is unknown whether it runs"
            text += "; run the command as a user of its group, or with sudo"
        elif error.errno in (errno.EMFILE, errno.ENFILE):
            text = f"could not be reached ({cause}); close other connections or files, then try again"
        return cls(device, text)


class DeviceTimeout(DeviceError):
    """A device did not answer within its deadline."""


class SdoTimeout(DeviceTimeout):
    """A drive did not answer an SDO request in time; its late answer must not be taken for another request's."""


class ProtocolError(DeviceError):
    """A device sent an answer that its protocol does not allow."""


class ForeignMaster(ProtocolError):
    """Another master is active on a bus on which fdhil was about to send, or sent; fdhil stops sending there."""


class SdoToggle(ProtocolError):
    """The segments of a drive's SDO transfer do not alternate: one was lost, or two masters send requests."""


class SdoTooLarge(ProtocolError):
    """An object is longer than a healthy drive's, or its transfer takes too long."""


class SdoAbort(ProtocolError):
    """An SDO transfer was aborted; ``code`` is the CiA 301 abort code."""

    def __init__(self, device: str, message: str, code: int) -> None:
        self.code = code
        super().__init__(device, message)


class DriveFault(DeviceError):
    """A drive is in a state in which it must not be used."""


class EdsError(DeviceError):
    """An EDS or DCF file is invalid or unreadable."""


class StoreError(FdhilError):
    """The store (recordings, history, journal) cannot be read or written; ``code`` is the class for the operator."""

    def __init__(self, message: str, code: str = "StoreFault") -> None:
        self.code = code
        super().__init__(message)


class RecordingError(FdhilError):
    """A recording or demand is invalid: truncated, empty, without a column, or with text instead of a number."""


class OutputError(FdhilError):
    """An output file cannot be written; its earlier content is kept."""


class ProgramError(FdhilError):
    """An NC program cannot be interpreted; ``line`` is the 1-based line (0: the whole file), ``word`` the word."""

    def __init__(self, line: int, word: str, message: str) -> None:
        self.line = line
        self.word = word
        shown = word if len(word) <= LONGEST_WORD else f"{word[:LONGEST_WORD]}..."
        place = ", ".join(part for part in (f"line {line}" if line else "", repr(shown) if word else "") if part)
        super().__init__(f"{place}: {message}" if place else message)


class GcodeBudget(ProgramError):
    """An NC program exceeds a limit: blocks, repetitions, depth, names, motions or characters of a line."""
