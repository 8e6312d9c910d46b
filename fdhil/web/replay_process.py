"""Replays recorded rapids for the pages: a process of its own at low priority, for what computes must not hold them up.

``python -m fdhil.web.replay_process``: the first line on stdin is the configuration, each further one asks for a rapid,
all as JSON. An answer is one line: a + and the signals, or a - and a fault. It only reads, and ends when whoever asks
is gone or has not asked for a while: what it has loaded takes 200 MB.
"""

import json
import resource
import select
import sys
from collections.abc import Mapping
from typing import Any

from fdhil.bounded_process import limit_process
from fdhil.config import MachineConfig
from fdhil.daemon.outcome_store import WINDOWS_FOLDER
from fdhil.errors import FdhilError
from fdhil.pipeline.overlay import lay_over
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
        """``digest`` is the configuration's, by which it is known whether a drive's own loops are still valid."""
        self._config, self._digest = config, digest
        self._checked: set[tuple[int, int]] = set()

    def signals(self, axis: str, number: int) -> RapidSignals:
        """Return a rapid with the model laid over. FdhilError, Refused."""
        store = self._config.store.directory
        with History.read(store, checked=self._checked) as history:
            file = the_window(history, axis, number).file
            loops = newest_loops(history, axis, self._digest)
        if not file:
            text = f"the recording of rapid {number} of axis {axis} was not kept: the disk refused it"
            raise Refused(404, "NotKept", text, "see the notices of that time")
        with open_named(store / WINDOWS_FOLDER, file) as content:
            window = decode_window(content.read(MAX_FILE_BYTES), file)
        return signals_of(lay_over(window, self._config, loops))

    def answer(self, request: Mapping[str, Any]) -> str:
        """Return the line that answers a request."""
        try:
            return "+" + self.signals(str(request["axis"]), int(request["number"])).model_dump_json()
        except Refused as error:
            return "-" + json.dumps({"status": error.status, **error.document})
        except FdhilError as error:
            return "-" + json.dumps({"status": status_of(error), **document_of(error)})


def main() -> None:
    """Answer until whoever asks is gone, or has not asked for a while."""
    limit_process(NICENESS, {resource.RLIMIT_AS: MEMORY_BYTES})
    with open(0, "rb", buffering=0, closefd=False) as lines:  # what a buffer holds back select does not see
        told = json.loads(lines.readline())
        replays = Replays(MachineConfig.model_validate(told["config"]), str(told["digest"]))
        while select.select([lines], [], [], IDLE_S)[0] and (line := lines.readline()):
            sys.stdout.write(replays.answer(json.loads(line)) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
