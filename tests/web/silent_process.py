"""A process that writes to a log file, without a thread that reads it, so that tests may start and end it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from fdhil.errors import ConnectError

ENDING_S = 120.0


class SilentProcess:
    def __init__(self, name: str, arguments: list[str], log: Path) -> None:
        self.name, self._log = name, log
        with log.open("ab") as message:
            command = [sys.executable, "-m", *arguments]
            self._child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=message, stderr=message)

    @property
    def pid(self) -> int:
        return self._child.pid

    def check_running(self) -> None:
        if self._child.poll() is not None:
            last = self._log.read_text("utf-8", "replace").strip().splitlines()[-1:]
            raise ConnectError(self.name, f"ended with exit code {self._child.returncode}: {last}")

    def stop(self) -> int:
        if self._child.poll() is None:
            self._child.terminate()
        try:
            return self._child.wait(ENDING_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            return self._child.wait()
