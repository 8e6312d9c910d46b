"""Free ports for programs that cannot choose one themselves."""

from __future__ import annotations

import random
import socket
from contextlib import suppress

BELOW_EPHEMERAL = range(10_000, 30_000)  # the kernel gives a higher one to a program that asks for any port


def find_free_port() -> int:
    """Return a free TCP port outside the range of automatically assigned ports."""
    while True:
        port = random.SystemRandom().choice(BELOW_EPHEMERAL)
        with suppress(OSError), socket.create_server(("127.0.0.1", port)):
            return port
