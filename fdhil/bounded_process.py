"""Runs a module as a child process with bounds: a request in, documents out, one JSON object a line.

The pipe to its stdin stays open for as long as the parent wants an answer: a child whose parent is gone ends itself.
"""

import asyncio
import contextlib
import json
import os
import resource
import select
import signal
import sys
import threading
from asyncio.subprocess import PIPE, Process
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from fdhil.json_lines import decode_line, encode_line

MAX_LINE = 1 << 26
Take = Callable[[dict[str, Any]], None]


class BoundedProcess:
    """A process that runs ``python -m module``, as its parent sees it. ``kill`` may be called at any time."""

    def __init__(self, module: str) -> None:
        self._module = module
        self._process: Process | None = None
        self._killed = False

    @property
    def pid(self) -> int | None:
        """Its process ID while it runs, else None."""
        return None if self._process is None or self._process.returncode is not None else self._process.pid

    async def run(self, request: Mapping[str, Any], take: Take) -> int:
        """Send a request, hand over each object that is reported, and return the exit code. OSError."""
        try:
            await self.start(request)
            while line := await self.read_line():
                if document := decode_line(line):  # a process that was ended leaves half a line
                    take(document)
        finally:
            code = await self.kill_and_wait()
        return code

    async def start(self, request: Mapping[str, Any]) -> None:
        """Start it with a first request. OSError."""
        command = (sys.executable, "-m", self._module)
        self._process = await asyncio.create_subprocess_exec(*command, stdin=PIPE, stdout=PIPE, limit=MAX_LINE)
        if self._killed:
            self.kill()
        await self.send(request)

    async def send(self, request: Mapping[str, Any]) -> None:
        """Send a request; a process that has ended shows it by having no answer."""
        assert self._process is not None
        assert self._process.stdin is not None
        with contextlib.suppress(ConnectionError):
            self._process.stdin.write(encode_line(request))
            await self._process.stdin.drain()

    async def read_line(self) -> bytes:
        """Return the next line that it reports, b"" at its end."""
        assert self._process is not None
        assert self._process.stdout is not None
        return await self._process.stdout.readline()

    def kill(self) -> None:
        """End it at once, also one that is only about to start."""
        self._killed = True
        if self.pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)  # asyncio's own kill() may take the exit code from who waits

    async def kill_and_wait(self) -> int:
        """Kill it and return its exit code, 0 where it never ran."""
        self.kill()
        return 0 if self._process is None else await asyncio.shield(self._process.wait())


def limit_process(niceness: int, limits: Mapping[int, int]) -> None:
    """Bound what this process may take (RLIMIT_*), without a core file, as far as a sandbox allows it."""
    with contextlib.suppress(OSError):
        os.nice(niceness)
    with contextlib.suppress(OSError):  # where memory ends, it is this process that has to go
        Path("/proc/self/oom_score_adj").write_text("1000", "ascii")
    for what, most in {**limits, resource.RLIMIT_CORE: 0}.items():
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(what, (most, most))


def receive_request() -> dict[str, Any]:
    """Return the one request; from then on this process ends when its parent does."""
    request: dict[str, Any] = json.loads(sys.stdin.buffer.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    return request


def receive_requests(idle_s: float) -> Iterator[dict[str, Any]]:
    """Yield one request after another until the parent is gone, or has sent none for ``idle_s``."""
    with open(0, "rb", buffering=0, closefd=False) as lines:  # select does not see buffered lines
        while select.select([lines], [], [], idle_s)[0] and (line := lines.readline()):
            yield json.loads(line)


def _end_with_parent() -> None:
    # the other end of the pipe is closed then; unbuffered: a lock that is held here would spoil the exit
    while os.read(0, 1):
        pass
    os._exit(1)


def report_to_parent(document: Mapping[str, Any]) -> None:
    """Report an object to the parent."""
    sys.stdout.buffer.write(encode_line(document))
    sys.stdout.flush()
