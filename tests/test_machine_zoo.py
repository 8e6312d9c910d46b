"""The zoo's machines are independent of the code under test, obey physics, and are examined like by a user."""

from __future__ import annotations

import ast
import math
from pathlib import Path

import numpy as np
import pytest

from studies import zoo
from studies.zoo import nc
from studies.zoo.examination import examine_machine
from studies.zoo.machines import KINDS, machine
from studies.zoo.plant import STEP_S, Drive, Plant, run

PLANT = Plant(R=0.8, L=0.006, K=0.9, Jt=0.01, ft=0.012, Cd=1.2, gravity_nm=2.0)
DRIVE = Drive(40.0, 2.8, 140.0, 15.0, 2000.0, 60.0, 320.0)
PERIOD_S = 1e-3


@pytest.mark.parametrize("name", ["plant", "nc", "machines", "files", "peers"])
def test_zoo_shares_no_code_with_tested_modules(name: str) -> None:
    tree = ast.parse((Path(zoo.__file__).parent / f"{name}.py").read_text("utf-8"))
    modules = {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    modules |= {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    assert not [m for m in modules if m.startswith(("fdhil", "tests")) or (m.startswith("studies.") and "zoo" not in m)]


@pytest.mark.usefixtures("long_computation")
def test_current_at_constant_speed_balances_friction_and_load() -> None:
    rates = nc.make_move(0.3, 0.2, 4.0, 100.0, PERIOD_S)
    moved = run(PLANT, DRIVE, nc.make_set_points([rates], 0.3, PERIOD_S), PERIOD_S)
    cruise = slice(300 + rates.size // 2, 300 + rates.size // 2 + 200)
    speed = 0.2 / PLANT.pitch_m * 2 * math.pi
    expected = (PLANT.Cd + PLANT.ft * speed + PLANT.gravity_nm) / PLANT.K
    assert float(moved.current_mean[cruise].mean()) == pytest.approx(expected, rel=1e-2)
    assert float(moved.current_mean[:200].mean()) == pytest.approx(PLANT.gravity_nm / PLANT.K, rel=1e-2)


def test_moves_end_at_target_within_limits() -> None:
    rates = nc.make_move(-0.2, 0.4, 4.0, 100.0, PERIOD_S)
    assert rates.sum() * PERIOD_S == pytest.approx(-0.2)
    assert np.abs(rates).max() <= 0.4 * 1.01
    assert np.abs(np.diff(rates)).max() / PERIOD_S <= 4.0 * 1.05


def test_distance_from_line_is_perpendicular() -> None:
    path = np.column_stack([np.linspace(0.0, 0.01, 50), np.zeros(50)])
    adjacent = path + np.array([1e-4, 3e-6])
    assert nc.measure_distance_um(path, adjacent, PERIOD_S)[10:40] == pytest.approx(np.full(30, 3.0))


def test_same_seed_draws_same_machines_on_their_grid() -> None:
    for kind in KINDS:
        assert machine(kind, 3) == machine(kind, 3)
        assert kind.period_s / STEP_S == pytest.approx(round(kind.period_s / STEP_S))


@pytest.mark.usefixtures("long_computation")
def test_predicted_gain_of_vertical_axis_is_reached_at_table() -> None:
    kind = next(kind for kind in KINDS if "vertical" in kind.name)
    found = examine_machine(kind, 1)
    correction = found["correction"]
    assert all(axis["pool"] for axis in found["axes"].values())
    assert correction["refused"] == []
    got = correction["got"][0] / correction["got"][1]
    assert got > 3.0
    assert correction["gain"] <= 1.5 * got
    assert correction["worse_um"] <= 1.0
