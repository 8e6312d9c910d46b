"""Serves simulated sensors on pseudo terminals: Modbus RTU units on one line, or an instrument that sends lines.

The configured ``device`` becomes a link to the pseudo terminal, so that a program opens it like an adapter. The lines
are served in their own thread.
"""

from __future__ import annotations

import contextlib
import os
import select
import struct
import threading
import time
import tty
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from pymodbus.framer import FramerRTU

from fdhil.config import Thermometer, Voltage
from fdhil.errors import ConnectError
from fdhil.sim.wire.bus_attachment import WakePipe
from fdhil.sim.wire.modbus_answers import answer_request, apply_answer_faults
from fdhil.sim.wire.register_maps import RegisterMap
from fdhil.sim.wire.sensor_faults import SensorFaults

_REQUEST, _SHORTEST, _LONGEST = 8, 4, 256
_TURN_S = 0.25
_PIECES_S = 0.005
_FRAME_END_S = 0.02  # a pause of this length ends a frame


class LineParticipant(Protocol):
    """A participant on a serial line."""

    def receive_bytes(self, data: bytes) -> list[bytes]:
        """Process received bytes and return the pieces of the answer, if any."""

    def find_due_s(self) -> float:
        """Return when (monotonic) it sends something unprompted; infinite: never."""

    def send_unprompted(self) -> list[bytes]:
        """Return the pieces that it sends unprompted now."""


class RtuUnits:
    """Modbus RTU units by number; each answers like one on Modbus TCP, subject to its faults."""

    def __init__(self) -> None:
        self.units: dict[int, tuple[RegisterMap, SensorFaults]] = {}
        self._buffer = b""
        self._last_s = 0.0
        self._late: deque[tuple[float, list[bytes]]] = deque()

    def receive_bytes(self, data: bytes) -> list[bytes]:
        """Answer a complete request; requests to other units are ignored."""
        now_s = time.monotonic()
        self._buffer = data if now_s - self._last_s > _FRAME_END_S else self._buffer + data
        self._last_s = now_s
        request = self._extract_request()
        if not request or request[0] not in self.units:
            return []
        registers, faults = self.units[request[0]]
        pieces = apply_answer_faults(
            faults, _frame_answer, request[0], answer_request(registers, faults, request[1:-2])
        )
        if not faults.slow_s:
            return pieces
        self._late.append((now_s + faults.slow_s, pieces))
        return []

    def _extract_request(self) -> bytes:
        """Return a complete request with any function; empty while there is none."""
        for size in (_REQUEST, len(self._buffer)):
            request = self._buffer[:size]
            if len(request) == size >= _SHORTEST and _append_crc(request[:-2]) == request:
                self._buffer = self._buffer[size:]
                return request
        self._buffer = self._buffer[-_LONGEST:]
        return b""

    def find_due_s(self) -> float:
        return self._late[0][0] if self._late else float("inf")

    def send_unprompted(self) -> list[bytes]:
        return self._late.popleft()[1] if self._late else []


def _frame_answer(unit: int, body: bytes) -> bytes:
    return _append_crc(bytes([unit]) + body)


def _append_crc(frame: bytes) -> bytes:
    return frame + struct.pack(">H", FramerRTU.compute_CRC(frame))


class TextInstrument:
    """An instrument that sends its value as a line: on request, or periodically."""

    def __init__(self, settings: Voltage | Thermometer, read: ValueReader, faults: SensorFaults) -> None:
        self._settings, self._read, self._faults = settings, read, faults
        self._query = settings.query.encode()
        self._buffer = b""
        self._next_s = float("inf") if settings.query else time.monotonic()

    def receive_bytes(self, data: bytes) -> list[bytes]:
        if not self._query:
            return []
        *questions, self._buffer = (self._buffer + data).split(self._query)
        return [line for _ in questions for line in self.send_unprompted()]

    def find_due_s(self) -> float:
        return self._next_s

    def send_unprompted(self) -> list[bytes]:
        """Return a line; nothing while it is silent."""
        while not self._query and self._next_s <= time.monotonic():  # lines missed on a busy host are skipped
            self._next_s += self._settings.period_s
        if self._faults.silent:
            return []
        value = (self._read() - self._settings.offset) / self._settings.scale
        return [f"{value:+.4f}\r\n".encode()]


class ValueReader(Protocol):
    """Returns the present value of an instrument."""

    def __call__(self) -> float: ...


class _PseudoTerminal:
    """One line: a pseudo terminal linked as ``device``."""

    def __init__(self, device: str, party: LineParticipant) -> None:
        self.party = party
        self._link = Path(device)
        self.fd, self._far = os.openpty()
        tty.setraw(self._far)
        os.set_blocking(self.fd, False)
        try:
            if self._link.is_symlink() and not self._link.exists():
                self._link.unlink()  # left by a killed simulator
            self._link.symlink_to(os.ttyname(self._far))
        except OSError as error:
            os.close(self.fd)
            os.close(self._far)
            text = (
                f"{device} cannot be created ({error.strerror}); the simulator creates the device named in the config: "
            )
            raise ConnectError("serial sensor", text + "choose an unused name in an existing folder") from None

    def read_input(self) -> None:
        with contextlib.suppress(OSError):
            self.write_pieces(self.party.receive_bytes(os.read(self.fd, 4096)))

    def write_pieces(self, pieces: list[bytes]) -> None:
        for place, piece in enumerate(pieces):
            if place:
                time.sleep(_PIECES_S)
            with contextlib.suppress(OSError):  # without a reader, excess data is lost, as on a real line
                os.write(self.fd, piece)

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._link.unlink()
        os.close(self.fd)
        os.close(self._far)


class SerialLines:
    """The serial lines of a machine, in one thread, by device."""

    def __init__(self, parties: Mapping[str, LineParticipant]) -> None:
        self._parties = parties
        self._terminals: list[_PseudoTerminal] = []
        self._ending = False
        self._thread = threading.Thread(target=self._run_loop, name="sim-serial", daemon=True)

    def start(self) -> None:
        """Create every device; ConnectError when one cannot be created."""
        self._pipe = WakePipe()
        try:
            for device, party in self._parties.items():
                self._terminals.append(_PseudoTerminal(device, party))
        except ConnectError:
            self._release_terminals()
            raise
        self._thread.start()

    def stop(self) -> None:
        self._ending = True
        self._pipe.wake_reader()
        self._thread.join()
        self._release_terminals()

    def _release_terminals(self) -> None:
        for terminal in self._terminals:
            terminal.close()
        self._terminals.clear()
        self._pipe.close()

    def _run_loop(self) -> None:
        by_fd = {terminal.fd: terminal for terminal in self._terminals}
        while not self._ending:
            now_s = time.monotonic()
            due_s = min((terminal.party.find_due_s() for terminal in self._terminals), default=now_s + _TURN_S)
            wait_s = min(max(0.0, due_s - now_s), _TURN_S)
            ready = select.select([*by_fd, self._pipe.fileno()], (), (), wait_s)[0]
            for fd, terminal in by_fd.items():
                if fd in ready:
                    terminal.read_input()
                if terminal.party.find_due_s() <= time.monotonic():
                    terminal.write_pieces(terminal.party.send_unprompted())
