"""Arrays as recordings: what is accepted, and what is refused with cause and action."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import fdhil
from fdhil.errors import ConfigError, RecordingError

TIME = np.arange(0.0, 1.0, 1e-3)
GIVEN: dict[str, Any] = {
    "time": TIME,
    "voltage": 12.0 + 0.0 * TIME,
    "current": np.sin(9 * TIME),
    "speed": 50.0 * np.sin(3 * TIME),
}


class ForeignColumn:
    """A column of another library that converts to an array on request, like those of pandas, polars and xarray."""

    def __init__(self, values: Any) -> None:
        self._values = np.asarray(values)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Any:
        return np.array(self._values, dtype=dtype)


def test_lists_and_foreign_columns_are_accepted() -> None:
    plain = fdhil.Recording(**GIVEN)
    for convert in (list, ForeignColumn, lambda v: v.astype(np.float32) if v is not TIME else v):
        given: dict[str, Any] = {name: convert(values) for name, values in GIVEN.items()}
        made = fdhil.Recording(**given)
        assert made.speed == pytest.approx(plain.speed, rel=1e-5)


@pytest.mark.parametrize("library", ["pandas", "polars", "xarray"])
def test_columns_of_dataframe_libraries_are_accepted(library: str) -> None:
    module = pytest.importorskip(library)
    column = {"pandas": "Series", "polars": "Series", "xarray": "DataArray"}[library]
    made = fdhil.Recording(**{name: getattr(module, column)(values) for name, values in GIVEN.items()})
    assert made.speed == pytest.approx(GIVEN["speed"])


def test_dates_are_accepted_as_times() -> None:
    dates = np.datetime64("2026-01-01") + (TIME * 1e9).round().astype("timedelta64[ns]")
    assert fdhil.Recording(**{**GIVEN, "time": dates}).signals.dt_s == pytest.approx(1e-3)


def replace_signals(name: str, row: int, value: float) -> dict[str, Any]:
    values = GIVEN[name].copy()
    values[row] = value
    return {name: values}


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"current": TIME[1:]}, "different lengths.*'current_A': 999.*give all n samples"),
        (replace_signals("voltage", 5, np.nan), "voltage_V that is not finite at index 5: leave out lost samples"),
        (replace_signals("time", 7, 0.0), r"time does not increase at index 7 \(0 s\): sort or cut"),
        ({"voltage": ["a"] * 1000}, "voltage_V is not an array of numbers"),
        ({"speed": np.ones((1000, 2))}, r"speed_rad_per_s has shape \(1000, 2\)"),
        ({"voltage": 24e3 + 0 * TIME}, "any drive.*mV"),
        ({"current": 9e3 + 0 * TIME}, "any drive.*mA"),
        ({"speed": 9e3 + 0 * TIME}, "any drive.*1/min"),
        ({"time": 1e3 * TIME}, "is time in ms"),
        ({"position": TIME}, "no header pitch_m_per_rev"),
        ({"position": TIME, "pitch_m_per_rev": 20.0}, "write 0.02"),
        ({"speed": None, "position": TIME}, "needed to derive a speed"),
        ({"speed": None}, "no column speed_rad_per_s"),
        ({name: values[:3] for name, values in GIVEN.items()}, "3 rows are too few"),
        ({name: values[:0] for name, values in GIVEN.items()}, "0 rows are too few"),
    ],
)
def test_unusable_arrays_are_refused_with_cause_and_action(given: dict[str, Any], words: str) -> None:
    with pytest.raises(RecordingError, match=words):
        fdhil.Recording(**{**GIVEN, **given})


@pytest.mark.parametrize(
    ("given", "words"),
    [({"dt": 0.0}, "dt: is 0"), ({"voltage": [[1.0]]}, "voltage: has shape"), ({"L": 0.0}, "L: is 0")],
)
def test_simulation_refuses_impossible_drives(given: dict[str, Any], words: str) -> None:
    model = {"R": 1.0, "L": 1e-3, "K": 0.1, "Jt": 1e-3, "ft": 0.0, "Cd": 0.0}
    call = {"voltage": [1.0] * 20, "dt": 1e-3}
    for name, value in given.items():
        (model if name in model else call)[name] = value
    with pytest.raises(ConfigError, match=words):
        fdhil.simulate(fdhil.Model(**model), **call)  # type: ignore[arg-type]


def test_missing_samples_become_gaps() -> None:
    kept = np.r_[0:400, 450:1000]
    made = fdhil.Recording(**{name: values[kept] for name, values in GIVEN.items()})
    assert made.signals.gaps == ((400, 450),)
    assert np.isnan(made.speed[400:450]).all()
