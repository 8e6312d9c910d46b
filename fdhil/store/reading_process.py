"""Reads recordings of other programs' formats in a process of its own, which a damaged file may end, hang or fill.

The libraries that read them go where a damaged file points, beyond their own memory too: whoever reads a file lives on,
and is told so in a sentence. ``python -m fdhil.store.reading_process`` is that process: it reads one file after
another, and ends when nobody asks any more.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from multiprocessing.connection import Connection, Pipe
from threading import Lock

import numpy as np

from fdhil import errors
from fdhil.errors import FdhilError, RecordingError
from fdhil.store.recording_table import RecordingTable, unreadable

LONGEST_S = 120.0  # the largest file that is taken at all needs a tenth of it
MEMORY_BYTES = 4 << 30


def read_apart(reader: str, kind: str, content: bytes, source: str) -> RecordingTable:
    """Return what ``read(content, source)`` of the module ``reader`` does, or raise its FdhilError.

    RecordingError where its process did not survive the file, a ``kind`` by its name.
    """
    with _ONE:
        process, answer = _process(source), None
        refusal = unreadable(source, kind, EOFError("what reads it did not survive it"))
        try:
            answer = process.answer(reader, content, source)
        except (EOFError, OSError, ValueError):
            if process.end() == -signal.SIGALRM:
                refusal = unreadable(source, kind, EOFError(f"it was not read within {LONGEST_S:g} s"))
            raise refusal from None
        finally:
            if answer is None:  # also when who asks is interrupted: the next file must not get this one's answer
                process.end()
    if isinstance(answer, FdhilError):
        raise answer
    return answer


class ReadingProcess:
    """The process that reads, as the one that asks sees it. EOFError, OSError where it cannot be started."""

    def __init__(self) -> None:
        self._asked, there = Pipe()
        command = [sys.executable, "-P", "-m", __name__, str(there.fileno())]
        # it finds what is found here, and needs no thread for a sum
        given = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OPENBLAS_NUM_THREADS": "1"}
        with there:
            self.child = subprocess.Popen(
                command,
                env=given,
                pass_fds=(there.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,  # libraries complain there of what is damaged
                start_new_session=True,  # Ctrl-C is for who asks
            )
        with contextlib.ExitStack() as failing:
            failing.callback(self.end)
            self._asked.recv_bytes()  # it is ready
            failing.pop_all()

    def answer(self, reader: str, content: bytes, source: str) -> RecordingTable | FdhilError:
        """Return the table or the refusal; EOFError, OSError, ValueError where there is none."""
        self._asked.send_bytes(json.dumps([reader, source, LONGEST_S]).encode())
        self._asked.send_bytes(content)
        told = json.loads(self._asked.recv_bytes())
        if "error" in told:
            refusal: FdhilError = getattr(errors, told["error"])(told["text"])
            return refusal
        columns = {name: np.frombuffer(self._asked.recv_bytes()).copy() for name in told["columns"]}
        return RecordingTable(told["headers"], columns)

    def end(self) -> int:
        """End it; return how it ended."""
        self._asked.close()
        self.child.kill()
        return self.child.wait()


_ONE = Lock()
_PROCESSES: dict[int, ReadingProcess] = {}  # by who asks: a process that was forked has none of its parent's


def _process(source: str) -> ReadingProcess:
    """Return the process that reads for this one; it is begun with the first file and ends with this one."""
    process = _PROCESSES.get(os.getpid())
    if process is None or process.child.poll() is not None:
        try:
            process = _PROCESSES[os.getpid()] = ReadingProcess()
        except (EOFError, OSError) as error:
            what = f"{source} was not read, the process for it cannot be started ({str(error) or 'it ended at once'})"
            raise RecordingError(f"{what}: free memory, then read it again") from None
    return process


@atexit.register
def _end() -> None:
    process = _PROCESSES.pop(os.getpid(), None)
    if process is not None:
        process.end()


def main() -> None:
    """Read one file after another, until nobody asks any more."""
    for what, most in {resource.RLIMIT_AS: MEMORY_BYTES, resource.RLIMIT_CORE: 0}.items():
        with contextlib.suppress(OSError, ValueError):  # a sandbox may forbid it
            resource.setrlimit(what, (most, most))
    asked = Connection(int(sys.argv[1]))
    asked.send_bytes(b"ready")
    with contextlib.suppress(EOFError, OSError):
        while True:
            reader, source, longest_s = json.loads(asked.recv_bytes())
            content = asked.recv_bytes()
            signal.setitimer(signal.ITIMER_REAL, longest_s)  # what it sends ends this process, in a library too
            for part in _answer(reader, content, source):
                asked.send_bytes(part)
            signal.setitimer(signal.ITIMER_REAL, 0)


def _answer(reader: str, content: bytes, source: str) -> Iterator[bytes]:
    try:
        table: RecordingTable = import_module(reader).read(content, source)
    except FdhilError as error:
        yield json.dumps({"error": type(error).__name__, "text": str(error)}).encode()
        return
    yield json.dumps({"headers": dict(table.headers), "columns": [*table.columns]}).encode()
    for values in table.columns.values():
        yield np.asarray(values, dtype=np.float64).tobytes()


if __name__ == "__main__":
    main()
