"""Updates derived from made-up daemon status documents and events."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fdhil.daemon.daemon_status import DaemonStatus
from fdhil.records import Notice
from fdhil.shopfloor.status_poller import StatusPoller, StatusUpdate
from tests.daemon.simulated_machine import config_of
from tests.store.sample_records import make_outcome, make_published

NOW = 1_700_000_000_000


class Daemon:
    def __init__(self, folder: Path, axes: tuple[str, ...] = ("X", "Y")) -> None:
        config = config_of(folder, axes)
        self._watch, self._listener = DaemonStatus(config, 0.0), StatusPoller(config)
        self._watch.hearing.note_source_opened(0.0)
        self._now_s = 1.0
        self.changes: dict[str, Any] = {}

    def news(self, *outcomes: Any) -> StatusUpdate:
        self._now_s += 1.0
        for result in outcomes:
            self._watch.take_outcome(result, self._now_s)
        status = {"ok": True, "state": "OFF(SHADOW)", **self._watch.build_status(self._now_s), **self.changes}
        return self._listener.build_update(status, self.now_ms)

    def silence(self) -> StatusUpdate:
        self._now_s += 1.0
        return self._listener.build_update(None, self.now_ms, "is not running")

    @property
    def now_ms(self) -> int:
        return NOW + round(1000 * self._now_s)


def identified() -> tuple[Any, ...]:
    return make_outcome(), make_published()


def load_changed(text: str = "Jt rose") -> Notice:
    return Notice("LoadChanged", "MAJOR", text, "X")
