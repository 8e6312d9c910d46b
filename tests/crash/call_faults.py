"""Keeps records while strace makes one system call fail, return short or end the process; then starts again.

The process is forked from this one, where everything is loaded, so that one run takes a tenth of a second. Its calls
are counted from the start command on. Acknowledgements leave by a socket, whose calls are not affected.
"""

from __future__ import annotations

import contextlib
import ctypes
import io
import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fdhil.errors import FdhilError
from tests.crash.stored_records import Keeper

CALLS = ("openat", "write", "pwrite64", "fsync", "fdatasync", "rename", "link", "unlink", "mkdir", "ftruncate")
WRITES = ("write", "pwrite64")
FAULTS = {
    "killed": "signal=SIGKILL",
    "EIO": "error=EIO",
    "ENOSPC": "error=ENOSPC",
    "full from then on": "error=ENOSPC",
    "wrote nothing": "retval=0",
    "lied of 3 bytes": "retval=3",
}
RECORDS = 3
PATIENCE_S = 120.0
SET_PTRACER, ANY = 0x59616D61, ctypes.c_ulong(-1)

Make = Callable[[Path], Keeper]
Work = Callable[[Path, Callable[..., None]], None]


@dataclass
class CommandChannel:
    kept: list[int] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    found: list[int] = field(default_factory=list)
    said: list[str] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    ended: bool = False


def injection(call: str, nth: int, fault: str) -> str:
    return f"inject={call}:{FAULTS[fault]}:when={nth}{'+' if fault == 'full from then on' else ''}"


def faults_of(call: str) -> Sequence[str]:
    grows = call in (*WRITES, "openat", "mkdir", "rename", "link")
    left_out = {*(() if call in WRITES else ("wrote nothing", "lied of 3 bytes")), "" if grows else "full from then on"}
    return [fault for fault in FAULTS if fault not in left_out]


def kept_under(work: Work, folder: Path, inject: str | None, trace: Path) -> CommandChannel:
    with _forked(lambda tell: work(folder, tell)) as (pid, ours), _traced(pid, inject, trace):
        ours.send(b"go")
        return _read_message(ours)


def looked_at(make: Make, folder: Path, number: int) -> CommandChannel:
    return done_by(lambda tell: look(make, folder, number, tell))


def done_by(work: Callable[[Callable[..., None]], None]) -> CommandChannel:
    with _forked(work) as (_, ours):
        ours.send(b"go")
        return _read_message(ours)


def calls_of(trace: Path) -> Sequence[Counter[str]]:
    threads: dict[str, Counter[str]] = {}
    for thread, call in re.findall(r"^(\d+) +(\w+)\(", trace.read_text("utf-8", "replace"), re.MULTILINE):
        threads.setdefault(thread, Counter())[call] += 1
    return [*threads.values()]


def was_injected(trace: Path) -> bool:
    text = trace.read_text("utf-8", "replace")
    return "(INJECTED)" in text or "killed by SIGKILL" in text


def keep_some(make: Make, folder: Path, tell: Callable[..., None]) -> None:
    keeper = None
    for number in range(1, RECORDS + 1):
        try:
            keeper = keeper or make(folder)
            keeper.keep(number)
        except FdhilError as error:
            tell(refused=str(error))
        else:
            tell(kept=number)
    if keeper is not None:
        keeper.close()


def look(make: Make, folder: Path, number: int, tell: Callable[..., None]) -> None:
    keeper = make(folder)
    if folder.exists():
        for one in _numbers(keeper):
            tell(found=one)
    keeper.keep(number)
    for line in keeper.said:
        tell(said=line)
    after = _numbers(keeper)
    assert number in after, f"record {number}, kept afterwards, is not there"
    keeper.close()
    tell(kept=number)


def _numbers(keeper: Keeper) -> list[int]:
    return sorted(keeper.found())


@contextlib.contextmanager
def _forked(work: Callable[[Callable[..., None]], None]) -> Iterator[tuple[int, socket.socket]]:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    pid = os.fork()
    if pid == 0:
        ours.close()
        _child(work, theirs)
    theirs.close()
    ours.settimeout(PATIENCE_S)
    try:
        yield pid, ours
    finally:
        ours.close()
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)


def _child(work: Callable[[Callable[..., None]], None], theirs: socket.socket) -> None:
    def tell(**what: Any) -> None:
        theirs.send(json.dumps(what).encode())

    try:
        ctypes.CDLL(None).prctl(SET_PTRACER, ANY, 0, 0, 0)
        sys.stderr = sys.stdout = io.StringIO()
        theirs.recv(10)
        work(tell)
        tell(ended=True)
    except BaseException as error:  # noqa: BLE001 (it is told; the fork must not go on as the test)
        tell(wrong=f"{type(error).__name__}: {error}"[:500])
    finally:
        os._exit(0)


@contextlib.contextmanager
def _traced(pid: int, inject: str | None, trace: Path) -> Iterator[None]:
    options = ["-f", "-o", str(trace), "-e", f"trace={','.join(CALLS)}", *(("-e", inject) if inject else ())]
    tracer = subprocess.Popen(["strace", *options, "-p", str(pid)], stderr=subprocess.PIPE, text=True)
    assert tracer.stderr is not None
    try:
        line = tracer.stderr.readline()
        assert "attached" in line, line
        yield
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        tracer.communicate(timeout=PATIENCE_S)


def _read_message(ours: socket.socket) -> CommandChannel:
    result = CommandChannel()
    while not result.wrong and (message := _message(ours)):
        for key, value in json.loads(message).items():
            if key == "ended":
                result.ended = True
            else:
                getattr(result, key).append(value)
    return result


def _message(ours: socket.socket) -> bytes:
    try:
        return ours.recv(65536)
    except ConnectionResetError:
        return b""
    except TimeoutError:
        return json.dumps({"wrong": f"it said nothing for {PATIENCE_S:.0f} s"}).encode()
