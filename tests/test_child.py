"""A child process ends with its parent, however the parent ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from fdhil import child_process
from fdhil.child_process import interrupt_on_stop_signals, wrap_to_end_with_parent

pytestmark = pytest.mark.usefixtures("processes")

ENDED = [sys.executable, "-c", "import sys; sys.stdin.read()"]
PARENT = """
import os, subprocess, sys
from fdhil.child_process import wrap_to_end_with_parent
code = "import signal, sys; print('up', flush=True); signal.pause()"
subprocess.Popen(wrap_to_end_with_parent([sys.executable, "-c", code]), stdin=subprocess.DEVNULL)
sys.stdin.read()
"""


@pytest.fixture(autouse=True)
def _default_hangup() -> Iterator[None]:
    """Restore the default of SIGHUP, which nohup changes, also for child processes."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGHUP, None])
def test_child_ends_with_parent(number: signal.Signals | None) -> None:
    parent = subprocess.Popen([sys.executable, "-c", PARENT], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert parent.stdin is not None
    assert parent.stdout is not None
    assert parent.stdout.readline() == b"up\n"
    if number is None:
        parent.stdin.close()
    else:
        parent.send_signal(number)
    assert parent.stdout.read() == b""  # the end: neither has it open any more
    parent.stdin.close()
    parent.stdout.close()
    parent.wait()


def test_child_of_dead_parent_is_not_started(tmp_path: Path) -> None:
    with subprocess.Popen(ENDED, stdin=subprocess.PIPE) as ended:
        ended.communicate()
    command = [*wrap_to_end_with_parent([])[:4], str(ended.pid), "15", "touch", str(tmp_path / "started")]
    assert subprocess.run(command).returncode == 1
    assert not [*tmp_path.iterdir()]


def test_child_has_default_signal_handlers() -> None:
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        status = subprocess.check_output(wrap_to_end_with_parent(["cat", "/proc/self/status"]), text=True)
    finally:
        signal.signal(signal.SIGTERM, before)
    ignored = int(next(line.split()[1] for line in status.splitlines() if line.startswith("SigIgn")), 16)
    assert not ignored & (1 << (signal.SIGPIPE - 1) | 1 << (signal.SIGTERM - 1))


def test_missing_command_is_named() -> None:
    done = subprocess.run(wrap_to_end_with_parent(["/nowhere/tool"]), capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (1, "/nowhere/tool cannot be started: No such file or directory\n")


@pytest.mark.parametrize("number", child_process.ENDING_SIGNALS)
def test_first_signal_is_raised_and_second_does_not_interrupt_cleanup(number: signal.Signals) -> None:
    before = {each: signal.getsignal(each) for each in child_process.ENDING_SIGNALS}
    ended = []

    def run_interrupted() -> None:
        try:
            os.kill(os.getpid(), number)
        finally:
            for each in child_process.ENDING_SIGNALS:
                os.kill(os.getpid(), each)
            ended.append(True)

    with pytest.raises(KeyboardInterrupt), interrupt_on_stop_signals():
        run_interrupted()
    assert ended
    assert {each: signal.getsignal(each) for each in child_process.ENDING_SIGNALS} == before


def test_ignored_signal_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interrupt_on_stop_signals():
            os.kill(os.getpid(), signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)
