"""Services: effect with interval, restart of age and limits, forecast of due limits."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.fleet.axis_services import estimate_step
from fdhil.fleet.parameter_sets import fetch_newest_sets, open_read_only
from fdhil.records import Float
from tests.daemon.machine_rig import fdhil
from tests.fleet.fleet_database import build_fleet, spread_over_days, store_records
from tests.fleet.recording_machine import RecordingMachine, write_history
from tests.fleet.servers import Postgres

BEGIN = datetime(2026, 3, 1, tzinfo=UTC)
DAYS = 40
SERVICED = 20


def test_interval_of_change_has_95_percent_coverage() -> None:
    """With continuing wear and a varying temperature."""
    rng = np.random.default_rng(1)
    days: Float = np.arange(20.0) - 11.5
    held = 0
    for _ in range(400):
        at_c = rng.uniform(15, 35, 20)
        values = 1.0 - 0.3 * (days > 0) + 0.02 * days - 0.01 * at_c + 0.05 * rng.normal(size=20)
        step = estimate_step(values, np.full(20, 0.01), days, at_c)
        held += bool(abs(step.size + 0.3) < 2.12 * step.std)  # Student's t of 16
        assert (step.freedom, step.at_constant_temperature) == (16, True)
    assert 366 <= held <= 392  # 380 expected, +- 3 standard deviations


def test_unknown_temperature_is_not_separated() -> None:
    days, unknown = np.array([-3.0, -2.0, -1.0, 1.0, 2.0, 3.0]), np.full(6, np.nan)
    values = np.array([1.0, 1.1, 0.9, 2.0, 2.1, 1.9])
    step = estimate_step(values, np.full(6, 0.01), days, unknown)
    assert (step.before, step.size) == pytest.approx((1.0, 1.0))
    assert not step.at_constant_temperature
    assert estimate_step(values, np.full(6, 0.5), days, unknown).std > step.std  # as their own deviations promise


@pytest.fixture
async def fleet_settings(database: Postgres, tmp_path: Path) -> Path:
    """A machine whose X axis gets 1 % stiffer per day until it is lubricated, and then again."""
    machine = RecordingMachine(write_history(tmp_path / "mill", "mill-1"))
    for day in range(DAYS):
        since = day if day < SERVICED else day - SERVICED
        machine.record_windows(1, axes=("X",), parameters={"ft": 0.05 * (1 + 0.01 * since + 0.002 * (-1) ** day)})
    machine.close_store()
    await store_records(build_fleet(database, tmp_path), spread_over_days(machine, BEGIN))
    file = tmp_path / "fleet.toml"
    file.write_text(f'[database]\nconnection = "{database.connection}"\n')
    return file


@pytest.fixture
def asked(fleet_settings: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    def ask(*words: str) -> tuple[int, str]:
        code, out, err = fdhil("fleet", words[0], str(fleet_settings), *words[1:], capsys=capsys)
        return code, out or err

    return ask


@pytest.mark.debian
async def test_service_is_recorded_with_its_changes(
    asked: Callable[..., tuple[int, str]], database: Postgres, tmp_path: Path
) -> None:
    assert "no service recorded yet" in asked("services")[1]
    assert query_due(asked) == []  # as far as is known it rises and falls
    day = (BEGIN + timedelta(days=SERVICED)).date().isoformat()
    words = ("--machine", "mill-1", "--axis", "X", "--date", day)
    code, text = asked("service", *words, "--note", "lubricated")
    assert (code, "age and limits count from then" in text) == (0, True)
    code, out = asked("services", "--json")
    (reported,) = json.loads(out)["services"]
    change = next(each for each in reported["changes"] if each["parameter"] == "ft")
    assert change["low"] < -0.01 < change["high"] < 0.0  # 20 % of 0.05
    assert change["before"] == pytest.approx(0.06, rel=0.01)
    assert change["sure"]
    assert not next(each for each in reported["changes"] if each["parameter"] == "R")["sure"]
    assert f"{day}T00:00:00+00:00  mill-1 axis X  lubricated" in asked("services")[1]

    with open_read_only(build_fleet(database, tmp_path)) as db:
        rows = fetch_newest_sets(db, 100, [("mill-1", "X")])["mill-1", "X"]
    assert [row["at"] for row in rows] == [BEGIN + timedelta(days=k) for k in range(SERVICED, DAYS)]
    (since,) = query_due(asked)
    reached = datetime.fromisoformat(since["date"]) - BEGIN
    assert reached / timedelta(days=1) == pytest.approx(SERVICED + 100, abs=4)  # 1 % a day
    assert since["earliest"] < since["date"] < since["latest"]
    assert "mill-1 axis X: ft = " in asked("status")[1]

    code, text = asked("service", *words, "--remove")
    assert (code, "deleted" in text) == (0, True)
    assert asked("service", *words, "--remove")[0] == 3


def query_due(asked: Callable[..., tuple[int, str]]) -> list[dict[str, Any]]:
    found = json.loads(asked("status", "--json")[1])["due"]
    return [each for each in found if each["parameter"] == "ft"]


@pytest.mark.debian
def test_unknown_axis_cannot_be_serviced(asked: Callable[..., tuple[int, str]]) -> None:
    code, text = asked("service", "--machine", "mill-1", "--axis", "Q")
    assert (code, "axis Q of mill-1 were collected" in text) == (3, True)
    assert "see fdhil fleet status" in text
