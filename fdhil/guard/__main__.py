"""Runs the guard on an open transmit descriptor: ``python -m fdhil.guard --settings FILE --descriptor N``.

``fdhil-guard`` starts it. It opens only its settings file and its control socket.
"""

import argparse
import gc
import os
import socket
import sys
from pathlib import Path

from fdhil.errors import FdhilError
from fdhil.guard import signals
from fdhil.guard.can_socket import adopt_descriptor
from fdhil.guard.frames import Listener
from fdhil.guard.journal import Journal, Notifier
from fdhil.guard.process import Guard
from fdhil.guard.settings import load


def main() -> int:
    """Run the guard; return 0 when it stopped with no offset applied, 3 otherwise."""
    parser = argparse.ArgumentParser(prog="fdhil.guard", description=__doc__)
    parser.add_argument("--settings", type=Path, required=True, help="the settings file that fdhil-guard wrote")
    parser.add_argument("--descriptor", type=int, required=True, help="the open CAN_RAW or socketcand descriptor")
    options = parser.parse_args()
    with signals.catch() as wake:
        try:
            guard = _made(options.settings, options.descriptor, wake)
        except FdhilError as error:
            sys.stderr.write(f"fdhil-guard: {error}\n")
            return error.exit_code
        except OSError as error:
            why = f"descriptor {options.descriptor} cannot be used ({error.strerror}), and nothing was sent"
            sys.stderr.write(f"fdhil-guard: {why}; start the guard with fdhil-guard\n")
            return 3
        gc.collect()
        gc.freeze()
        gc.disable()  # nothing here makes cycles, and a collection would be a late frame
        return guard.run()


def _made(file: Path, descriptor: int, wake: socket.socket) -> Guard:
    settings = load(file)
    can = adopt_descriptor(settings.transport, descriptor, settings.sent_ids, Listener(settings).wanted_ids())
    return Guard(settings, can, Journal(), Notifier(os.environ.get("NOTIFY_SOCKET")), wake)


if __name__ == "__main__":
    sys.exit(main())
