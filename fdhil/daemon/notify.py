"""Tells systemd how the service is (sd_notify), without a library."""

from __future__ import annotations

import contextlib
import os
import socket


def notify(state: str) -> bool:
    """Send one state such as ``READY=1`` or ``WATCHDOG=1``; False when no service manager listens.

    The protocol is one datagram to the socket that NOTIFY_SOCKET names; a leading @ is the abstract namespace.
    """
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return False
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
        sender.connect("\0" + address[1:] if address.startswith("@") else address)
        sender.send(state.encode())
        return True
    return False
