"""The soak's evaluation: conclusions on growth follow from the samples; insufficient data is reported."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from studies import soak
from studies.pages import convert_to_json
from studies.soak_life import EVENTS, RAPIDS, RESTARTS
from studies.usage import BLOCKS, fit_slope, measure_usage

RUN = {"command": "python -m studies.soak", "date": "2026-01-01", "commit": "0123456", "versions": "", "seeds": "1"}


def test_slope_is_found_only_where_present() -> None:
    rng = np.random.default_rng(1)
    time, held, seen = np.arange(400.0), {0.0: 0, 0.01: 0}, 0
    for grows in held:
        for _ in range(200):
            found = fit_slope(time, 5 + grows * time + rng.normal(0, 0.5, 400))
            assert found is not None
            held[grows] += found.low < grows < found.high
            seen += grows > 0 and found.low > 0
    assert all(180 <= count <= 198 for count in held.values()), held
    assert seen == 200
    assert fit_slope(time[: 2 * BLOCKS - 1], time[: 2 * BLOCKS - 1]) is None
    assert fit_slope(np.ones(100), time[:100]) is None


@pytest.mark.usefixtures("processes")
@pytest.mark.fault("F10")
def test_process_usage_is_measured_from_outside() -> None:
    script = """
import os, socket, subprocess, sys, threading
print("before", flush=True); sys.stdin.readline()
block, ends, over = bytearray(os.urandom(1) * 30_000_000), socket.socketpair(), threading.Event()
threading.Thread(target=over.wait, daemon=True).start()
child = subprocess.Popen(["true"])
os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)  # it has ended, and is not waited for
print("after", flush=True); sys.stdin.readline()
"""
    with subprocess.Popen([sys.executable, "-c", script], stdin=-1, stdout=-1, text=True) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        process.stdout.readline()
        before = measure_usage(process.pid)
        process.stdin.write("\n")
        process.stdin.flush()
        process.stdout.readline()
        after = measure_usage(process.pid)
        process.stdin.close()
    assert 28 < after.resident_mb - before.resident_mb < 40
    assert (after.descriptors - before.descriptors, after.threads - before.threads) == (2, 1)
    assert (after.children, after.zombies) == (1, 1)


def build_samples(folder: Path, grown_mb: float, rounds: int, hour_s: float, emergencies: int) -> None:
    """Write a run in which the guard grows by this amount per round, and the daemon was restarted early."""
    folder.mkdir()
    (folder / "run.json").write_text(json.dumps(RUN))
    with (folder / "samples.jsonl").open("w") as file:
        for k in range(1, rounds + 1):
            process: dict[str, Any] = {}
            for pid, name in enumerate((*soak.OURS, "machine")):
                resident = 50 + (grown_mb * k if name == "guard" else 0) + (20 if k < 5 else 0)
                figures = {"resident_mb": resident, "anonymous_mb": 1, "descriptors": 9, "threads": 2}
                process[name] = {"pid": pid + 100 * (k < 5), "children": 0, "zombies": 0, **figures}
            sample = {
                "at_s": k * hour_s, "round": k, "process": process, "store_mb": {"history.sqlite": 0.1 * k},
                "log_mb": {}, "happened": {"emergencies": emergencies}, "failed": {}, "restarts": {}, "dropped": {},
            }  # fmt: skip
            file.write(json.dumps(sample) + "\n")


@pytest.mark.parametrize(
    ("grown_mb", "rounds", "emergencies", "met"),
    [
        (0.0, 252, 600_000, True),
        (0.1, 252, 600_000, False),  # 3.6 MB in a day's work
        (0.0, 200, 600_000, False),  # less than a week
        (0.0, 252, 400_000, False),
    ],
)
def test_goal_is_met_without_growth_over_required_time(
    grown_mb: float, rounds: int, emergencies: int, met: bool, tmp_path: Path
) -> None:
    build_samples(tmp_path / "week", grown_mb, rounds, 4.0, emergencies)
    build_samples(tmp_path / "hours", 0.0, 300, 120.0, emergencies)
    week, hours = (
        soak.compute_figures(tmp_path / "week", per_day=False),
        [soak.compute_figures(tmp_path / "hours", per_day=True)],
    )
    assert week["processes"]["guard"]["samples"] == (rounds - 4) - (rounds - 4) // 2
    assert soak.evaluate_goal(week, hours)["met"] is met
    figures = convert_to_json({"week": week, "hours": hours, "goals": {"R13": soak.evaluate_goal(week, hours)}})
    page = soak.page(RUN, figures)
    assert ("**Met**" if met else "**Not met**") in page
    assert f"{rounds * RAPIDS:,} rapids" in page


def test_goal_is_not_met_without_real_hours(tmp_path: Path) -> None:
    build_samples(tmp_path / "week", 0.0, 252, 4.0, 1_000_000)
    reported = soak.evaluate_goal(soak.compute_figures(tmp_path / "week", per_day=False), [])
    assert not reported["met"]
    assert "0 of 8 real hours" in reported["figure"]


def test_real_hours_are_added_and_must_not_grow(tmp_path: Path) -> None:
    build_samples(tmp_path / "week", 0.0, 252, 4.0, 1_000_000)
    build_samples(tmp_path / "flat", 0.0, 300, 48.0, 0)
    build_samples(tmp_path / "grows", 0.1, 300, 48.0, 0)
    week = soak.compute_figures(tmp_path / "week", per_day=False)
    flat, grows = (soak.compute_figures(tmp_path / name, per_day=True) for name in ("flat", "grows"))
    assert not soak.evaluate_goal(week, [flat])["met"]
    assert soak.evaluate_goal(week, [flat, flat])["met"]
    assert not soak.evaluate_goal(week, [flat, grows])["met"]
    assert "### Run 2" in soak.page(
        RUN, convert_to_json({"week": week, "hours": [flat, flat], "goals": {"R13": soak.evaluate_goal(week, [])}})
    )


def test_week_has_million_emergencies_and_every_event() -> None:
    rounds = 7 * soak.A_DAY // RAPIDS
    assert rounds * RAPIDS == 7 * soak.A_DAY
    restarting = int(soak.RESTARTING * rounds)
    for name, event in {**EVENTS, **RESTARTS}.items():
        last = restarting if name in RESTARTS else rounds
        assert last >= event.every // 2 + event.every * (name not in EVENTS), name
