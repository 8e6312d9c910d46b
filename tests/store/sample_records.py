"""Windows, estimates and outcomes with known content, for tests of transport and storage."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fdhil.records import (
    PARAMETERS,
    Estimate,
    Float,
    Parameters,
    ParameterSet,
    Reason,
    Result,
    Stages,
    Verdict,
    Window,
    WindowOutcome,
    freeze_array,
)
from fdhil.store.history_rows import TimeStamp

INCREMENTS_PER_MM = 65536 / 20.0
BENCH = Parameters(0.5, 0.005, 0.8, 0.075, 0.05, 5.0)
STAMP = TimeStamp(1_800_000_000.5, "boot-1", 123_456_789)


def make_window(n: int = 600, seed: int = 1, raw: bool = True, **changes: Any) -> Window:
    """Return a window whose signals are a drive's integers (``raw``) or any floats, with a gap at 100..103."""
    rng = np.random.default_rng(seed)
    speed = np.concatenate([np.linspace(0, 150, n // 3), np.full(n - 2 * (n // 3), 150.0), np.linspace(150, 0, n // 3)])
    speed += rng.normal(0, 0.15, n)
    position = np.cumsum(speed) * 1e-3 * 20 / (2 * math.pi)
    signals = {
        "demand_mm": np.rint(position * INCREMENTS_PER_MM) / INCREMENTS_PER_MM if raw else position,
        "position_mm": np.rint(position * INCREMENTS_PER_MM) / INCREMENTS_PER_MM if raw else position * 1.0001,
        "speed_rad_s": np.rint(speed * 1e4) * (2 * math.pi / 65536) if raw else speed,
        "current_a": np.rint(rng.normal(0, 400, n)) * 0.05 if raw else rng.normal(0, 20, n),
        "voltage_v": np.rint(rng.normal(0, 3000, n)) * 0.02 if raw else rng.normal(0, 60, n),
    }
    for values in signals.values():
        values[100:103] = np.nan
    given: dict[str, Any] = {
        "axis": "X",
        "start_tick": 12_345,
        "start_s": 12.345,
        "dt_s": 0.001,
        "voltage_sampling": "interval_mean",
        "stages": Stages((0, n // 3), (n // 3, 2 * n // 3), None),
        "direction": 1,
        "rapid_speed_rad_s": 157.07963267948966,
        "pitch_mm": 20.0,
        "gaps": ((100, 103),),
        "temperature_c": 21.37,
        "voltage_delay_s": 1 / 3e4,
        "source": "inferred",
    }
    return Window(**(given | {name: freeze_array(values) for name, values in signals.items()} | changes))


def view_bits(values: Float | None) -> bytes | None:
    return None if values is None else np.where(np.isnan(values), np.nan, values).tobytes()


def is_bit_identical(a: Window, b: Window) -> bool:
    names = Window.__dataclass_fields__
    arrays = {"demand_mm", "position_mm", "speed_rad_s", "current_a", "voltage_v"}
    plain = all(repr(getattr(a, name)) == repr(getattr(b, name)) for name in names if name not in arrays)
    return plain and all(view_bits(getattr(a, name)) == view_bits(getattr(b, name)) for name in arrays)


def make_outcome(accepted: bool = True, of: Window | None = None, missing: str = "") -> WindowOutcome:
    values = np.array([math.nan if name == missing else getattr(BENCH, name) for name in PARAMETERS])
    reason = Reason("MissingStage(cruise)", "no plateau")
    estimate = Estimate(
        method="least_squares",
        names=PARAMETERS,
        values=freeze_array(values),
        covariance=freeze_array(np.diag((0.01 * np.nan_to_num(values)) ** 2)),
        residuals={},
        result=Result.OK,
        missing={missing: reason} if missing else {},
    )
    return WindowOutcome(of or make_window(), estimate, Verdict(accepted, 97.25, () if accepted else (reason,)))


def make_published(revision: int = 1, axis: str = "X", parameters: Parameters = BENCH) -> ParameterSet:
    root = np.random.default_rng(revision).normal(0, 1e-3, (6, 6))
    covariance = freeze_array(root @ root.T)
    digest, ticks = "0123456789abcdef", (12_345,)
    return ParameterSet(axis, revision, parameters, covariance, 3, 12_345 + revision, 21.5, digest, ticks)
