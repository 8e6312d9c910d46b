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


def _loop(feedforward: float, smoothing_s: Sequence[float], **regulators: Any) -> dict[str, Any]:
    gains = {f"axis.{axis}.regulators.speed_feedforward": feedforward for axis in "XY"}
    rapids = {f"axis.{axis}.rapid_speed_mm_s": FAST_MM_S for axis in "XY"}
    others = {f"axis.{axis}.regulators.{key}": value for axis in "XY" for key, value in regulators.items()}
    return {**gains, **rapids, **others, "nc.smoothing_s": list(smoothing_s)}


# the paper's loops are "PID and/or double PI"; with this integral gain the position oscillates slightly
_DOUBLE_PI = {"structure": "double_pi", "position_ki_per_s2": 1250.0}


PATHS: Mapping[str, Scenario] = {
    "full": Scenario("speed feed-forward 1, smoothing NC", _loop(1.0, SMOOTHED_S)),
    "half": Scenario("speed feed-forward 0.5, smoothing NC", _loop(0.5, SMOOTHED_S)),
    "lag": Scenario("no feed-forward, smoothing NC", _loop(0.0, SMOOTHED_S)),
    "full-programmed": Scenario(
        "speed feed-forward 1, smoothing NC, against the programmed path", _loop(1.0, SMOOTHED_S), programmed=True
    ),
    "half-programmed": Scenario(
        "speed feed-forward 0.5, smoothing NC, against the programmed path", _loop(0.5, SMOOTHED_S), programmed=True
    ),
    "lag-programmed": Scenario(
        "no feed-forward, smoothing NC, against the programmed path", _loop(0.0, SMOOTHED_S), programmed=True
    ),
    "sharp-full": Scenario("speed feed-forward 1, sharp corners", _loop(1.0, ())),
    "sharp-half": Scenario("speed feed-forward 0.5, sharp corners", _loop(0.5, ())),
    "sharp-lag": Scenario("no feed-forward, sharp corners", _loop(0.0, ())),
    "double-pi": Scenario("double PI, no feed-forward, smoothing NC", _loop(0.0, SMOOTHED_S, **_DOUBLE_PI)),
    "sharp-double-pi": Scenario("double PI, speed feed-forward 0.5, sharp corners", _loop(0.5, (), **_DOUBLE_PI)),
}
"""Control loops and NCs that execute the path."""

DEMANDED = tuple(name for name, scenario in PATHS.items() if not scenario.programmed)
"""Scenarios with errors relative to the demand."""
CASCADES = tuple(name for name in DEMANDED if not name.endswith("double-pi"))
"""Of these, the loops that the simulator supports: P, PI and PI."""


@lru_cache(maxsize=1)
def _document() -> str:
    return files("fdhil.cli.paper").joinpath("paper.toml").read_text("utf-8")


@lru_cache(maxsize=32)
def machine(name: str = "") -> MachineConfig:
    """Return the configuration of a scenario; without a name, that of ``configs/paper.toml``."""
    document = tomllib.loads(_document())
    for key, value in (PATHS[name].changes if name else {}).items():
        *tables, last = key.split(".")
        table = document
        for part in tables:
            table = table.setdefault(part, {})
        table[last] = value
    return configuration.parse(document, f"scenario {name}", made_up=True)


RECORDINGS: Mapping[str, Scenario] = {
    "no-noise": Scenario("one rapid of the measured machine, sensors with hardly any noise"),
    "noise-0.1": Scenario("one rapid, white noise of 0.1 % of the full scale of figure 4 (70 V, A, rad/s)"),
    "noise-0.5": Scenario("one rapid, white noise of 0.5 % of that scale"),
    "noise-1": Scenario("one rapid, white noise of 1 % of that scale"),
    "ten-rapids": Scenario("ten rapids a temperature, half of them at 24 rad/s, white noise of 0.5 % of that scale"),
    "no-lowpass": Scenario("no low-pass on any signal"),
    "lowpass-40": Scenario("a zero-phase low-pass of 40 Hz on every signal"),
    "lowpass-150": Scenario("a zero-phase low-pass of 150 Hz on every signal"),
    "quick-no-lowpass": Scenario("the simulator's drive in a rapid of 500 mm/s and 4 m/s2, no low-pass"),
    "quick-40": Scenario("the same, a zero-phase low-pass of 40 Hz on every signal"),
    "quick-150": Scenario("the same, a zero-phase low-pass of 150 Hz on every signal"),
    "load-0": Scenario("nothing pulls at the axis, noise of 0.1 %"),
    "load-1": Scenario("a constant load of 1 N.m pulls at the axis, as a weight does; noise of 0.1 %"),
    "load-1-both-ways": Scenario("the same load, a rapid each way identified together"),
    "backlash-5": Scenario("5 um of backlash, noise of 0.1 %"),
    "backlash-20": Scenario("20 um of backlash, noise of 0.1 %"),
    "backlash-100": Scenario("100 um of backlash, noise of 0.1 %"),
    "residuals": Scenario("whiteness of what least squares leaves of [5] and [6]"),
    "innovations": Scenario("whiteness of the innovations of maximum likelihood"),
    "operation-10-s": Scenario("a cut of 10 s while the slide-ways warm by 2 K with 600 s"),
    "operation-1-min": Scenario("a cut of a minute while they do"),
    "operation-10-min": Scenario("a cut of ten minutes while they do"),
    "force-30": Scenario("a cutting force of 30 N, as in finishing aluminium"),
    "force-300": Scenario("a cutting force of 300 N"),
    "force-3000": Scenario("a cutting force of 3000 N, as in roughing steel"),
    "operators": Scenario("weights of the operator, without a machine"),
}
"""Recordings of the measured machine, and other test conditions."""

SCENARIOS: Mapping[str, Scenario] = {**PATHS, **RECORDINGS}
