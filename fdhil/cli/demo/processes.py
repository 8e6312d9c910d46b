"""Child processes of the demonstration: simulator, guard and daemon."""

import json
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from fdhil.child_process import wrap_to_end_with_parent
from fdhil.errors import ConnectError, DeviceTimeout

PATIENCE_S = 900.0  # only for hanging processes, on a busy host; an ended process is detected at once


class ChildProcess:
    """A command of fdhil as a child process; stderr goes to a log file, stdout is read line by line.

    Raises ConnectError if it ends before it is ready, DeviceTimeout if an awaited event does not arrive.
    """

    def __init__(
        self, name: str, arguments: list[str], log: Path, death_signal: signal.Signals = signal.SIGTERM
    ) -> None:
        """Start the process; it gets ``death_signal`` if this process ends without stopping it."""
        self.name = name
        self._log = log
        with log.open("ab") as errors:
            self._child = subprocess.Popen(
                wrap_to_end_with_parent([sys.executable, "-m", *arguments], death_signal),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                start_new_session=True,  # Ctrl-C must reach only this process, which stops the others in order
            )
        self._lines: queue.Queue[str | None] = queue.Queue()
        self._reader = threading.Thread(target=self._read_lines, name=f"{name} events", daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        """Process identifier."""
        return self._child.pid

    def _read_lines(self) -> None:
        assert self._child.stdout is not None
        for line in self._child.stdout:
            self._lines.put(line)
        self._lines.put(None)

    def await_event(self, kind: str, timeout_s: float = PATIENCE_S) -> dict[str, Any]:
        """Return the next event of this kind and discard all events before it."""
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                line = self._lines.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                raise DeviceTimeout(
                    self.name, f"did not report {kind!r} within {timeout_s:.0f} s; see {self._log}"
                ) from None
            if line is None:
                raise ConnectError(self.name, f"ended before it reported {kind!r}: {self._read_last_log_line()}")
            event = json.loads(line)
            if event.get("event") == "error":
                raise ConnectError(self.name, str(event.get("text")))
            if event.get("event") == kind:
                return dict(event)

    def send_command(self, command: str, **fields: Any) -> None:
        """Send one command to the operator's panel."""
        assert self._child.stdin is not None
        try:
            self._child.stdin.write(json.dumps({"command": command, **fields}) + "\n")
            self._child.stdin.flush()
        except BrokenPipeError:
            raise ConnectError(self.name, f"has ended: {self._read_last_log_line()}") from None

    def check_running(self) -> None:
        """Raise ConnectError if the process has ended."""
        if self._child.poll() is not None:
            raise ConnectError(
                self.name, f"ended with exit code {self._child.returncode}: {self._read_last_log_line()}"
            )

    def stop(self, timeout_s: float = 60.0) -> int:
        """Terminate the process, kill it after ``timeout_s``, and return its exit code."""
        if self._child.poll() is None:
            self._child.terminate()
        try:
            self._child.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        self._reader.join(timeout_s)
        for stream in (self._child.stdin, self._child.stdout):
            if stream is not None:
                stream.close()
        return self._child.returncode

    def _read_last_log_line(self) -> str:
        lines = self._log.read_text("utf-8", "replace").strip().splitlines()
        return lines[-1] if lines else "without a message"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


class SimulatorProcess(ChildProcess):
    """The simulator with its operator's panel; ``ready`` is its first event."""

    def __init__(self, config: Path, log: Path) -> None:
        # if this process is killed, it runs on until guard and daemon have left the bus
        super().__init__("simulated machine", ["fdhil", "sim", str(config), "--json"], log, signal.SIGUSR1)
        try:
            self.ready: Mapping[str, Any] = self.await_event("ready")
        except BaseException:
            self.stop()
            raise

    def play_program(self, program: Path, trace: Path | None = None, timeout_s: float = PATIENCE_S) -> dict[str, Any]:
        """Let the NC play a program or demand; return its ``finished`` event (late offset frames, trace file)."""
        if trace is not None:
            self.send_command("trace", file=str(trace))
        self.send_command("play", file=str(program))
        return self.await_event("finished", timeout_s)
