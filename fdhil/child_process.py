"""Starts child processes that end with the process that started them, even when that one is killed.

As a script (``python child.py PARENT SIGNAL COMMAND...``) it has the kernel send it a signal at its parent's death and
becomes the command. The signal comes when the thread that started the child ends: start children from a thread that
lives as long as they do. A command that changes its user (setpriv, sudo) loses it.
"""

import ctypes
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

PR_SET_PDEATHSIG = 1  # linux/prctl.h
ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def wrap_to_end_with_parent(command: Sequence[str], number: signal.Signals = signal.SIGTERM) -> list[str]:
    """Return a command that runs ``command`` and receives the signal whenever this process ends."""
    return [sys.executable, "-I", "-S", __file__, str(os.getpid()), str(int(number)), *command]


@contextmanager
def interrupt_on_stop_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt once for SIGTERM, SIGHUP or Ctrl-C, so that with blocks end children in order.

    Further signals are ignored; ignored signals (nohup) stay ignored. For the main thread only.
    """
    caught = [number for number in ENDING_SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]

    def raise_interrupt(*_: object) -> None:
        for number in caught:
            signal.signal(number, lambda *_: None)
        raise KeyboardInterrupt

    before = {number: signal.signal(number, raise_interrupt) for number in caught}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def request_parent_death_signal(parent: int, number: int = signal.SIGTERM) -> None:
    """Have the kernel send this process a signal when its parent ends; exit if it has already ended."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, number, 0, 0, 0)
    if os.getppid() != parent:
        sys.exit(1)


def main(parent: str, number: str, *command: str) -> None:
    """Become the command, unless the parent has already ended."""
    for each in (int(number), signal.SIGPIPE, signal.SIGXFSZ):  # Python ignores the last two; the command must not
        signal.signal(each, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [int(number)])
    request_parent_death_signal(int(parent), int(number))
    try:
        os.execvp(command[0], command)
    except OSError as error:
        sys.exit(f"{command[0]} cannot be started: {error.strerror}")


if __name__ == "__main__":
    main(*sys.argv[1:])
