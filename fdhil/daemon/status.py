"""What the daemon tells about itself: gathered from what passes through it. Pure but for the times it is given."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from fdhil.config import MachineConfig
from fdhil.daemon.documents import parameters_status
from fdhil.pipeline import Record
from fdhil.records import Notice, Outcome, ParameterSet, Skill, TickTimes, WindowOutcome

SCHEMA = "fdhil-status-1"
NOTICES = 20
SYNC_INTERVALS = 500
FRAME_BITS = 121  # 8 data bytes, 11 bit identifier, stuffing between none and the worst case
SILENCES = {"BusSilent", "BusDown", "SyncLost"}


@dataclass(slots=True)
class _AxisWatch:
    published: ParameterSet | None = None
    accepted: int = 0
    refused: int = 0
    last: WindowOutcome | None = None
    skill: Skill | None = None


class Watch:
    """Remembers the newest of everything that passes."""

    def __init__(self, config: MachineConfig, now_s: float) -> None:
        self._config = config
        self._started_s = now_s
        self._axes = {axis: _AxisWatch() for axis in config.axis}
        self._notices: deque[tuple[float, Notice]] = deque(maxlen=NOTICES)
        self._sync_ns: deque[int] = deque(maxlen=SYNC_INTERVALS + 1)
        self._sync_tick: deque[int] = deque(maxlen=SYNC_INTERVALS + 1)
        self._open = False
        self._opened_s = now_s
        self._lost_times = 0
        self._last_record_s: float | None = None
        self._silent: set[str] = set()
        self._counted: tuple[float, dict[str, int]] = (now_s, {})
        self._load_percent: dict[str, float] = {}

    def begin(self, axis: str, published: ParameterSet | None, counts: tuple[int, int]) -> None:
        """Start from what the history knows of an axis."""
        watch = self._axes[axis]
        watch.published, (watch.accepted, watch.refused) = published, counts

    def source_opened(self, now_s: float) -> None:
        """The machine can be listened to."""
        self._open, self._opened_s = True, now_s

    def source_lost(self, now_s: float) -> None:
        """The machine cannot be listened to until the source is opened again."""
        self._open, self._opened_s = False, now_s
        self._lost_times += 1
        self._silent.clear()
        self._sync_ns.clear()
        self._sync_tick.clear()

    def source_alive(self, now_s: float, silence_s: float) -> bool:
        """Whether records arrive, or it is known why they cannot (the source is lost, the bus is silent)."""
        latest = max(self._opened_s, self._last_record_s or self._opened_s)
        return not self._open or bool(self._silent) or now_s - latest <= silence_s

    def record_came(self, record: Record | Notice, now_s: float) -> None:
        """Note that the source lives, the SYNC's arrival times, and what is silent."""
        self._last_record_s = now_s
        if isinstance(record, TickTimes):
            self._sync_ns.extend(record.t_ns.tolist())
            self._sync_tick.extend(record.tick.tolist())
        elif isinstance(record, Notice) and record.code in SILENCES:
            if record.severity == "info":
                self._silent.discard(record.code)
            else:
                self._silent.add(record.code)

    def counted(self, counters: Mapping[str, Any], now_s: float) -> None:
        """Take the source's counters from time to time: their growth is the load of each bus."""
        frames = {bus: int(counters.get(f"{bus}.frames", 0)) for bus in self._config.bus}
        then_s, before = self._counted
        if before and now_s > then_s:
            for bus, settings in self._config.bus.items():
                bits = max(0, frames[bus] - before.get(bus, 0)) * FRAME_BITS / (now_s - then_s)
                self._load_percent[bus] = round(100 * bits / settings.bitrate, 1)
        self._counted = now_s, frames

    def outcome_came(self, outcome: Outcome, now_s: float) -> None:
        """Note an outcome."""
        if isinstance(outcome, Notice):
            self._notices.append((now_s, outcome))
            return
        if isinstance(outcome, WindowOutcome):
            watch = self._axes[outcome.window.axis]
            watch.last = outcome
            watch.accepted += outcome.verdict.accepted
            watch.refused += not outcome.verdict.accepted
        elif isinstance(outcome, ParameterSet):
            self._axes[outcome.axis].published = outcome
        else:
            self._axes[outcome.axis].skill = outcome

    def sync_rate_hz(self) -> float | None:
        """Return the SYNC rate over the newest arrivals; None while too few came."""
        if len(self._sync_ns) < 32:
            return None
        span_s = (self._sync_ns[-1] - self._sync_ns[0]) * 1e-9
        return (self._sync_tick[-1] - self._sync_tick[0]) / span_s if span_s > 0 else None

    def status(self, now_s: float) -> dict[str, Any]:
        """Return the status document (without what others know: counters, store, guard)."""
        rate = self.sync_rate_hz()
        return {
            "schema": SCHEMA,
            "machine": self._config.machine.name,
            "config_digest": self._config.digest,
            "uptime_s": round(now_s - self._started_s, 3),
            "source": {
                "state": "listening" if self._open else "reconnecting",
                "since_s": round(now_s - self._opened_s, 3),
                "lost_times": self._lost_times,
                "last_record_age_s": None if self._last_record_s is None else round(now_s - self._last_record_s, 3),
            },
            "sync": {
                "rate_hz": None if rate is None else round(rate, 3),
                "expected_hz": round(1 / self._config.machine.sync_period_s, 3),
                "tick": self._sync_tick[-1] if self._sync_tick else None,
            },
            "bus_load_percent": self._load_percent,
            "axes": {axis: _axis_status(watch) for axis, watch in self._axes.items()},
            "notices": [_notice_status(now_s - at_s, notice) for at_s, notice in self._notices],
        }


def _axis_status(watch: _AxisWatch) -> dict[str, Any]:
    published, last, skill = watch.published, watch.last, watch.skill
    return {
        "accepted": watch.accepted,
        "refused": watch.refused,
        "revision": published and published.revision,
        "windows_used": published and published.windows,
        "tick": published and published.tick,
        "temperature_c": published and published.temperature_c,
        "parameters": parameters_status(published) if published else None,
        "last_window": _window_status(last) if last else None,
        "skill": asdict(skill) if skill else None,
    }


def _window_status(outcome: WindowOutcome) -> dict[str, Any]:
    return {
        "start_s": outcome.window.start_s,
        "direction": outcome.window.direction,
        "accepted": outcome.verdict.accepted,
        "fit_percent": outcome.verdict.fit_percent,
        "reasons": [str(reason) for reason in outcome.verdict.reasons],
    }


def _notice_status(age_s: float, notice: Notice) -> dict[str, Any]:
    return {
        "age_s": round(age_s, 3),
        "code": notice.code,
        "severity": notice.severity,
        "axis": notice.axis,
        "text": notice.text,
        "tick": notice.tick,
    }
