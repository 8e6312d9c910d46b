"""CANopen devices and masters by others, as processes on a hub."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

FOLDER = Path(__file__).parent
NODE = shutil.which("node") or "node"


class ForeignProcess:
    """A peer that joins ``bus`` as ``can.Bus`` would (those in JavaScript: a hub); it tells events as JSON lines.

    It ends when its input does.
    """

    def __init__(self, script: str, bus: Mapping[str, Any], **settings: Any) -> None:
        program = [NODE] if script.endswith(".js") else [sys.executable]
        text = json.dumps({**settings, "bus": dict(bus)})
        command, pipe = [*program, str(FOLDER / script), text], subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe)

    def event(self, name: str) -> dict[str, Any]:
        """Wait for the next event of this name; AssertionError when the peer ends before it."""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            event: dict[str, Any] = json.loads(line)
            if event["event"] == name:
                return event
            assert event["event"] != "error", event
        assert self._process.stderr is not None
        raise AssertionError(f"no {name}: {self._process.stderr.read().decode()}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(timeout=300)
        finally:
            self._process.kill()
            for stream in (self._process.stdout, self._process.stderr):
                assert stream is not None
                stream.close()
            self._process.wait()
