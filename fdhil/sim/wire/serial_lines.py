"""Serves simulated sensors on pseudo terminals: Modbus RTU units on one line, or an instrument that tells lines.

``device`` of the configuration becomes a link to the pseudo terminal, so that a program opens it as it would open an
adapter. The lines are served in a thread of their own.
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
from fdhil.sim.wire.attachment import WakePipe
from fdhil.sim.wire.modbus_answers import answer, spoilt
from fdhil.sim.wire.registers import RegisterMap
from fdhil.sim.wire.sensor_faults import SensorFaults

_REQUEST, _SHORTEST, _LONGEST = 8, 4, 256
_TURN_S = 0.25
_PIECES_S = 0.005
_FRAME_END_S = 0.02  # so long a silence ends a frame, whatever of it has come


class Party(Protocol):
    """What is connected to a line."""

    def take(self, data: bytes) -> list[bytes]:
        """Take what came and return the pieces of what is answered; none while there is nothing to say."""

    def due_s(self) -> float:
        """Return when (monotonic) it tells something by itself; infinite: never."""

    def tell(self) -> list[bytes]:
        """Return the pieces of what it tells by itself now."""


class RtuUnits:
    """Modbus RTU units by number; each answers as one on Modbus TCP does, as its faults allow."""

    def __init__(self) -> None:
        self.units: dict[int, tuple[RegisterMap, SensorFaults]] = {}
        self._begun = b""
        self._last_s = 0.0
        self._late: deque[tuple[float, list[bytes]]] = deque()

    def take(self, data: bytes) -> list[bytes]:
        """Answer a whole request; what another unit is asked is not heard."""
        now_s = time.monotonic()
        self._begun = data if now_s - self._last_s > _FRAME_END_S else self._begun + data
        self._last_s = now_s
        request = self._whole_request()
        if not request or request[0] not in self.units:
            return []
        registers, faults = self.units[request[0]]
        pieces = spoilt(faults, _framed, request[0], answer(registers, faults, request[1:-2]))
        if not faults.slow_s:
            return pieces
        self._late.append((now_s + faults.slow_s, pieces))
        return []

    def _whole_request(self) -> bytes:
        """Return a request that has come whole, with whichever function; empty while there is none."""
        for size in (_REQUEST, len(self._begun)):
            request = self._begun[:size]
            if len(request) == size >= _SHORTEST and _sealed(request[:-2]) == request:
                self._begun = self._begun[size:]
                return request
        self._begun = self._begun[-_LONGEST:]
        return b""

    def due_s(self) -> float:
        """Return when an answer that is late comes."""
        return self._late[0][0] if self._late else float("inf")

    def tell(self) -> list[bytes]:
        """Return the answer that was late."""
        return self._late.popleft()[1] if self._late else []


def _framed(unit: int, body: bytes) -> bytes:
    return _sealed(bytes([unit]) + body)


def _sealed(frame: bytes) -> bytes:
    return frame + struct.pack(">H", FramerRTU.compute_CRC(frame))


class TextInstrument:
    """An instrument that tells its value in a line: when it is asked, or every period by itself."""

    def __init__(self, settings: Voltage | Thermometer, read: Reading, faults: SensorFaults) -> None:
        self._settings, self._read, self._faults = settings, read, faults
        self._query = settings.query.encode()
        self._heard = b""
        self._next_s = float("inf") if settings.query else time.monotonic()

    def take(self, data: bytes) -> list[bytes]:
        """Answer each whole question."""
        if not self._query:
            return []
        *questions, self._heard = (self._heard + data).split(self._query)
        return [line for _ in questions for line in self.tell()]

    def due_s(self) -> float:
        """Return when the next line is due."""
        return self._next_s

    def tell(self) -> list[bytes]:
        """Return a line; nothing while it is silent."""
        while not self._query and self._next_s <= time.monotonic():  # what a busy computer missed is not told
            self._next_s += self._settings.period_s
        if self._faults.silent:
            return []
        value = (self._read() - self._settings.offset) / self._settings.scale
        return [f"{value:+.4f}\r\n".encode()]


class Reading(Protocol):
    """Returns what an instrument measures now."""

    def __call__(self) -> float: ...


class _Terminal:
    """One line: a pseudo terminal that ``device`` leads to."""

    def __init__(self, device: str, party: Party) -> None:
        self.party = party
        self._link = Path(device)
        self.fd, self._far = os.openpty()
        tty.setraw(self._far)
        os.set_blocking(self.fd, False)
        try:
            if self._link.is_symlink() and not self._link.exists():
                self._link.unlink()  # of a simulator that was killed
            self._link.symlink_to(os.ttyname(self._far))
        except OSError as error:
            os.close(self.fd)
            os.close(self._far)
            text = f"{device} cannot be made ({error.strerror}): the simulator makes the device that the config names; "
            raise ConnectError("serial sensor", text + "name one that is not there yet, in a folder that is") from None

    def read(self) -> None:
        with contextlib.suppress(OSError):
            self.put(self.party.take(os.read(self.fd, 4096)))

    def put(self, pieces: list[bytes]) -> None:
        for place, piece in enumerate(pieces):
            if place:
                time.sleep(_PIECES_S)
            with contextlib.suppress(OSError):  # nobody reads: what does not fit is lost, as on a line
                os.write(self.fd, piece)

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._link.unlink()
        os.close(self.fd)
        os.close(self._far)


class SerialLines:
    """The serial lines of a machine, in one thread, by the device that leads to each."""

    def __init__(self, parties: Mapping[str, Party]) -> None:
        self._parties = parties
        self._terminals: list[_Terminal] = []
        self._ending = False
        self._thread = threading.Thread(target=self._run, name="sim-serial", daemon=True)

    def start(self) -> None:
        """Make every device; ConnectError when one cannot be made."""
        self._pipe = WakePipe()
        try:
            for device, party in self._parties.items():
                self._terminals.append(_Terminal(device, party))
        except ConnectError:
            self._release()
            raise
        self._thread.start()

    def stop(self) -> None:
        """End the thread and take the devices away."""
        self._ending = True
        self._pipe.wake()
        self._thread.join()
        self._release()

    def _release(self) -> None:
        for terminal in self._terminals:
            terminal.close()
        self._terminals.clear()
        self._pipe.close()

    def _run(self) -> None:
        by_fd = {terminal.fd: terminal for terminal in self._terminals}
        while not self._ending:
            now_s = time.monotonic()
            due_s = min((terminal.party.due_s() for terminal in self._terminals), default=now_s + _TURN_S)
            wait_s = min(max(0.0, due_s - now_s), _TURN_S)
            ready = select.select([*by_fd, self._pipe.fileno()], (), (), wait_s)[0]
            for fd, terminal in by_fd.items():
                if fd in ready:
                    terminal.read()
                if terminal.party.due_s() <= time.monotonic():
                    terminal.put(terminal.party.tell())
