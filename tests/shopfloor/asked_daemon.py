"""Updates derived from made-up daemon status documents and events."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fdhil.daemon.status import Watch
from fdhil.records import Notice
from fdhil.shopfloor.news import Listener, News
from tests.daemon.machine import config_of
from tests.store.made import outcome, published

NOW = 1_700_000_000_000


class Daemon:
    def __init__(self, folder: Path, axes: tuple[str, ...] = ("X", "Y")) -> None:
        config = config_of(folder, axes)
        self._watch, self._listener = Watch(config, 0.0), Listener(config)
        self._watch.hearing.source_opened(0.0)
        self._now_s = 1.0
        self.changes: dict[str, Any] = {}

    def news(self, *outcomes: Any) -> News:
        self._now_s += 1.0
        for result in outcomes:
            self._watch.outcome_came(result, self._now_s)
        status = {"ok": True, "state": "OFF(SHADOW)", **self._watch.status(self._now_s), **self.changes}
        return self._listener.news(status, self.now_ms)

    def silence(self) -> News:
        self._now_s += 1.0
        return self._listener.news(None, self.now_ms, "is not running")

    @property
    def now_ms(self) -> int:
        return NOW + round(1000 * self._now_s)


def identified() -> tuple[Any, ...]:
    return outcome(), published()


def load_changed(text: str = "Jt rose") -> Notice:
    return Notice("LoadChanged", "MAJOR", text, "X")
