"""``fdhil predict`` as called by another program."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from fdhil.cli.history_forecast import format_crossing
from fdhil.cli.main import cli, run_safely
from fdhil.errors import StoreError
from fdhil.program import write_demand_csv
from fdhil.records import Parameters, ParameterSet, freeze_array
from fdhil.store.history_database import History
from fdhil.store.history_rows import TimeStamp
from tests.bench import bench_toml
from tests.paths import build_bench_trajectory


@pytest.fixture(name="bench")
def _bench(tmp_path: Path) -> Path:
    (tmp_path / "bench.toml").write_text(bench_toml())
    write_demand_csv(build_bench_trajectory(10), tmp_path / "demand.csv")
    return tmp_path


def run_cli(*arguments: object) -> Result:
    codes: list[int] = []
    runner = CliRunner()
    with runner.isolation() as streams:
        import sys

        sys.argv = ["fdhil", *map(str, arguments)]
        codes.append(run_safely(cli))
        out, err = streams[0].getvalue(), streams[1].getvalue()
    return Result(runner, out, err, out + err, None, codes[0], None)


def test_predict_writes_json_and_csv(bench: Path) -> None:
    out = bench / "out.csv"
    result = run_cli("predict", bench / "demand.csv", "--config", bench / "bench.toml", "--json", "--out", out)
    assert result.exit_code == 0
    document = json.loads(result.stdout)
    assert document["contour"]["rms_um"] == pytest.approx(24.2, rel=0.02)
    assert set(document["axes"]["X"]) == {"rms_error_um", "max_error_um"}
    assert set(document["zones"][0]) == {"start_s", "end_s", "where", "line", "max_um", "cause"}
    assert document["duration_s"] == pytest.approx(3.09, abs=0.01)
    with out.open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [
        "time_s",
        *(f"{axis}_{name}" for axis in "XY" for name in ("reference_mm", "predicted_mm", "error_um")),
        "contour_error_um",
    ]
    assert len(rows) == len(build_bench_trajectory(10).time_s)
    largest = max(float(row["contour_error_um"]) for row in rows)
    assert largest == pytest.approx(document["contour"]["max_um"], abs=1e-3)
    assert len(rows[0]["X_reference_mm"].split(".")[1]) >= 6


def test_predict_prints_text(bench: Path) -> None:
    result = run_cli("predict", bench / "demand.csv", "--config", bench / "bench.toml")
    assert "24.2 um RMS" in result.stdout
    assert "corner" in result.stdout


def test_path_duration_excludes_start_time(bench: Path) -> None:
    """The duration does not depend on the start time of the demand."""
    names, *rows = (bench / "demand.csv").read_text().splitlines()
    shifted = [f"{float(t) + 1.7e9:.6f},{rest}" for t, _, rest in (row.partition(",") for row in rows)]
    (bench / "later.csv").write_text("".join(f"{line}\n" for line in [names, *shifted]))
    assert run_cli("predict", bench / "later.csv", "--config", bench / "bench.toml").stdout.startswith("3.09 s of path")


def test_sensitivity_names_parameter(bench: Path) -> None:
    arguments = ["predict", bench / "demand.csv", "--config", bench / "bench.toml", "--sensitivity"]
    document = json.loads(run_cli(*arguments, "--json").stdout)
    assert set(document["zones"][0]["um_per_percent"]["X"]) == {"R", "L", "K", "Jt", "ft", "Cd"}
    assert "1 % more" in run_cli(*arguments).stdout


def test_history_provides_parameters_with_uncertainty(bench: Path) -> None:
    values = {"R": 0.5, "L": 0.005, "K": 0.8, "Jt": 0.085, "ft": 0.05, "Cd": 5.0}
    covariance = np.diag([(0.003 * value) ** 2 for value in values.values()])
    with History.open(bench / "fdhil-data") as history:
        for axis in "XY":
            published = ParameterSet(
                axis, 1, Parameters.from_mapping(values), freeze_array(covariance), 3, 0, None, "digest"
            )
            history.add_revision(published, [], TimeStamp(0.0, "boot", 0))
    out = bench / "out.csv"
    arguments = ["--config", bench / "bench.toml", "--from-history", "--json", "--out", out]
    result = run_cli("predict", bench / "demand.csv", *arguments)
    assert result.exit_code == 0, result.stderr
    assert 0.1 < json.loads(result.stdout)["contour"]["max_std_um"] < 10
    with out.open() as file:
        assert max(float(row["contour_std_um"]) for row in csv.DictReader(file)) > 0.1


def store_parameters(folder: Path, revisions: list[dict[str, float]], known_to: float = 0.003) -> None:
    """Store equal daily revisions of X and Y, with some values other than nominal."""
    for number, changed in enumerate(revisions, 1):
        for axis in "XY":
            publish_revision(folder, axis, number, known_to, **changed)


def publish_revision(
    folder: Path, axis: str, number: int, known_to: float = 0.003, *, days: float | None = None, **changed: float
) -> None:
    """Store another revision of an axis with relative standard deviations, one per day or ``days`` after the epoch."""
    nominal = {"R": 0.5, "L": 0.005, "K": 0.8, "Jt": 0.075, "ft": 0.05, "Cd": 5.0}
    covariance = np.diag([(known_to * value) ** 2 for value in nominal.values()])
    with History.open(folder / "fdhil-data") as history:
        known = ParameterSet(
            axis, number, Parameters.from_mapping(nominal | changed), freeze_array(covariance), 3, 0, None, "digest"
        )
        history.add_revision(known, [], TimeStamp(86400.0 * (number if days is None else days), "boot", 0))


def test_inertia_step_is_reported_with_cost(bench: Path) -> None:
    """The cost is that since the last step or since --since; an unknown revision is refused."""
    store_parameters(bench, [{}, {}, {"Jt": 0.085}, {"Jt": 0.085}])
    program = bench / "corner.ngc"
    program.write_text("G21 G90 G64\nG1 X0 Y30 F10000\nG1 X40\nM2\n")
    arguments = ["predict", program, "--config", bench / "bench.toml", "--from-history"]
    steps = json.loads(run_cli(*arguments, "--json").stdout)["steps"]
    assert {(step["axis"], step["what"], step["since_revision"]) for step in steps} >= {("X", "inertia", 2)}
    assert steps[0]["line"] == 3
    assert steps[0]["parameters"] == {"Jt": {"before": 0.075, "now": 0.085}}
    assert "changed since revision 2 (Jt 0.075 -> 0.085): it costs" in run_cli(*arguments).stdout
    assert json.loads(run_cli(*arguments, "--since", 3, "--json").stdout)["steps"] == []
    assert run_cli(*arguments, "--since", 99).exit_code == 2
    assert run_cli("predict", program, "--config", bench / "bench.toml", "--since", 1).exit_code == 2


def test_next_prediction_reports_zone_changes(bench: Path) -> None:
    """A fixture on X changes zones and parameter; a repetition reports the same, another program nothing."""
    program = bench / "corner.ngc"
    program.write_text("G21 G90 G64\nG1 X0 Y30 F10000\nG1 X40\nG1 Y60\nM2\n")
    arguments = ["predict", program, "--config", bench / "bench.toml", "--from-history"]
    store_parameters(bench, [{}])
    first = json.loads(run_cli(*arguments, "--json").stdout)
    assert first["compared"] is None
    assert "since this program" not in run_cli(*arguments).stdout
    publish_revision(bench, "X", 2, Jt=0.085, L=0.00501)
    for _ in range(2):
        document = json.loads(run_cli(*arguments, "--json").stdout)
        found = document["compared"]
        assert found["revisions"] == {"X": 1, "Y": 1}
        assert found["configuration_changed"] is False
        zone = max(found["zones"], key=lambda zone: abs(zone["change_um"]))
        assert zone["line"] in (3, 4)
        assert zone["change_um"] > 5
        cause, other = zone["by"]
        assert (cause["axis"], cause["parameter"], cause["before"], cause["now"]) == ("X", "Jt", 0.075, 0.085)
        assert cause["um"] == pytest.approx(zone["change_um"], abs=0.2)
        assert abs(other["um"]) < 0.1
        assert 0 < zone["std_um"] < 5
        reported = {z["where"]: z["max_um"] for z in first["zones"]}
        assert any(z["before_um"] == pytest.approx(reported.get(z["where"], -1.0)) for z in found["zones"])
        assert found["rms_um"]["before"] == pytest.approx(first["contour"]["rms_um"])
    text = run_cli(*arguments).stdout
    assert "since this program was predicted on 20" in text
    assert "by Jt of axis X, 0.075 -> 0.085" in text
    program.write_text(program.read_text() + "(another program)\n")
    assert json.loads(run_cli(*arguments, "--json").stdout)["compared"] is None


def test_changed_configuration_is_separated_from_drive_changes(bench: Path) -> None:
    """A lower position gain is not attributed to a parameter; without a change nothing is reported."""
    store_parameters(bench, [{}])
    config = bench / "bench.toml"
    arguments = ["predict", bench / "demand.csv", "--config", config, "--from-history"]
    run_cli(*arguments)
    publish_revision(bench, "X", 2, Cd=5.0001)
    assert "no significant change since" in run_cli(*arguments).stdout
    config.write_text(config.read_text().replace("position_gain_per_s = 50.0", "position_gain_per_s = 40.0"))
    found = json.loads(run_cli(*arguments, "--json").stdout)["compared"]
    assert found["configuration_changed"] is True
    largest = max(found["zones"], key=lambda zone: abs(zone["change_um"]))
    assert largest["settings_um"] == pytest.approx(largest["change_um"], abs=0.1)
    assert abs(largest["change_um"]) > 5
    assert "by the configuration" in run_cli(*arguments).stdout


def test_full_store_gives_warning(bench: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store_parameters(bench, [{}])

    def full(_directory: Path) -> History:
        raise StoreError("the disk is full", "DiskFull")

    monkeypatch.setattr(History, "open", full)
    result = run_cli("predict", bench / "demand.csv", "--config", bench / "bench.toml", "--from-history", "--json")
    assert result.exit_code == 0
    assert "not stored for later comparison: the disk is full" in result.stderr
    assert json.loads(result.stdout)["compared"] is None


def test_history_forecasts_tolerance_crossing(bench: Path) -> None:
    """Jt rises by 0.2 % per day: corners exceed 105 um within weeks, the largest exceed 98 um already."""
    store_parameters(bench, [{"Jt": 0.075 * (1 + 0.002 * (day - 20))} for day in range(21)])
    arguments = ["predict", bench / "demand.csv", "--config", bench / "bench.toml", "--from-history"]
    document = json.loads(run_cli(*arguments, "--tolerance-um", 105, "--json").stdout)
    corners = [zone["crosses"] for zone in document["zones"] if zone["max_um"] > 90]
    assert corners
    for crosses in corners:
        assert crosses["state"] == "foreseen"
        assert 3 < crosses["in_days"] < 100
        assert "1970-01-22" < crosses["earliest"] <= crosses["date"] <= crosses["latest"]
        assert crosses["parameter"] == "Jt"
    assert all(zone["std_um"] >= 0 for zone in document["zones"])
    text = run_cli(*arguments, "--tolerance-um", 98).stdout
    assert "exceeds 98 um now" in text
    assert "has probably exceeded 98 um since 1970-" in text  # the newest parameters are from January 1970


@pytest.mark.parametrize(
    ("days", "state", "words"),
    [(6 / 1440, "not_enough_history", "6 min of history are too short"), (3.0, "not_foreseen", "within 15 days")],
)
def test_no_date_is_forecast_beyond_history(bench: Path, days: float, state: str, words: str) -> None:
    """An exact slope over six minutes or three days does not permit a forecast of weeks."""
    for number in range(1, 13):
        at = 20.0 + days * (number - 1) / 11
        for axis in "XY":
            publish_revision(bench, axis, number, days=at, Jt=0.075 * (1 + 0.002 * min(1.0, days) * number / 12))
    arguments = ["predict", bench / "demand.csv", "--config", bench / "bench.toml", "--from-history"]
    document = json.loads(run_cli(*arguments, "--tolerance-um", 105, "--json").stdout)
    assert {zone["crosses"]["state"] for zone in document["zones"]} == {state}
    text = run_cli(*arguments, "--tolerance-um", 105).stdout
    assert words in text
    assert "about 19" not in text


def test_past_crossing_date_is_reported_as_past() -> None:
    """The forecast date can be earlier than today."""
    entry = {"state": "foreseen", "date": "2999-01-02", "earliest": "2999-01-01", "latest": None}
    entry |= {"axis": "X", "parameter": "Jt"}
    assert format_crossing(entry, 20.0).startswith("is expected to exceed 20 um about 2999-01-02 (2999-01-01 to later)")
    past = format_crossing(entry | {"date": "2001-01-02"}, 20.0)
    assert past.startswith("has probably exceeded 20 um since 2001-01-02")
    assert past.endswith("identify again")


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["demand.csv", "--config", "missing.toml"], 2, "cannot be read"),
        (["missing.csv", "--config", "bench.toml"], 3, "cannot be read"),
        (["demand.csv", "--config", "bench.toml", "--model", "missing.json"], 2, "cannot be read"),
        (["demand.csv", "--config", "bench.toml", "--model", "x.json"], 2, "Y: moves and has no model"),
        (["demand.csv", "--config", "bench.toml", "--model", "bad.json"], 2, "must be above 0"),
        (["demand.csv", "--config", "bench.toml", "--from-history"], 2, "moves and has no model"),
        (["demand.csv", "--config", "bench.toml", "--from-history", "--model", "x.json"], 2, "exclude each other"),
        (["demand.csv", "--config", "bench.toml", "--out", "no/such/folder.csv"], 3, "cannot be written"),
        (["demand.csv"], 2, "name the configuration"),
    ],
)
def test_error_is_one_sentence(
    bench: Path, arguments: list[str], code: int, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(bench)
    good = {"R": 0.5, "L": 0.005, "K": 0.8, "Jt": 0.075, "ft": 0.05, "Cd": 5.0}
    (bench / "x.json").write_text(json.dumps({"X": good}))
    (bench / "bad.json").write_text(json.dumps({"X": good, "Y": good | {"R": 0}}))
    result = run_cli("predict", *arguments)
    assert result.exit_code == code
    assert message in result.stderr
    assert "Traceback" not in result.stderr


def test_probe_runs_at_feed_and_ambiguous_number_gives_note(bench: Path) -> None:
    """The probe move of 20 mm at 300 mm/min takes 4 s."""
    program = bench / "probe.ngc"
    program.write_text("G0 X0 Y0\nG38.2 X20 F300\nG0 X25\nG4 P61\nM2\n")
    result = run_cli("predict", program, "--config", bench / "bench.toml", "--json")
    document = json.loads(result.stdout)
    assert document["duration_s"] - 61.0 == pytest.approx(4.0 + 0.9, abs=0.4)
    assert [note["code"] for note in document["notes"]] == ["UnknownAfterProbe", "LongDwell"]
    shown = run_cli("predict", program, "--config", bench / "bench.toml")
    assert "note, LongDwell: line 4: the axes dwell for 61 s; P is read in seconds, as LinuxCNC does" in shown.stderr


def test_program_with_unconfigured_axis_is_refused(bench: Path) -> None:
    program = bench / "rotary.ngc"
    program.write_text("G0 X20 A45\nM2\n")
    for command in ("predict", "correct"):
        result = run_cli(command, program, "--config", bench / "bench.toml", "--json")
        assert result.exit_code == 3
        error = json.loads(result.stdout)["error"]
        assert (error["line"], error["word"]) == (1, "A")
        assert "moves axis A, which the configuration lacks" in error["text"]
