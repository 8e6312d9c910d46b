"""``python -m fdhil.guard --settings FILE --descriptor N``: the guard on an open transmit descriptor.

``fdhil-guard`` starts it; on its own it opens nothing but its settings and its control socket.
"""

from __future__ import annotations

import argparse
import gc
import os
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
    """Run the guard; the exit code is 0 when it stopped with nothing applied, 3 otherwise."""
    parser = argparse.ArgumentParser(prog="fdhil.guard", description=__doc__)
    parser.add_argument("--settings", type=Path, required=True, help="the settings file that fdhil-guard wrote")
    parser.add_argument("--descriptor", type=int, required=True, help="the open CAN_RAW or socketcand descriptor")
    options = parser.parse_args()
    wake = signals.catch()
    try:
        settings = load(options.settings)
        wanted = Listener(settings).wanted_ids()
        can = adopt_descriptor(settings.transport, options.descriptor, settings.sent_ids, wanted)
        guard = Guard(settings, can, Journal(), Notifier(os.environ.get("NOTIFY_SOCKET")), wake)
    except FdhilError as error:
        sys.stderr.write(f"fdhil-guard: {error}\n")
        return error.exit_code
    except OSError as error:
        text = f"descriptor {options.descriptor} cannot be used ({error.strerror}); start the guard with fdhil-guard"
        sys.stderr.write(f"fdhil-guard: {text}\n")
        return 3
    gc.collect()
    gc.freeze()
    gc.disable()  # nothing here makes cycles, and a collection would be a late frame
    return guard.run()


if __name__ == "__main__":
    sys.exit(main())
