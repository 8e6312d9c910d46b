"""Replays recorded rapids for the pages: a child process at low priority, so that computing does not delay them.

``python -m fdhil.web.replay_process``: the first line on stdin is the configuration, each further one requests a rapid,
all as JSON. An answer is one line: a + and the signals, or a - and a fault. It only reads, and ends with its parent, or
when idle for a while: its libraries take 200 MB.
"""

import json
import resource
import sys
from collections.abc import Mapping
from typing import Any

from fdhil.bounded_process import limit_process, receive_requests
from fdhil.config import MachineConfig
from fdhil.daemon.outcome_store import WINDOWS_FOLDER
from fdhil.errors import FdhilError
from fdhil.pipeline.model_overlay import overlay_model
from fdhil.store.history import History
from fdhil.store.named_file import open_named
from fdhil.store.newest_sets import newest_loops
from fdhil.store.windows import MAX_FILE_BYTES, decode_window
from fdhil.web.answers import Refused, document_of, status_of
from fdhil.web.pages.rapid_list import the_window
from fdhil.web.pages.rapid_signals import RapidSignals, signals_of

NICENESS = 10
IDLE_S = 600.0
MEMORY_BYTES = 4 << 30


class Replays:
    """Answers one request after another."""

    def __init__(self, config: MachineConfig, digest: str) -> None:
        """``digest`` is the configuration's, which decides whether identified regulators are still valid."""
        self._config, self._digest = config, digest
        self._checked: set[tuple[int, int]] = set()

    def signals(self, axis: str, number: int) -> RapidSignals:
        store = self._config.store.directory
        with History.read(store, checked=self._checked) as history:
            file = the_window(history, axis, number).file
            loops = newest_loops(history, axis, self._digest)
        if not file:
            text = f"the recording of rapid {number} of axis {axis} was not stored: writing failed"
            raise Refused(404, "NotKept", text, "see the notices of that time")
        with open_named(store / WINDOWS_FOLDER, file) as content:
            window = decode_window(content.read(MAX_FILE_BYTES), file)
        return signals_of(overlay_model(window, self._config, loops))

    def answer(self, request: Mapping[str, Any]) -> str:
        try:
            return "+" + self.signals(str(request["axis"]), int(request["number"])).model_dump_json()
        except Refused as error:
            return "-" + json.dumps({"status": error.status, **error.document})
        except FdhilError as error:
            return "-" + json.dumps({"status": status_of(error), **document_of(error)})


def main() -> None:
    """Answer requests until the parent is gone, or for a while without any."""
    limit_process(NICENESS, {resource.RLIMIT_AS: MEMORY_BYTES})
    requests = receive_requests(IDLE_S)
    settings = next(requests)
    replays = Replays(MachineConfig.model_validate(settings["config"]), str(settings["digest"]))
    for request in requests:
        sys.stdout.write(replays.answer(request) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
