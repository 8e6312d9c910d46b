"""Reads other programs' recording formats in a child process, which a damaged file may crash, block or fill.

The format libraries follow offsets in a damaged file, even beyond their own memory: the parent survives and reports an
error. ``python -m fdhil.store.reading_process`` loads the libraries and forks for each file, so that one file's damage
does not affect the next; it ends with its parent.
"""

import atexit
import contextlib
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import traceback
from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from fdhil import errors
from fdhil.bounded_process import limit_process
from fdhil.errors import FdhilError, RecordingError
from fdhil.store.recording_table import RecordingTable, make_unreadable_error

LONGEST_S = 120.0  # by the clock; the largest accepted file needs a tenth of it
MOST_BYTES = 4 << 30
LONGEST_NAME = 200


def limit_processor_s(size: int) -> float:
    """Return the processor time for a file of ``size`` bytes: ten times what a slow computer needs."""
    return min(0.8 + 2e-6 * size, LONGEST_S)


def limit_memory_bytes(size: int) -> int:
    """Return the memory for a file of ``size`` bytes; compression reaches factors of 150."""
    return min((256 << 20) + 256 * size, MOST_BYTES)


def read_in_process(reader: str, kind: str, content: bytes, source: str) -> RecordingTable:
    """Return the result of ``read(content, source)`` of the module ``reader``, or raise its FdhilError.

    Raises RecordingError if its process did not survive the file, a ``kind`` by its name. The module's ``library``
    loads what it reads with.
    """
    with _ONE:
        process, answer = _get_process(source), None
        try:
            answer = process.read_file(reader, content, source)
        finally:
            if answer is None:  # interrupted: the next file must not get this one's answer
                process.end()
    if isinstance(answer, FdhilError):
        raise answer
    if isinstance(answer, str):
        raise make_unreadable_error(source, kind, EOFError(answer))
    return answer


class ReadingProcess:
    """The reading process as seen by its parent. Raises EOFError or OSError if it cannot be started.

    ``ended`` is the exit code of the fork that read the last file: 0, or a signal as a negative number.
    """

    def __init__(self) -> None:
        self.ended = 0
        self._asked, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        command = [sys.executable, "-P", "-m", __name__, str(there.fileno())]
        # with this process' import path; its sums need no threads
        given = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OPENBLAS_NUM_THREADS": "1"}
        with contextlib.ExitStack() as failing:
            failing.callback(self._asked.close)
            with there:
                self.child = subprocess.Popen(
                    command,
                    env=given,
                    pass_fds=(there.fileno(),),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,  # where libraries report damage
                    start_new_session=True,  # Ctrl-C is for the parent
                )
            failing.callback(self.end)
            self._receive_exit_code()  # ready
            failing.pop_all()

    def read_file(self, reader: str, content: bytes, source: str) -> RecordingTable | FdhilError | str:
        """Return the table, the reader's refusal, or a text about the end of the fork."""
        try:
            answer = self._exchange(reader, content, source)
        except (EOFError, OSError, ValueError):
            answer = None
        try:
            self.ended = self._receive_exit_code()
        except (EOFError, OSError):  # it was ended itself
            self.ended = self.end()
        if answer is not None and not self.ended:
            return answer
        if self.ended == -signal.SIGALRM:
            return f"it was not read within {LONGEST_S:g} s"
        if self.ended == -signal.SIGPROF:
            return f"it was not read within {limit_processor_s(len(content)):.2g} s of processor time"
        return "its reader crashed"

    def _exchange(self, reader: str, content: bytes, source: str) -> RecordingTable | FdhilError:
        here, there = Pipe()
        with here:
            with there:
                socket.send_fds(self._asked, [reader.encode()], [there.fileno()])
            here.send_bytes(json.dumps([source, LONGEST_S]).encode())
            here.send_bytes(content)
            return receive_table(here)

    def _receive_exit_code(self) -> int:
        exit_code = self._asked.recv(LONGEST_NAME)
        if not exit_code:
            raise EOFError
        return int(exit_code)

    def end(self) -> int:
        """End the process and its fork; return the exit code."""
        self._asked.close()
        if self.child.poll() is None:
            os.killpg(self.child.pid, signal.SIGKILL)
        return self.child.wait()


