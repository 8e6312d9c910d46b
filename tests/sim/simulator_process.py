"""The simulator as the process that users start."""

from __future__ import annotations

import json
import select
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import can

from fdhil.child_process import wrap_to_end_with_parent
from tests.bench import axis_toml, bench_toml

COMMAND = [sys.executable, "-m", "fdhil.cli.main", "sim"]
PATIENCE_S = 500.0


def write_config(folder: Path, sim: str = "", bus: str = "", axes: str = "XY", voltage: str = "") -> Path:
    """Write the bench's configuration with lines for [sim], [bus.can0] and [axis.*.voltage]; return its path."""
    text = bench_toml("", corrected=False)
    for name in axes:
        text += axis_toml(name, corrected=False) + f"[axis.{name}.voltage]\n{voltage}\n"
    path = folder / "machine.toml"
    path.write_text(f"{text}[bus.can0]\n{bus}\n[sim]\n{sim}\n")
    return path


class SimulatorProcess:
    """A running ``fdhil sim --json``; leaving the with block ends it and checks its exit."""

    def __init__(self, *arguments: object) -> None:
        self._process = subprocess.Popen(
            wrap_to_end_with_parent([*COMMAND, *map(str, arguments), "--json"], signal.SIGUSR1),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            bufsize=0,
        )
        self._pending = b""
        self.events: list[dict[str, Any]] = []

    def __enter__(self) -> SimulatorProcess:
        self.ready = self.wait_for_event("ready")
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if error is not None:
            self._process.kill()
        code, stderr = self.end_process()
        if error is None:
            assert (code, stderr) == (0, "")

    def end_process(self, number: int = signal.SIGTERM) -> tuple[int, str]:
        """Send a signal unless it has ended; return the exit code and its standard error."""
        if self._process.poll() is None:
            self.send_signal(number)
        return self.wait_for_end()

    def send_signal(self, number: int) -> None:
        self._process.send_signal(number)

    def wait_for_end(self) -> tuple[int, str]:
        """Wait for the end; return the exit code and its standard error."""
        _, stderr = self._process.communicate(timeout=PATIENCE_S)
        return self._process.returncode, stderr.decode()

    def send_command(self, name: str, **keys: Any) -> None:
        self.send_line(json.dumps({"command": name, **keys}))

    def send_line(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line.encode() + b"\n")

    def close_panel(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.stdin = None

    def wait_for_event(self, name: str) -> dict[str, Any]:
        """Wait for the next event of this name."""
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            event = self._read_event(deadline)
            if event["event"] == name:
                return event
        raise AssertionError(f"no {name}: {self.events}")

    def has_happened(self, name: str) -> bool:
        """Whether an event of this name has come; ``events`` keeps them all."""
        assert self._process.stdout is not None
        while b"\n" in self._pending or select.select([self._process.stdout], (), (), 0)[0]:
            self._read_event(time.monotonic() + PATIENCE_S)
        return any(event["event"] == name for event in self.events)

    def _read_event(self, deadline: float) -> dict[str, Any]:
        assert self._process.stdout is not None
        while b"\n" not in self._pending:
            ready, _, _ = select.select([self._process.stdout], (), (), max(0.0, deadline - time.monotonic()))
            chunk = self._process.stdout.read(65536) if ready else b""
            if not chunk:
                assert self._process.stderr is not None
                self._process.kill()
                raise AssertionError(f"no more events after {self.events}: {self._process.stderr.read().decode()}")
            self._pending += chunk
        line, _, self._pending = self._pending.partition(b"\n")
        event: dict[str, Any] = json.loads(line)
        self.events.append(event)
        return event

    @property
    def bus_settings(self) -> Mapping[str, Any]:
        settings: Mapping[str, Any] = self.ready["buses"]["can0"]
        return settings

    def join_bus(self) -> can.BusABC:
        return can.Bus(**self.bus_settings)
