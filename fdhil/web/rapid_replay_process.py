"""Replays recorded rapids for the pages: a child process at low priority, so that computing does not delay them.

``python -m fdhil.web.rapid_replay_process``: the first line on stdin is the configuration, each further one requests a
rapid,
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
from fdhil.daemon import WINDOWS_FOLDER
from fdhil.errors import FdhilError
from fdhil.pipeline import overlay_model
from fdhil.store import MAX_FILE_BYTES, History, decode_window, find_newest_loops, open_named
from fdhil.web.fault_responses import RequestRefused, find_http_status, make_fault_document
from fdhil.web.pages.rapid_list import read_window
from fdhil.web.pages.rapid_signals import RapidSignals, make_rapid_signals

NICENESS = 10
IDLE_S = 600.0
MEMORY_BYTES = 4 << 30


class ReplayServer:
    """Answers one request after another."""

    def __init__(self, config: MachineConfig, digest: str) -> None:
        """``digest`` is the configuration's, which decides whether identified regulators are still valid."""
        self._config, self._digest = config, digest
        self._checked: set[tuple[int, int]] = set()

    def replay_signals(self, axis: str, number: int) -> RapidSignals:
        store = self._config.store.directory
        with History.open_read_only(store, checked=self._checked) as history:
            file = read_window(history, axis, number).file
            loops = find_newest_loops(history, axis, self._digest)
        if not file:
            text = f"the recording of rapid {number} of axis {axis} was not stored: writing failed"
            raise RequestRefused(404, "NotKept", text, "see the notices of that time")
        with open_named(store / WINDOWS_FOLDER, file) as content:
            window = decode_window(content.read(MAX_FILE_BYTES), file)
        return make_rapid_signals(overlay_model(window, self._config, loops))

    def answer_request(self, request: Mapping[str, Any]) -> str:
        try:
            return "+" + self.replay_signals(str(request["axis"]), int(request["number"])).model_dump_json()
        except RequestRefused as error:
            return "-" + json.dumps({"status": error.status, **error.document})
        except FdhilError as error:
            return "-" + json.dumps({"status": find_http_status(error), **make_fault_document(error)})


def main() -> None:
    """Answer requests until the parent is gone, or for a while without any."""
    limit_process(NICENESS, {resource.RLIMIT_AS: MEMORY_BYTES})
    requests = receive_requests(IDLE_S)
    settings = next(requests)
    replays = ReplayServer(MachineConfig.model_validate(settings["config"]), str(settings["digest"]))
    for request in requests:
        sys.stdout.write(replays.answer_request(request) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