_ONE = Lock()
_PROCESSES: dict[int, ReadingProcess] = {}  # by process ID: a fork has none of its parent's


def _get_process(source: str) -> ReadingProcess:
    process = _PROCESSES.get(os.getpid())
    if process is None or process.child.poll() is not None:
        _end_process()
        try:
            process = _PROCESSES[os.getpid()] = ReadingProcess()
        except (EOFError, OSError) as error:
            what = f"{source} was not read: the reading process cannot be started ({str(error) or 'it ended at once'})"
            raise RecordingError(f"{what}; free memory, then read it again") from None
    return process


@atexit.register
def _end_process() -> None:
    process = _PROCESSES.pop(os.getpid(), None)
    if process is not None:
        process.end()


def main() -> None:
    """Fork for one file after another and report each fork's exit code, until the parent is gone."""
    limit_process(0, {})
    asked = socket.socket(fileno=int(sys.argv[1]))
    asked.send(b"0")
    with contextlib.suppress(OSError):
        while True:
            name, descriptors, _, _ = socket.recv_fds(asked, LONGEST_NAME, 1)
            if not name:
                return
            reader = import_module(name.decode())
            with contextlib.suppress(FdhilError):  # the fork reports what is missing
                reader.library()
            forked = os.fork()
            if forked == 0:
                asked.close()
                _read_and_exit(reader, descriptors[0])
            os.close(descriptors[0])
            asked.send(str(os.waitstatus_to_exitcode(os.waitpid(forked, 0)[1])).encode())


def _read_and_exit(reader: Any, descriptor: int) -> None:
    code = 1
    try:
        asked = Connection(descriptor)
        source, longest_s = json.loads(asked.recv_bytes())
        send_table(asked, reader, asked.recv_bytes(), source, longest_s)
        code = 0
    except BaseException:  # noqa: BLE001 - this process exists for this file alone
        traceback.print_exc()
    finally:
        os._exit(code)


def send_table(asked: Connection, reader: Any, content: bytes, source: str, longest_s: float) -> None:
    """Read a file in this process within the limits for its size, and send the table or the refusal."""
    has = int(Path("/proc/self/statm").read_text("ascii").split()[0]) * resource.getpagesize()
    _, most = resource.getrlimit(resource.RLIMIT_AS)
    with contextlib.suppress(OSError, ValueError):  # a sandbox may forbid it
        resource.setrlimit(resource.RLIMIT_AS, (has + limit_memory_bytes(len(content)), most))
    signal.setitimer(signal.ITIMER_REAL, longest_s)  # these signals end this process, also inside a library
    signal.setitimer(signal.ITIMER_PROF, limit_processor_s(len(content)))
    for part in _encode_parts(reader, content, source):
        asked.send_bytes(part)


def _encode_parts(reader: Any, content: bytes, source: str) -> Iterator[bytes]:
    try:
        table: RecordingTable = reader.read(content, source)
    except FdhilError as error:
        yield json.dumps({"error": type(error).__name__, "text": str(error)}).encode()
        return
    yield json.dumps({"tables": 1 + len(table.others)}).encode()
    for each in (table, *table.others):
        head = {"headers": dict(each.headers), "columns": [*each.columns], "clocks": [*each.clocks]}
        texts = {name: [*found] for name, found in each.texts.items()}
        yield json.dumps({**head, "doubts": dict(each.doubts), "texts": texts}).encode()
        for values in each.columns.values():
            yield np.asarray(values, dtype=np.float64).tobytes()


def receive_table(asked: Connection) -> RecordingTable | FdhilError:
    """Return the table or the refusal. Raises EOFError, OSError or ValueError if there is none."""
    head = json.loads(asked.recv_bytes())
    if "error" in head:
        refusal: FdhilError = getattr(errors, head["error"])(head["text"])
        return refusal
    first, *others = [_receive_columns(asked) for _ in range(head["tables"])]
    return replace(first, others=tuple(others))


def _receive_columns(asked: Connection) -> RecordingTable:
    head = json.loads(asked.recv_bytes())
    columns = {name: np.frombuffer(asked.recv_bytes()).copy() for name in head["columns"]}
    return RecordingTable(head["headers"], columns, frozenset(head["clocks"]), head["doubts"], texts=head["texts"])


if __name__ == "__main__":
    main()
