"""Notifies systemd of the service's state (sd_notify), without a library."""

import contextlib
import os
import socket


def notify_systemd(state: str) -> bool:
    """Send one state such as ``READY=1`` or ``WATCHDOG=1``; return False when no service manager listens.

    The protocol is one datagram to the socket named by NOTIFY_SOCKET; a leading @ is the abstract namespace.
    """
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return False
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
        sender.connect("\0" + address[1:] if address.startswith("@") else address)
        sender.send(state.encode())
        return True
    return False
