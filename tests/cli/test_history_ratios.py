"""History of an axis without voltage sensor: ratios to K show wear and load changes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.pipeline import analyse_window
from fdhil.records import freeze_array
from fdhil.store.history_database import History
from fdhil.store.history_rows import TimeStamp
from tests.daemon.machine_rig import BENCH, fdhil
from tests.daemon.simulated_machine import config_of
from tests.identification.bench_recordings import find_noisy_windows

START_S, DAYS, LOADED_ON_DAY = 1_800_000_000.0, 20, 12
WEAR_PER_DAY = 0.01  # of Cd/K


@pytest.fixture(scope="module")
def history_without_voltage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A machine without voltage sensor, with wearing friction and a table load added on day 12."""
    tmp_path = tmp_path_factory.mktemp("deaf")
    path = tmp_path / "machine.toml"
    path.write_text(BENCH)
    analysed = analyse_window(replace(find_noisy_windows(0.003)[0], axis="X", voltage_v=None), Identification())
    assert analysed.estimate is not None
    deviations = np.sqrt(np.diag(analysed.estimate.covariance))
    rng = np.random.default_rng(4)
    with History.open(config_of(tmp_path, ("X",)).store.directory) as history:
        for day in range(DAYS):
            values = analysed.estimate.values + deviations * rng.standard_normal(deviations.size)
            values[6] *= 1.13 if day >= LOADED_ON_DAY else 1.0
            values[8] *= 1.0 + WEAR_PER_DAY * day
            estimate = replace(analysed.estimate, values=freeze_array(values))
            history.add_window(
                replace(analysed, estimate=estimate), "", TimeStamp(START_S + 86_400.0 * day, "boot", day)
            )
    return path


def test_ratios_show_wear_and_load_change(history_without_voltage: Path, capsys: Any) -> None:
    document = json.loads(fdhil("history", history_without_voltage, "--json", capsys=capsys)[1])
    wear = document["trends"]["X"]["Cd/K"]
    assert wear["low"] > 0
    (change,) = document["changes"]["X"]
    assert change["cause"] == "a changed load"
    assert list(change["parameters"]) == ["Jt/K"]


def test_ratios_are_shown_without_published_sets(history_without_voltage: Path, capsys: Any, tmp_path: Path) -> None:
    plot = tmp_path / "ratios.png"
    shown = fdhil("history", history_without_voltage, "--plot", plot, capsys=capsys)[1]
    assert "Cd/K A" in shown
    assert "a changed load" in shown
    assert plot.stat().st_size > 10_000


def test_data_sheet_values_have_no_trend(tmp_path: Path, capsys: Any) -> None:
    path = tmp_path / "machine.toml"
    path.write_text(BENCH)
    machine = config_of(tmp_path, ("X",))
    with History.open(machine.store.directory) as history:
        for day, window in enumerate(find_noisy_windows(0.003, moves=4)):
            analysed = analyse_window(replace(window, voltage_v=None), Identification(), machine.axis["X"], 0.001)
            assert analysed.verdict.accepted, analysed.verdict
            history.add_window(analysed, "", TimeStamp(START_S + 86_400.0 * day, "boot", window.start_tick))
    document = json.loads(fdhil("history", path, "--json", capsys=capsys)[1])
    assert {"Jt", "ft", "Cd"} <= set(document["trends"]["X"])
    assert not {"R", "L", "K"} & set(document["trends"]["X"])
