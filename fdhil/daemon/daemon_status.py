"""Builds the status document from outcomes. Pure; times are inputs."""

from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from fdhil.config import MachineConfig
from fdhil.daemon.bus_health import BusHealth, Trouble
from fdhil.daemon.nc_watch import NcWatch
from fdhil.daemon.outcome_json import build_loops_document
from fdhil.records import LoopEstimate, Notice, Outcome, ParameterSet, Skill, WindowOutcome
from fdhil.store import report_parameters, report_terms

SCHEMA = "fdhil-status-1"
NOTICES = 20
MINOR = {"MovesNotUsed"}


@dataclass(slots=True)
class _AxisStatus:
    published: ParameterSet | None = None
    accepted: int = 0
    refused: int = 0
    windows: int = 0
    refused_by: Counter[str] = field(default_factory=Counter)
    last: WindowOutcome | None = None
    skill: Skill | None = None
    loops: LoopEstimate | None = None


class DaemonStatus:
    """Tracks the newest outcome of each kind, and what is wrong."""

    def __init__(self, config: MachineConfig, now_s: float) -> None:
        self._config = config
        self._started_s = now_s
        self._axes = {axis: _AxisStatus() for axis in config.axis}
        self._notices: deque[tuple[float, Notice]] = deque(maxlen=NOTICES)
        self._troubles: dict[Trouble, str] = {}
        self.hearing = BusHealth(config, now_s)
        self.nc = NcWatch()

    def load_axis_history(
        self, axis: str, published: ParameterSet | None, counts: tuple[int, int], loops: LoopEstimate | None = None
    ) -> None:
        """Load an axis from the history."""
        watch = self._axes[axis]
        watch.loops = loops
        watch.published, (watch.accepted, watch.refused) = published, counts

    def take_outcome(self, outcome: Outcome, now_s: float) -> None:
        """Take an outcome."""
        if isinstance(outcome, Notice):
            self._notices.append((now_s, outcome))
            return
        if isinstance(outcome, WindowOutcome):
            watch = self._axes[outcome.window.axis]
            watch.last = outcome
            watch.windows += 1
            watch.accepted += outcome.verdict.accepted
            watch.refused += not outcome.verdict.accepted
            if not outcome.verdict.accepted:
                watch.refused_by.update(reason.code for reason in outcome.verdict.reasons[:1])
        elif isinstance(outcome, ParameterSet):
            self._axes[outcome.axis].published = outcome
        elif isinstance(outcome, LoopEstimate):
            self._axes[outcome.axis].loops = outcome
        else:
            self._axes[outcome.axis].skill = outcome

    def describe_config_difference(self, digest: object) -> str:
        """Return a text when a client has another configuration than this daemon; empty: the same."""
        return describe_config_difference(
            {"config_digest": self._config.digest, "limits": _build_limits(self._config)}, digest
        )

    def update_troubles(self, now_s: float) -> list[Notice]:
        """Return notices for new problems since the last call, and for those that are over."""
        before = self._troubles
        self._troubles = self.hearing.find_lasting_troubles(
            {axis: watch.windows for axis, watch in self._axes.items()}, now_s
        )
        begun = [
            Notice(code, get_severity(code), text, axis)
            for (code, axis), text in self._troubles.items()
            if (code, axis) not in before
        ]
        over = [(code, axis) for code, axis in before if (code, axis) not in self._troubles]
        return begun + [Notice(code, "info", "the condition has ended", axis) for code, axis in over]

    def build_status(
        self, now_s: float, stored: Callable[[Notice], Mapping[str, Any]] = lambda _: {}
    ) -> dict[str, Any]:
        """Return the status document (without counters, store and guard).

        ``stored`` returns what is known of a notice since it was stored.
        """
        return {
            "schema": SCHEMA,
            "machine": self._config.machine.name,
            "config_digest": self._config.digest,
            "limits": _build_limits(self._config),
            "uptime_s": round(now_s - self._started_s, 3),
            **self.hearing.build_status(now_s),
            "nc": self.nc.build_status(now_s),
            "troubles": [
                {"code": code, "severity": get_severity(code), "axis": axis, "text": text}
                for (code, axis), text in self._troubles.items()
            ],
            "axes": {axis: self._build_axis_status(axis, now_s) for axis in self._axes},
            "notices": [
                {"age_s": round(now_s - at_s, 3), **asdict(notice), **stored(notice)} for at_s, notice in self._notices
            ],
        }

    def _build_axis_status(self, axis: str, now_s: float) -> dict[str, Any]:
        watch = self._axes[axis]
        published, last = watch.published, watch.last
        return {
            "accepted": watch.accepted,
            "refused": watch.refused,
            "refused_by": dict(watch.refused_by),
            "revision": published and published.revision,
            "windows_used": published and published.windows,
            "tick": published and published.tick,
            "temperature_c": published and published.temperature_c,
            "parameters": report_parameters(published) if published else None,
            "terms": report_terms(published) if published else None,
            "unexplained_um": published and published.unexplained_um,
            "warnings": [str(warning) for warning in published.warnings] if published else [],
            "last_window": _build_window_status(last) if last else None,
            "skill": asdict(watch.skill) if watch.skill else None,
            "loops": build_loops_document(watch.loops) if watch.loops else None,
            "drive_state": self.hearing.get_drive_state(axis),
            "samples_s_ago": self.hearing.get_samples_age_s(axis, now_s),
            "moves": self.hearing.moves[axis].build_status(),
        }


def _build_limits(config: MachineConfig) -> dict[str, dict[str, float | None]]:
    """Return the limits of each axis that may be corrected; null where there is none of that kind."""
    return {
        name: {
            "max_offset_um": axis.correction.max_offset_um,
            "max_speed_mm_s": axis.correction.max_speed_mm_s,
            "max_acceleration_mm_s2": axis.correction.max_acceleration_mm_s2,
            "max_torque_nm": None if axis.feedforward is None else axis.feedforward.max_torque_nm,
            "max_speed_rad_s": None if axis.feedforward is None else axis.feedforward.max_speed_rad_s,
        }
        for name, axis in config.axis.items()
        if axis.correction is not None
    }


def describe_config_difference(status: Mapping[str, Any], digest: object) -> str:
    """Return a text when the daemon of a status runs with another configuration; empty: the same."""
    if status.get("config_digest") == digest:
        return ""
    offsets = ", ".join(f"{axis} {limits['max_offset_um']:g} um" for axis, limits in status.get("limits", {}).items())
    text = "the configuration file has changed since the daemon started; the daemon keeps its own limits"
    return f"{text} ({offsets or 'nothing is sent'}); restart daemon and guard to use the file"


def get_severity(code: str) -> Literal["minor", "MAJOR"]:
    """Return the severity of a class of problem."""
    return "minor" if code in MINOR else "MAJOR"


def _build_window_status(outcome: WindowOutcome) -> dict[str, Any]:
    return {
        "start_s": outcome.window.start_s,
        "direction": outcome.window.direction,
        "accepted": outcome.verdict.accepted,
        "fit_percent": outcome.verdict.fit_percent,
        "reasons": [str(reason) for reason in outcome.verdict.reasons],
        "unexplained_um": outcome.verdict.unexplained_um,
        "warnings": [str(warning) for warning in outcome.verdict.warnings],
        "at_table": None if outcome.at_table is None else asdict(outcome.at_table),
        "nc": None if outcome.window.nc is None else asdict(outcome.window.nc),
    }
