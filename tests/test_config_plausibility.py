"""Implausible numbers are refused with the unit that was likely meant; ordinary machines never are."""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil import config
from fdhil.config.axis_plausibility import SLIPS, UnitMistake
from fdhil.errors import ConfigError
from tests.bench import AXIS, bench_document, bench_toml

SLOW: dict[str, Any] = {  # friction rules: 65 rad/s
    "rapid_speed_mm_s": 200.0,
    "max_acceleration_mm_s2": 1500.0,
    "nominal": {"R": 0.35, "L": 0.003, "K": 0.55, "Jt": 0.02, "ft": 1.05e-3, "Cd": 2.2},
}


def build_document(**changes: Any) -> dict[str, Any]:
    made = bench_document("X")
    made["axis"]["X"] |= copy.deepcopy(changes)
    return made


def set_value(axis: dict[str, Any], key: str, factor: float) -> float:
    """Multiply a key of an axis' table and return the old value."""
    *path, last = key.split(".")
    for part in path:
        axis = axis[part]
    before = float(axis[last])
    axis[last] = before * factor
    return before


def list_faults(made: dict[str, Any]) -> str:
    """Return the messages about a configuration, refused or not; empty for an ordinary one."""
    try:
        return " ".join(config.find_unlikely_values(config.parse_config(made)))
    except ConfigError as error:
        return str(error)


def test_bench_and_friction_dominated_machine_are_ordinary() -> None:
    assert list_faults(build_document()) == list_faults(build_document(**SLOW)) == ""


@pytest.mark.parametrize("machine", [{}, SLOW], ids=["bench", "slow"])
@pytest.mark.parametrize("slip", SLIPS, ids=lambda slip: f"{slip.key} in {slip.unit}")
def test_number_in_another_unit_is_reported_with_that_unit(slip: UnitMistake, machine: dict[str, Any]) -> None:
    made = build_document(**machine)
    true = set_value(made["axis"]["X"], slip.key, 1 / slip.factor)
    reported = list_faults(made)
    if slip.unit in ("mohm", "m/s", "N.cm", "mN.m.s") and machine:  # a machine could be so; the bench could not
        assert reported == "" or f"axis.X.{slip.key}" in reported
        return
    assert f"axis.X.{slip.key}" in reported
    assert f"{slip.key} = {true:.4g} (" in reported
    assert f" {slip.unit})" in reported


def test_inductance_in_millihenry_is_refused() -> None:
    made = build_document()
    made["axis"]["X"]["nominal"]["L"] = 5.0
    assert list_faults(made) == (
        "config: axis.X.nominal.L: L = 5, R = 0.5: the windings' time constant L/R is 10 s, feed drives have 0.0001 to "
        "0.1 s; did you mean nominal.L = 0.005 (5 mH)?"
    )


@st.composite
def draw_machines(draw: st.DrawFn) -> dict[str, Any]:
    """Ordinary feed drives in vendors' typical sizes: rotary motors with screws, racks or gears, 24 V to 800 V."""

    def between(low: float, high: float) -> float:
        return math.exp(draw(st.floats(math.log(low), math.log(high))))

    pitch_mm, rpm, voltage_v = between(1.0, 300.0), between(60.0, 8000.0), between(24.0, 800.0)
    current_a, start_s = between(2.0, 300.0), between(0.01, 3.0)
    start_s = max(start_s, rpm / 60 * pitch_mm / 1e6)  # no axis accelerates at more than 100 g
    speed = rpm * 2 * math.pi / 60
    K = between(0.05, 0.95) * voltage_v / speed
    R = between(0.01, 0.6) * voltage_v / current_a
    Jt = between(0.02, 0.9) * K * current_a / (speed / start_s)
    axis = copy.deepcopy(dict(AXIS)) | {
        "screw_pitch_mm": pitch_mm,
        "rapid_speed_mm_s": rpm / 60 * pitch_mm,
        "max_acceleration_mm_s2": rpm / 60 * pitch_mm / start_s,
        "nominal": {
            "R": R,
            "L": R * between(2e-4, 0.08),
            "K": K,
            "Jt": Jt,
            "ft": between(1e-6, 0.3) * K * current_a / speed,
            "Cd": between(1e-4, 0.4) * K * current_a,
        },
    }
    del axis["correction"]  # its limits are another matter
    axis["regulators"] |= {"current_limit_a": current_a, "voltage_limit_v": voltage_v}
    return {"machine": {"name": "any"}, "axis": {"X": axis}}


@pytest.mark.usefixtures("long_computation")
@settings(max_examples=300, deadline=None)
@given(draw_machines())
def test_ordinary_machines_give_no_warning(machine: dict[str, Any]) -> None:
    assert list_faults(machine) == ""


def test_unlikely_value_is_used_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "machine.toml"
    path.write_text(bench_toml("X").replace("L = 0.005", "L = 0.1"))
    machine = config.load_config(path)
    assert machine.axis["X"].nominal.L == 0.1
    (record,) = caplog.records
    assert "axis.X.nominal.L is unlikely" in record.getMessage()
    assert "L/R is 0.2 s" in record.getMessage()
