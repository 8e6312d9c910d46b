"""Scenarios of the claims: variations of the paper's machine."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.resources import files
from typing import Any

from fdhil import config as configuration
from fdhil.config import MachineConfig

SMOOTHED_S = (0.060, 0.030)
FAST_MM_S = 500.0  # 20 m/min exceed the measured 60 rad/s at this pitch


@dataclass(frozen=True, slots=True)
class Scenario:
    """A variation of the machine: ``changes`` are keys of its configuration, ``setting`` is everything else.

    ``programmed``: errors are relative to the programmed path instead of the NC's demand.
    """

    title: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    setting: str = ""
    programmed: bool = False


def _make_changes(feedforward: float, smoothing_s: Sequence[float], **regulators: Any) -> dict[str, Any]:
    gains = {f"axis.{axis}.regulators.speed_feedforward": feedforward for axis in "XY"}
    rapids = {f"axis.{axis}.rapid_speed_mm_s": FAST_MM_S for axis in "XY"}
    others = {f"axis.{axis}.regulators.{key}": value for axis in "XY" for key, value in regulators.items()}
    return {**gains, **rapids, **others, "nc.smoothing_s": list(smoothing_s)}


# the paper's loops are "PID and/or double PI"; with this integral gain the position oscillates slightly
_DOUBLE_PI = {"structure": "double_pi", "position_ki_per_s2": 1250.0}


PATHS: Mapping[str, Scenario] = {
    "full": Scenario("speed feed-forward 1, smoothing NC", _make_changes(1.0, SMOOTHED_S)),
    "half": Scenario("speed feed-forward 0.5, smoothing NC", _make_changes(0.5, SMOOTHED_S)),
    "lag": Scenario("no feed-forward, smoothing NC", _make_changes(0.0, SMOOTHED_S)),
    "full-programmed": Scenario(
        "speed feed-forward 1, smoothing NC, against the programmed path",
        _make_changes(1.0, SMOOTHED_S),
        programmed=True,
    ),
    "half-programmed": Scenario(
        "speed feed-forward 0.5, smoothing NC, against the programmed path",
        _make_changes(0.5, SMOOTHED_S),
        programmed=True,
    ),
    "lag-programmed": Scenario(
        "no feed-forward, smoothing NC, against the programmed path", _make_changes(0.0, SMOOTHED_S), programmed=True
    ),
    "sharp-full": Scenario("speed feed-forward 1, sharp corners", _make_changes(1.0, ())),
    "sharp-half": Scenario("speed feed-forward 0.5, sharp corners", _make_changes(0.5, ())),
    "sharp-lag": Scenario("no feed-forward, sharp corners", _make_changes(0.0, ())),
    "double-pi": Scenario("double PI, no feed-forward, smoothing NC", _make_changes(0.0, SMOOTHED_S, **_DOUBLE_PI)),
    "sharp-double-pi": Scenario(
        "double PI, speed feed-forward 0.5, sharp corners", _make_changes(0.5, (), **_DOUBLE_PI)
    ),
}
"""Control loops and NCs that execute the path."""

DEMANDED = tuple(name for name, scenario in PATHS.items() if not scenario.programmed)
"""Scenarios with errors relative to the demand."""
CASCADES = tuple(name for name in DEMANDED if not name.endswith("double-pi"))
"""Of these, the loops that the simulator supports: P, PI and PI."""


@lru_cache
def _read_text(name: str) -> str:
    return files("fdhil.cli.paper").joinpath(name).read_text("utf-8")


@lru_cache(maxsize=32)
def load_machine(name: str = "") -> MachineConfig:
    """Return the configuration of a scenario; without a name, that of ``configs/paper.toml``."""
    document = tomllib.loads(_read_text("paper.toml"))
    for key, value in (PATHS[name].changes if name else {}).items():
        *tables, last = key.split(".")
        table = document
        for part in tables:
            table = table.setdefault(part, {})
        table[last] = value
    return configuration.parse_config(document, f"scenario {name}", made_up=True)


RECORDINGS: Mapping[str, Scenario] = {
    name: Scenario(title) for name, title in tomllib.loads(_read_text("recordings.toml")).items()
}
"""Recordings of the measured machine, and other test conditions."""

SCENARIOS: Mapping[str, Scenario] = {**PATHS, **RECORDINGS}
