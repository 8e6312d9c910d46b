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
from fdhil.guard import stop_signals
from fdhil.guard.can_socket import adopt_descriptor
from fdhil.guard.event_journal import EventJournal, SystemdNotifier
from fdhil.guard.frame_monitor import FrameMonitor
from fdhil.guard.guard_process import Guard
from fdhil.guard.guard_settings import load_settings


def main() -> int:
    """Run the guard; return 0 when it stopped with no offset applied, 3 otherwise."""
    parser = argparse.ArgumentParser(prog="fdhil.guard", description=__doc__)
    parser.add_argument("--settings", type=Path, required=True, help="the settings file that fdhil-guard wrote")
    parser.add_argument("--descriptor", type=int, required=True, help="the open CAN_RAW or socketcand descriptor")
    options = parser.parse_args()
    with stop_signals.catch_signals() as wake:
        try:
            guard = _build_guard(options.settings, options.descriptor, wake)
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


def _build_guard(file: Path, descriptor: int, wake: socket.socket) -> Guard:
    settings = load_settings(file)
    can = adopt_descriptor(
        settings.transport, descriptor, settings.sent_ids, FrameMonitor(settings).list_received_ids()
    )
    return Guard(settings, can, EventJournal(), SystemdNotifier(os.environ.get("NOTIFY_SOCKET")), wake)


if __name__ == "__main__":
    sys.exit(main())
