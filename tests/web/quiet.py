"""A process that says all to a log: no thread reads it, so that it may end and begin within a test."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from fdhil.errors import ConnectError

ENDING_S = 120.0


class Quiet:
    """A command of fdhil as a child process."""

    def __init__(self, name: str, arguments: list[str], log: Path) -> None:
        self.name, self._log = name, log
        with log.open("ab") as said:
            command = [sys.executable, "-m", *arguments]
            self._child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=said, stderr=said)

    @property
    def pid(self) -> int:
        """Process identifier."""
        return self._child.pid

    def check(self) -> None:
        """Raise ConnectError when the process has ended by itself."""
        if self._child.poll() is not None:
            last = self._log.read_text("utf-8", "replace").strip().splitlines()[-1:]
            raise ConnectError(self.name, f"ended with exit code {self._child.returncode}: {last}")

    def stop(self) -> int:
        """Ask the process to end (SIGTERM), insist after two minutes, and return its exit code."""
        if self._child.poll() is None:
            self._child.terminate()
        try:
            return self._child.wait(ENDING_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            return self._child.wait()
