"""Detects whether a guard is running: the socket of a killed guard does not count, a recreated one does."""

import contextlib
import math
import socket
import time
from pathlib import Path

from fdhil.guard import SOCKET_NAME

ASK_AGAIN_S = 1.0
RENEWED_S = 3.0  # a guard recreates its socket if the run directory was cleaned


class GuardPresence:
    """Detects whether a guard listens at a run directory's socket, at most once a second; from any thread."""

    def __init__(self, run_directory: Path) -> None:
        self._path = run_directory / SOCKET_NAME
        self._asked_s = self._answered_s = -math.inf

    def is_present(self) -> bool:
        now_s = time.monotonic()
        if now_s - self._asked_s >= ASK_AGAIN_S:
            self._asked_s = now_s
            if self._is_listening():
                self._answered_s = now_s
        return now_s - self._answered_s < RENEWED_S

    def _is_listening(self) -> bool:
        with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)) as asking:
            asking.setblocking(False)
            try:
                asking.connect(str(self._path))
            except (FileNotFoundError, NotADirectoryError, ConnectionRefusedError):
                return False
            except OSError:  # it is busy, or accepts other users only
                return True
        return True
