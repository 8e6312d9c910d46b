"""Catches every signal: those that request a stop ramp the offset to zero, all others are ignored."""

import ctypes
import os
import signal
import socket

# SIGXCPU comes from the kernel half a second before it would kill a real-time process that never waits
STOP = frozenset({signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT, signal.SIGXCPU})
KEPT = frozenset({signal.SIGKILL, signal.SIGSTOP, signal.SIGCONT, signal.SIGCHLD})
RESERVED = 32, 33  # of the C library, which allows no handler; sent from outside they would end the process
SIGACTION = {"x86_64": 13, "aarch64": 134, "riscv64": 134}
MASK_BYTES = 8


def catch_signals() -> socket.socket:
    """Install the handlers; return the socket that becomes readable when a signal requests a stop."""
    wake, signalled = socket.socketpair()
    wake.setblocking(False)
    signalled.setblocking(False)
    signal.set_wakeup_fd(signalled.detach(), warn_on_full_buffer=False)
    for number in signal.valid_signals() - KEPT:
        signal.signal(number, _ignore_signal if number in STOP else signal.SIG_IGN)
    _ignore_reserved_signals()
    return wake


def _ignore_signal(*_: object) -> None:
    """Do nothing: the signal's number is on the wake socket already."""


def _ignore_reserved_signals() -> None:
    number = SIGACTION.get(os.uname().machine)
    ignore = (ctypes.c_uint64 * 4)(signal.SIG_IGN)  # the kernel's record: handler first, no flags, no mask
    for reserved in RESERVED if number is not None else ():
        ctypes.CDLL(None).syscall(number, reserved, ignore, None, MASK_BYTES)
