"""No signal that can be caught ends the guard: those that ask it to stop have it ramp to zero, the others do nothing."""

from __future__ import annotations

import ctypes
import os
import signal
import socket

# SIGXCPU comes from the kernel half a second before it would kill a real-time process that never waits
STOP = frozenset({signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT, signal.SIGXCPU})
KEPT = frozenset({signal.SIGKILL, signal.SIGSTOP, signal.SIGCONT, signal.SIGCHLD})
RESERVED = 32, 33  # of the C library, which lets nobody handle them; sent from outside they would end the process
SIGPROCMASK = {"x86_64": 14, "aarch64": 135, "riscv64": 135}
SIG_BLOCK, MASK_BYTES = 0, 8


def catch() -> socket.socket:
    """Take every signal; return the socket that becomes readable when one asks to stop."""
    wake, signalled = socket.socketpair()
    wake.setblocking(False)
    signalled.setblocking(False)
    signal.set_wakeup_fd(signalled.detach(), warn_on_full_buffer=False)
    for number in signal.valid_signals() - KEPT:
        signal.signal(number, _note if number in STOP else signal.SIG_IGN)
    _block_reserved()
    return wake


def _note(*_: object) -> None:
    """The signal's number is on the wake socket already."""


def _block_reserved() -> None:
    number = SIGPROCMASK.get(os.uname().machine)
    if number is not None:
        mask = ctypes.c_uint64(sum(1 << (reserved - 1) for reserved in RESERVED))
        ctypes.CDLL(None).syscall(number, SIG_BLOCK, ctypes.byref(mask), None, MASK_BYTES)
