"""The real processes: the twin with its NC on a bus of its own, the daemon beside it, the command line against both."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from fdhil.cli.demo.processes import Process
from fdhil.drivers.commissioning import commission, save_record
from fdhil.errors import ConnectError
from fdhil.prediction import contour_error_um
from fdhil.store.history import History
from fdhil.store.windows import list_windows
from tests.daemon.shop import CORNER, REAL, SHUTTLE, Shop, fdhil, opened

pytestmark = pytest.mark.timeout(300)  # three processes, each of which compiles on the first run


@pytest.fixture
def shop(tmp_path: Path) -> Iterator[Shop]:
    """A twin whose table is heavier than the data sheet says."""
    with opened(tmp_path) as shop:
        yield shop


def test_from_the_bus_to_the_history_and_back(shop: Shop) -> None:
    with shop.daemon() as daemon:
        shop.nc_on()
        shop.play("shuttle.ngc", SHUTTLE)
        status = shop.status_when(lambda s: all(s["axes"][a]["accepted"] + s["axes"][a]["refused"] >= 4 for a in "XY"))
        second = Process("second daemon", ["fdhil", "run", str(shop.path)], shop.folder / "second.log")
        with pytest.raises(ConnectError, match="BusLocked"):
            second.event("ready", 60.0)
        assert second.stop() == 3
        assert daemon.stop() == 0
    log = (shop.folder / "daemon.log").read_text()
    assert log.splitlines()[-1] == "stopped, offset 0", log
    axis = status["axes"]["X"]
    assert (axis["accepted"], axis["refused"]) == (4, 0), log
    assert status["axes"]["Y"]["accepted"] == 4, log
    assert status["state"] == "OFF(SHADOW)"
    assert status["frames"]["received"] > 10_000
    assert status["sync"]["rate_hz"] > 0
    for name, true in REAL.items():
        told = axis["parameters"][name]
        assert told["value"] == pytest.approx(true, rel=0.02 if name not in {"ft", "Cd"} else 0.1), name
        assert told["low"] < told["high"]
    assert axis["skill"]["rms_um"] < 0.1 * axis["skill"]["measured_rms_um"]
    _replays_bit_by_bit(shop)
    _history_is_told(shop)


def _replays_bit_by_bit(shop: Shop) -> None:
    folder = shop.config.store.directory / "windows"
    files = [file.path for file in list_windows(folder).windows if file.axis == "X"]
    assert len(files) == 4
    replayed = fdhil("replay", "--config", shop.path, "--json", *files)
    assert replayed.returncode == 0, replayed.stderr
    document = json.loads(replayed.stdout)
    with History.read(shop.config.store.directory) as history:
        stored, revisions, skills = history.windows("X"), history.revisions("X"), history.skills("X")
    for file, window, revision, skill in zip(document["files"], stored, revisions, skills, strict=True):
        of = {outcome["kind"]: outcome for outcome in file["outcomes"]}
        unitless = {
            name: {key: value for key, value in told.items() if key != "unit"}
            for name, told in of["window"]["parameters"].items()
        }
        assert unitless == window.parameters
        assert of["window"]["fit_percent"] == window.fit_percent
        values = {name: told["value"] for name, told in of["parameters"]["parameters"].items()}
        assert values == revision.set.parameters.as_dict()
        assert of["skill"]["rms_um"] == skill.rms_um
    exported = fdhil("export", files[0], "--out", shop.folder / "window.csv")
    assert exported.returncode == 0, exported.stderr
    again = fdhil("replay", "--config", shop.path, "--json", shop.folder / "window.csv")
    assert json.loads(again.stdout)["validated"], again.stdout


def _history_is_told(shop: Shop) -> None:
    told = json.loads(fdhil("history", shop.path, "--json").stdout)
    assert [row["revision"] for row in told["revisions"] if row["axis"] == "Y"] == [1, 2, 3, 4]
    table = fdhil("history", shop.path)
    assert "axis X: 4 revisions" in table.stdout
    stopped = fdhil("status", shop.path)
    assert stopped.returncode == 3
    assert "is not running" in stopped.stderr


def test_a_program_is_armed_cut_and_disarmed_by_the_end_of_the_daemon(shop: Shop) -> None:
    for axis in shop.config.axis:
        save_record(commission(shop.config, axis), shop.config.store.directory)
    program = shop.folder / "corner.ngc"
    with shop.guard() as guard, shop.daemon() as daemon:
        program.write_text(CORNER)
        refused = fdhil("arm", shop.path, program)
        assert (refused.returncode, refused.stdout) == (1, "")
        assert "refused: ModelNotValidated" in refused.stderr
        shop.nc_on()
        shop.play("shuttle.ngc", SHUTTLE)
        shop.status_when(lambda s: all(s["axes"][axis]["accepted"] == 4 for axis in "XY"))
        plain = _cut(shop, "plain")
        armed = fdhil("arm", shop.path, program, "--json")
        answer = json.loads(armed.stdout)
        assert armed.returncode == 0, (armed.stdout, armed.stderr)
        assert answer["state"] == "ARMED"
        assert answer["after"]["rms_um"] < 0.2 * answer["before"]["rms_um"]
        status = shop.status_when(lambda s: s["state"] == "ARMED")
        assert status["armed"]["program"] == str(program)
        corrected = _cut(shop, "corrected")
        assert corrected < 0.2 * plain, (corrected, plain)
        shop.status_when(lambda s: s["state"] == "OFF" and s["armed"] is None)
        again = fdhil("arm", shop.path, program)
        assert again.returncode == 0, again.stderr
        assert daemon.stop() == 0  # disarms first
        assert guard.stop() == 0
    log = (shop.folder / "daemon.log").read_text()
    assert "GuardState: ARMED -> RAMPING" in log or "GuardState: ARMED -> ACTIVE" in log
    assert log.count("Armed: armed corner.ngc") == 2, log
    assert "ArmRefused: ModelNotValidated" in log
    assert log.splitlines()[-1] == "stopped, offset 0", log
    token = (shop.run_directory / "token").read_text()
    for file in (*shop.folder.glob("*.log"), *shop.config.store.directory.rglob("*.sqlite*")):
        assert token.encode() not in file.read_bytes(), file


def _cut(shop: Shop, name: str) -> float:
    """Let the NC cut the program; return the RMS of the contour error in um."""
    trace = shop.folder / f"{name}.csv"
    shop.play("corner.ngc", CORNER, trace=trace)
    rows = np.genfromtxt(trace, delimiter=",", names=True)
    reference = np.column_stack([rows[f"{axis}_reference_mm"] for axis in "XY"])
    table = np.column_stack([rows[f"{axis}_table_mm"] for axis in "XY"])
    return float(np.sqrt(np.mean(contour_error_um(reference, table, 1e-3) ** 2)))
