"""``fdhil history``: slopes over temperature and time, changes with causes, maintenance dates."""

from __future__ import annotations

import html
import json
import re
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.records import PARAMETERS, Notice, freeze_array
from fdhil.store.history_database import History
from fdhil.store.history_rows import Acknowledgement, TimeStamp
from tests.daemon.machine_rig import BENCH, fdhil
from tests.daemon.simulated_machine import config_of
from tests.store.sample_records import make_outcome, make_published, make_window

START_S = 1_800_000_000.0
DAYS = 60
STEP_DAY = 40
STDS = np.array([0.0005, 1e-5, 0.0002, 0.00005, 0.0005, 0.08])
WEAR_PER_DAY = 0.0005  # of ft, N.m.s
PER_KELVIN = -0.25  # of Cd, N.m


@pytest.fixture(scope="module")
def worn_history(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A machine with wearing ft, temperature-dependent Cd, and a table load added on day 40."""
    tmp_path = tmp_path_factory.mktemp("worn")
    path = tmp_path / "machine.toml"
    path.write_text(BENCH)
    rng = np.random.default_rng(3)
    with History.open(config_of(tmp_path, ("X", "Y")).store.directory) as history:
        for k in range(2 * DAYS):
            day = k / 2
            celsius = 22 + 2 * np.sin(k) + 0.01 * day
            made = make_outcome(of=make_window(temperature_c=float(celsius)))
            assert made.estimate is not None
            values = made.estimate.values + STDS * rng.standard_normal(6)
            values[4] += WEAR_PER_DAY * day
            values[5] += PER_KELVIN * (celsius - 22)
            values[3] *= 1.13 if day >= STEP_DAY else 1.0
            estimate = replace(made.estimate, values=freeze_array(values), covariance=freeze_array(np.diag(STDS**2)))
            stamp = TimeStamp(START_S + 86_400 * day, "boot", k)
            number = history.add_window(replace(made, estimate=estimate), "", stamp)
            parameters = replace(make_published(1).parameters, **dict(zip(PARAMETERS, values.tolist(), strict=True)))
            history.add_revision(replace(make_published(k + 1), parameters=parameters), [number], stamp)
    return path


def _count_days(date: str) -> float:
    return (datetime.fromisoformat(date) - datetime.fromtimestamp(START_S, UTC)).total_seconds() / 86_400


def test_slopes_separate_wear_and_temperature(worn_history: Path, capsys: Any) -> None:
    document = json.loads(fdhil("history", worn_history, "--json", capsys=capsys)[1])
    wear, warming = document["trends"]["X"]["ft"], document["slopes"]["X"]["Cd"]
    assert wear["low"] <= WEAR_PER_DAY <= wear["high"]
    assert wear["per_day"] == pytest.approx(WEAR_PER_DAY, rel=0.05)
    assert wear["at_constant_temperature"]
    assert warming["low"] <= PER_KELVIN <= warming["high"]
    assert warming["per_kelvin"] == pytest.approx(PER_KELVIN, rel=0.1)
    steady = document["trends"]["X"]["Cd"]
    assert steady["low"] <= 0 <= steady["high"]


def test_load_change_is_detected_and_named(worn_history: Path, capsys: Any) -> None:
    document = json.loads(fdhil("history", worn_history, "--json", capsys=capsys)[1])
    (change,) = document["changes"]["X"]
    assert _count_days(change["time"]) == pytest.approx(STEP_DAY, abs=0.6)
    assert change["cause"] == "a changed load"
    reported = change["parameters"]["Jt"]
    assert (reported["before"], reported["after"]) == (pytest.approx(0.075, rel=2e-3), pytest.approx(0.08475, rel=2e-3))
    # the trend of Jt restarts at the step, which is not wear
    assert _count_days(document["trends"]["X"]["Jt"]["since"]) == pytest.approx(STEP_DAY, abs=0.6)
    assert document["trends"]["X"]["Jt"]["low"] <= 0 <= document["trends"]["X"]["Jt"]["high"]


def test_limit_date_has_interval(worn_history: Path, capsys: Any) -> None:
    document = json.loads(fdhil("history", worn_history, "--json", capsys=capsys)[1])
    (limit,) = [limit for name, limit in document["limits"]["X"].items() if name == "ft"]
    first = document["revisions"][0]["parameters"]["ft"]["value"]
    assert limit["limit"] == pytest.approx(2 * first)  # default limit
    due = (2 * first - 0.05) / WEAR_PER_DAY
    assert _count_days(limit["earliest"]) <= due <= _count_days(limit["latest"])
    assert _count_days(limit["date"]) == pytest.approx(due, rel=0.05)
    assert not limit["reached"]
    _, out, _ = fdhil("history", worn_history, capsys=capsys)
    assert f"on {limit['date'][:10]}" in out
    assert f"({limit['earliest'][:10]} to {limit['latest'][:10]})" in out
    assert "a changed load" in out


@pytest.mark.usefixtures("long_computation")
def test_plot_and_report_show_trends(worn_history: Path, tmp_path: Path, capsys: Any) -> None:
    plot = tmp_path / "plot.png"
    assert fdhil("history", worn_history, "--plot", plot, capsys=capsys)[::2] == (0, f"wrote {plot}\n")
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "plot.png").stat().st_size > 50_000
    assert fdhil("report", worn_history, "--out", tmp_path / "report.html", capsys=capsys)[0] == 0
    page = (tmp_path / "report.html").read_text()
    for words in ("Slopes since the last change", "a changed load", "maintenance limit"):
        assert words in page


@pytest.mark.usefixtures("long_computation")
def test_report_starts_with_condition_of_drives(worn_history: Path, tmp_path: Path, capsys: Any) -> None:
    document = json.loads(fdhil("history", worn_history, "--json", capsys=capsys)[1])
    assert fdhil("report", worn_history, "--out", tmp_path / "report.html", capsys=capsys)[0] == 0
    page = (tmp_path / "report.html").read_text()
    verdict, _, axis = page.partition("<h2>Axis X</h2>")
    limit = document["limits"]["X"]["ft"]
    assert f"ft will reach its limit of {1e3 * limit['limit']:.4g} mN·m·s about {limit['date'][:10]}" in verdict
    cells = re.findall(r"<tr><td[^>]*>Jt</td>(.*?)</tr>", verdict, re.S)
    assert "+13." in cells[0]
    assert "g·m²" in cells[0]
    assert [p for p in PARAMETERS if f"<figcaption>{p}, " not in axis] == []
    (inertia,) = re.findall(r"<figure>((?:(?!<figure>).)*)<figcaption>Jt, ", axis, re.S)
    reported = json.loads(html.unescape(re.findall(r"<metadata>(.*?)</metadata>", inertia, re.S)[0]))
    assert reported["panels"][0]["levels"] == [["nominal", 75]]
    assert [label for label, _ in reported["marks"]] == ["a changed load"]


def test_refused_rapids_are_in_report(tmp_path: Path, capsys: Any) -> None:
    path = tmp_path / "machine.toml"
    path.write_text(BENCH)
    with History.open(config_of(tmp_path, ("X", "Y")).store.directory) as history:
        for k in range(3):
            stamp = TimeStamp(START_S + 86_400 * k, "boot", k)
            history.add_window(make_outcome(accepted=False, of=make_window(axis="Y")), "", stamp)
            history.add_window(make_outcome(of=make_window(axis="X")), "", stamp)
    assert fdhil("report", path, "--out", tmp_path / "report.html", capsys=capsys)[0] == 0
    page = (tmp_path / "report.html").read_text()
    assert "None of 3 rapids was accepted, most often (3 ×) because of MissingStage(cruise): no plateau." in page
    assert "Refused rapids: 3 of 3" in page
    assert "<dt>axis Y</dt><dd>not identified</dd>" in page
    assert "<h2>Axis Y</h2>" in page


@pytest.mark.usefixtures("long_computation")
def test_long_history_gives_small_page(tmp_path: Path, capsys: Any) -> None:
    """With many rapids the plot shows the daily median and a percentile band."""
    path = tmp_path / "machine.toml"
    path.write_text(BENCH)
    rng = np.random.default_rng(1)
    made = make_outcome(of=make_window())
    assert made.estimate is not None
    with History.open(config_of(tmp_path, ("X", "Y")).store.directory) as history:
        for k in range(240):
            values = made.estimate.values * (1 + 0.01 * rng.standard_normal(6))
            estimate = replace(made.estimate, values=freeze_array(values))
            history.add_window(replace(made, estimate=estimate), "", TimeStamp(START_S + 7_200 * k, "boot", k))
    assert fdhil("report", path, "--out", tmp_path / "report.html", capsys=capsys)[0] == 0
    page = (tmp_path / "report.html").read_text()
    assert len(page) < 600_000
    reported = json.loads(html.unescape(re.findall(r"<metadata>(.*?)</metadata>", page, re.S)[0]))
    (median, *_) = reported["panels"][0]["traces"]
    assert median["label"].startswith("median of the day")
    assert len(median["y"]) == 21
    assert all(
        low < middle < high for low, middle, high in zip(median["low"], median["y"], median["high"], strict=True)
    )


def test_unknown_axis_is_refused(worn_history: Path, capsys: Any) -> None:
    """An unknown axis is a wrong option, not an empty history."""
    code, _, reported = fdhil("history", worn_history, "--axis", "Q", capsys=capsys)
    assert code == 2
    assert "has no axis Q" in reported


def test_tables_fit_80_columns_and_explain_intervals(worn_history: Path, capsys: Any) -> None:
    out = fdhil("history", worn_history, capsys=capsys)[1]
    assert max(map(len, out.splitlines())) <= 80
    assert "…" not in out
    assert out.count("half the width of the 95 % interval") == 2
    document = json.loads(fdhil("history", worn_history, "--json", capsys=capsys)[1])
    reported = document["revisions"][-1]["parameters"]["Jt"]
    (newest,) = (line for line in out.splitlines() if line.startswith("120 "))
    assert f"{1e3 * reported['value']:.0f}" in newest.split()
    half = (reported["high"] - reported["low"]) / 2
    assert f"±{1e3 * half:.0f}" in out.splitlines()[out.splitlines().index(newest) + 1].split()
    assert half == pytest.approx(1.96 * reported["std"], rel=1e-3)


def test_history_and_report_show_pending_and_acknowledged_notices(tmp_path: Path, capsys: Any) -> None:
    path = tmp_path / "machine.toml"
    path.write_text(BENCH)
    with History.open(config_of(tmp_path).store.directory) as history:
        for k, text in enumerate(("the bus was gone", "the bus was gone again")):
            history.add_notice(Notice("BusDown", "MAJOR", text), TimeStamp(START_S + k, "boot", k))
        history.add_notice(Notice("BusDown", "info", "the bus is back"), TimeStamp(START_S + 9, "boot", 9))
        history.add_acknowledgement(Acknowledgement((1,), "anna", "plug", TimeStamp(START_S + 60, "boot", 60)))
    out = fdhil("history", path, capsys=capsys)[1]
    assert "pending notices (see fdhil acknowledge): 1" in out
    assert "acknowledged by anna" in out
    assert "the bus is back" not in out
    reported = json.loads(fdhil("history", path, "--json", capsys=capsys)[1])["notices"]
    assert [notice["acknowledged"] and notice["acknowledged"]["who"] for notice in reported] == ["anna", None]
    assert fdhil("report", path, "--out", tmp_path / "report.html", capsys=capsys)[0] == 0
    page = (tmp_path / "report.html").read_text("utf-8")
    assert "the bus was gone again" in page
    assert re.search(r"anna, 2027-01-15 \d\d:\d\d: plug", page)
