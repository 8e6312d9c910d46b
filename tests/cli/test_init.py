"""``fdhil init`` creates a valid configuration from answers, prompts, LinuxCNC files and drives."""

from __future__ import annotations

import io
import json
import threading
import tomllib
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import pytest

from fdhil import config as machine_config
from fdhil.cli.demo.toml_writer import format_toml
from fdhil.cli.main import cli, run_safely
from fdhil.config.config_template import write_filled_template
from fdhil.report.history_reader import group_by_axis
from tests.commissioning.test_linuxcnc_files import HAL_TEXT, INI, ROTARY_AND_GANTRY
from tests.drivers.frame_builder import build_machine_config
from tests.drivers.peer import DrivePeer
from tests.eds import write_eds
from tests.short_waits import shorten_waits

Said = Callable[..., tuple[int, str, str]]
ROOT = Path(__file__).parents[2]
SHEET: dict[str, Any] = {
    "nominal": {"R": 0.5, "L": 0.005, "K": 0.8, "Jt": 0.075},
    "regulators": {"voltage_limit_v": 300.0},
    "drive": {"profile": "fdhil_twin", "rated_current_a": 50.0},
}
RAPID = {"screw_pitch_mm": 20.0, "rapid_speed_mm_s": 500.0, "max_acceleration_mm_s2": 4000.0}


@pytest.fixture
def run_init(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Said:
    """Run a command in this process with ``said`` on standard input; return exit code, stdout and stderr."""
    monkeypatch.setattr("fdhil.cli.init_command.INTERFACES", Path("no interfaces"))
    shorten_waits(monkeypatch, {"commissioning.scan.ANSWER_S": 1.0, "drivers.can.sdo_channel.RESPONSE_TIMEOUT_S": 0.2})

    def run(*arguments: object, said: str = "") -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["fdhil", *map(str, arguments)])
        monkeypatch.setattr("sys.stdin", io.StringIO(said))
        code = run_safely(cli)
        out, err = capsys.readouterr()
        return code, out, err

    return run


@pytest.fixture
def bus() -> dict[str, Any]:
    return {"can0": {"interface": "virtual", "channel": uuid.uuid4().hex}}


@pytest.fixture
def peer(virtual_threads: object, bus: dict[str, Any]) -> Iterator[DrivePeer]:
    with DrivePeer(build_machine_config(bus=bus["can0"])) as running:
        yield running


def read_written_config(folder: Path, **tables: Any) -> Path:
    path = folder / "answers.toml"
    path.write_text(format_toml(tables))
    return path


def test_linuxcnc_files_and_few_answers_create_config(run_init: Said, tmp_path: Path) -> None:
    (tmp_path / "mill.ini").write_text(INI.replace("X Y Z", "X Y").replace("No 3", "No 3 \x07"))
    (tmp_path / "drives.hal").write_text(HAL_TEXT)
    sheet = SHEET | {"screw_pitch_mm": 10.0}
    answers = read_written_config(tmp_path, axis={"X": sheet | {"correction": {"max_offset_um": 40.0}}, "Y": sheet})
    file = tmp_path / "mill.toml"
    arguments = ("init", file, "--from-linuxcnc", tmp_path / "mill.ini", "--answers", answers, "--offline")
    code, out, err = run_init(*arguments)
    assert code == 0, err
    assert "next: fdhil doctor" in out
    assert "  check nominal.Cd of axis.X, axis.Y = 2.0: guessed: 5 % of the continuous torque" in out
    made = machine_config.load_config(file)
    x, y = made.axis["X"], made.axis["Y"]
    assert (made.machine.name.strip(), made.machine.sync_period_s, made.nc.profile) == ("Mill No 3", 0.002, "linuxcnc")
    assert (x.rapid_speed_mm_s, x.drive.increments_per_rev, x.drive.sign) == (400.0, 10000, 1)
    assert {"Cd", "ft"} <= set(x.guessed)
    assert "R" not in x.guessed
    known = [history.nominal for history in group_by_axis(made, [], {}, ["X"])]
    assert known == [{name: value for name, value in x.nominal.model_dump().items() if name not in x.guessed}]
    assert (y.drive.increments_per_rev, y.drive.sign) == (8192, -1)
    assert (x.correction is not None, y.correction is not None) == (True, False)
    text = file.read_text()
    assert "rapid_speed_mm_s = 400.0  # LinuxCNC: [TRAJ] MAX_LINEAR_VELOCITY" in text
    assert "# table travel per motor revolution" in text
    assert "R = 0.5  # from the answers" in text
    assert "Cd = 2.0  # guessed: 5 % of the continuous torque; the first rapids identify it" in text
    assert "/work" not in text


def test_rotary_axis_needs_radius_and_gantry_needs_two_node_ids(run_init: Said, tmp_path: Path) -> None:
    ini = ROTARY_AND_GANTRY.replace("[JOINT_2]", "[JOINT_2]\nSCALE = 819.2").replace("SCALE = 8192\n", "SCALE = 1000\n")
    (tmp_path / "mill.ini").write_text(ini)
    (tmp_path / "drives.hal").write_text(HAL_TEXT)
    sheet = SHEET | {"drive": SHEET["drive"] | {"increments_per_rev": 8192}}
    axes = {"X": sheet, "Y": sheet, "A": sheet | {"radius_mm": 120.0}}
    file = tmp_path / "mill.toml"
    arguments = ("init", file, "--from-linuxcnc", tmp_path / "mill.ini", "--offline", "--answers")
    code, _, err = run_init(*arguments, read_written_config(tmp_path, axis=axes | {"A": sheet}))
    assert code == 2
    assert "axis.A.radius_mm: is unknown: rotary axis: radius at which angles count" in err
    assert not file.exists()
    code, _, err = run_init(*arguments, read_written_config(tmp_path, axis=axes))
    assert code == 0, err
    made = machine_config.load_config(file)
    assert len({*map(made.get_node_id, made.axis)}) == 4
    assert (made.axis["Y"].drive.sign, made.axis["Y2"].drive.sign) == (-1, 1)
    a, text = made.axis["A"], file.read_text()
    assert (a.rapid_speed_mm_s / a.mm_per_unit, a.screw_pitch_mm / a.mm_per_unit) == pytest.approx((90.0, 8.192))
    assert "rapid_speed_deg_s = 90.0  # LinuxCNC: [AXIS_A] MAX_VELOCITY" in text
    assert "[axis.Y2.nominal]" not in text  # copied from Y


def test_all_missing_values_are_named_and_nothing_is_written(run_init: Said, tmp_path: Path) -> None:
    file = tmp_path / "m.toml"
    code, out, err = run_init(
        "init", file, "--answers", read_written_config(tmp_path, axis={"X": RAPID}), "--offline", "--json"
    )
    assert (code, err) == (2, "")
    faults = [fault["path"].removeprefix("axis.X.") for fault in json.loads(out)["error"]["faults"]]
    assert faults == [
        "drive.profile", "drive.increments_per_rev", "nominal.R", "nominal.L", "nominal.K", "nominal.Jt",
        "regulators.current_limit_a", "regulators.voltage_limit_v",
    ]  # fmt: skip
    assert not file.exists()


def test_existing_file_is_not_overwritten(run_init: Said, tmp_path: Path) -> None:
    file = tmp_path / "m.toml"
    file.write_text("mine")
    code, _, err = run_init("init", file, "--offline")
    assert code == 3
    assert "never overwrites" in err
    assert file.read_text() == "mine"


def test_dry_run_prints_file_without_writing(run_init: Said, tmp_path: Path) -> None:
    axis = SHEET | RAPID | {"drive": SHEET["drive"] | {"increments_per_rev": 65536}}
    answers = read_written_config(tmp_path, axis={"X": axis})
    code, out, err = run_init("init", tmp_path / "m.toml", "--answers", answers, "--offline", "--dry-run")
    assert code == 0
    assert machine_config.parse_config(tomllib.loads(out)).axis["X"].nominal.R == 0.5
    assert "would be written" in err
    assert not (tmp_path / "m.toml").exists()


def test_unknown_answer_is_refused_with_suggestion(run_init: Said, tmp_path: Path) -> None:
    axis = SHEET | RAPID | {"drive": SHEET["drive"] | {"increments_per_rev": 65536}, "screw_pich_mm": 5.0}
    code, _, err = run_init(
        "init", tmp_path / "m.toml", "--answers", read_written_config(tmp_path, axis={"X": axis}), "--offline"
    )
    assert code == 2
    assert "axis.X.screw_pich_mm: is not a key of this section (did you mean 'screw_pitch_mm'?)" in err


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ({"bus": {"can0": {"interface": "tin"}}}, "bus.can0.interface"),
        ({"axis": {"X": {"drive": {"profile": "epos5"}}}}, "axis.X.drive.profile"),
        ({"axis": {"X": {"drive": {"profile": "cia402", "eds": "lost.eds"}}}}, "lost.eds"),
        ({"axis": {"X": 3}}, "axis.X"),
        ({"axis": {"X": {"screw_pitch_mm": "wide"}}}, "screw_pitch_mm"),
        ({"machine": {"sync_period_s": "often"}}, "sync_period_s"),
    ],
)
def test_wrong_answer_is_reported_with_key(tables: dict[str, Any], words: str, run_init: Said, tmp_path: Path) -> None:
    code, _, err = run_init(
        "init", tmp_path / "m.toml", "--answers", read_written_config(tmp_path, **tables), "--offline"
    )
    assert code in (2, 3)
    assert words in err
    assert "Traceback" not in err


@pytest.mark.usefixtures("real_time")
def test_scales_come_from_drive_and_rest_from_operator(
    run_init: Said, peer: DrivePeer, bus: dict[str, Any], tmp_path: Path
) -> None:
    """A wrong answer is prompted again, an empty line accepts the proposal."""
    lines = [
        "tin can", "virtual", bus["can0"]["channel"], "", "", "X1", "X", "20", "500", "4 m/s2", "4000", "0,5", "0.5",
        "0.005", "", "0.075", *[""] * 8, "yes",
    ]  # fmt: skip
    file = tmp_path / "m.toml"
    code, out, err = run_init("init", file, said="\n".join(lines) + "\n")
    assert code == 0, err
    assert err.count("try again") == 4
    assert "node 1 (fdhil twin drive" in err
    made = machine_config.load_config(file).axis["X"]
    assert (made.drive.profile, made.drive.increments_per_rev, made.nominal.K) == ("fdhil_twin", 65536, 0.8)
    assert (made.nominal.Jt, made.correction is not None) == (0.075, True)
    assert "check nominal.K of axis.X = 0.8: guessed: the drive's rated torque" in out
    assert set(peer.heard) == {*range(0x601, 0x680)}, "only SDO requests, to every node-ID once"


def test_inconsistent_numbers_are_prompted_again(run_init: Said, bus: dict[str, Any], tmp_path: Path) -> None:
    """5 H instead of 5 mH is detected at the end, and only this value is prompted again."""
    lines = [
        "virtual", bus["can0"]["channel"], "", "", "X", "", "fdhil_twin", "20", "65536", "500", "4000", "50", "0.5",
        "5", "0.8", "0.075", "", "300", *[""] * 8, "no", "0.005", "12.566",
    ]  # fmt: skip
    file = tmp_path / "m.toml"
    code, out, err = run_init("init", file, "--offline", said="\n".join(lines) + "\n")
    assert code == 0, (err, out)
    assert "invalid:" in err
    assert machine_config.load_config(file).axis["X"].nominal.L == 0.005


def test_unreadable_eds_is_prompted_again(run_init: Said, tmp_path: Path) -> None:
    write_eds("elmo", tmp_path)
    lines = [
        "virtual", "one", "", "", "X", "", "cia402", "lost.eds", "cia402", "elmo.eds", "20", "65536", "500", "4000",
        "50", "0.5", "0.005", "0.8", "0.075", "", "300", *[""] * 8, "yes",
    ]  # fmt: skip
    file = tmp_path / "m.toml"
    code, out, err = run_init("init", file, "--offline", said="\n".join(lines) + "\n")
    assert code == 0, (err, out)
    assert "lost.eds" in err
    made = machine_config.load_config(file).axis["X"]
    assert (made.drive.profile, made.drive.eds) == ("cia402", tmp_path / "elmo.eds")


def test_aborted_prompt_leaves_no_file(run_init: Said, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At a terminal this is Ctrl-C; otherwise standard input has ended, and the error suggests an answers file."""
    code, _, err = run_init("init", tmp_path / "m.toml", "--offline", said="socketcan\n")
    assert code == 2
    assert "bus.can0.channel: needs an answer, and standard input has ended (give --answers FILE)" in err
    monkeypatch.setattr("fdhil.cli.init_command.sys", SimpleNamespace(stdin=SimpleNamespace(isatty=lambda: True)))
    code, _, err = run_init("init", tmp_path / "m.toml", "--offline", said="socketcan\n")
    assert code == 130
    assert "stopped by the operator" in err
    assert list(tmp_path.iterdir()) == []


def test_text_of_nc_files_cannot_break_comments(run_init: Said, tmp_path: Path) -> None:
    (tmp_path / "mill.ini").write_text(INI.replace("X Y Z", "X").replace("[JOINT_0]", "[JOINT_0]\nN=\x07\x7f\u2028"))
    (tmp_path / "drives.hal").write_text(HAL_TEXT.replace("cia402.0", "cia402.[JOINT_0]N"))
    axis = SHEET | {"screw_pitch_mm": 10.0}
    answers = read_written_config(tmp_path, axis={"X": axis})
    arguments = ("--from-linuxcnc", tmp_path / "mill.ini", "--answers", answers, "--offline")
    code, _, err = run_init("init", tmp_path / "m.toml", *arguments)
    assert code == 0, err
    assert machine_config.load_config(tmp_path / "m.toml").axis["X"].drive.increments_per_rev == 10000


@pytest.mark.usefixtures("real_time")
def test_init_sends_nothing_while_nc_runs(
    run_init: Said, peer: DrivePeer, bus: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only the node-ID of the drive is known, so scales are prompted; the SYNC period is measured."""
    monkeypatch.setattr("fdhil.commissioning.scan.LISTEN_S", 2.0)
    axis = SHEET | RAPID | {"drive": SHEET["drive"] | {"increments_per_rev": 65536}}
    answers = read_written_config(tmp_path, axis={"X": axis}, bus=bus, machine={"sync_period_s": 0.001})
    stop = threading.Event()
    with can.Bus(interface="virtual", channel=bus["can0"]["channel"]) as nc:

        def run() -> None:
            while not stop.wait(0.002):
                nc.send(can.Message(arbitration_id=0x80, is_extended_id=False))

        thread = threading.Thread(target=run)
        thread.start()
        try:
            code, out, err = run_init("init", tmp_path / "m.toml", "--answers", answers)
        finally:
            stop.set()
            thread.join()
    assert code == 0, err
    assert set(peer.heard) == {0x80}
    assert "an NC runs it (SYNC received), so no drive was read" in out


@pytest.mark.usefixtures("real_time")
def test_answer_contradicting_drive_gives_note(
    run_init: Said, peer: DrivePeer, bus: dict[str, Any], tmp_path: Path
) -> None:
    sheet = SHEET | RAPID | {"drive": {"increments_per_rev": 4096}}
    code, out, err = run_init(
        "init", tmp_path / "m.toml", "--answers", read_written_config(tmp_path, axis={"X": sheet}, bus=bus)
    )
    assert code == 0, err
    assert "note: axis.X.drive.increments_per_rev: the answers have 4096, the drive has 65536" in out
    assert machine_config.load_config(tmp_path / "m.toml").axis["X"].drive.increments_per_rev == 4096


def test_default_limits_allow_coarse_increments(run_init: Said, tmp_path: Path) -> None:
    for increments, limits in ((65536, (50.0, 2.0, 250.0)), (16384, (50.0, 5.0, 1000.0))):
        drive = SHEET["drive"] | {"increments_per_rev": increments}
        answers = tmp_path / "answers.toml"
        answers.write_text(format_toml({"axis": {"X": SHEET | RAPID | {"drive": drive}}}) + "[axis.X.correction]\n")
        file = tmp_path / f"{increments}.toml"
        code, _, err = run_init("init", file, "--answers", answers, "--offline")
        assert code == 0, err
        found = machine_config.load_config(file).axis["X"].correction
        assert found is not None
        assert (found.max_offset_um, found.max_speed_mm_s, found.max_acceleration_mm_s2) == limits


@pytest.mark.usefixtures("real_time")
def test_axis_without_drive_is_refused(run_init: Said, peer: DrivePeer, bus: dict[str, Any], tmp_path: Path) -> None:
    sheet = SHEET | RAPID
    answers = read_written_config(tmp_path, axis={"X": sheet, "Y": sheet}, bus=bus)
    code, _, err = run_init("init", tmp_path / "m.toml", "--answers", answers)
    assert code == 2
    assert "axis.Y.drive: has no drive: 1 found, 1 assigned to other axes" in err
    answers = read_written_config(tmp_path, axis={"X": SHEET | RAPID | {"drive": {"node_id": 9}}}, bus=bus)
    code, _, err = run_init("init", tmp_path / "m.toml", "--answers", answers)
    assert code == 2
    assert "axis.X.drive.node_id: is 9, which is not on the bus (node 1 (fdhil twin drive" in err


@pytest.mark.usefixtures("real_time")
def test_assigned_drive_is_not_proposed_again(
    run_init: Said, peer: DrivePeer, bus: dict[str, Any], tmp_path: Path
) -> None:
    with DrivePeer(build_machine_config(axes="XY", bus=bus["can0"]), "Y"):
        sheet = SHEET | RAPID | {"drive": {}}
        answers = read_written_config(tmp_path, axis={"X": sheet, "Y": sheet | {"drive": {"node_id": 1}}}, bus=bus)
        code, _, err = run_init("init", tmp_path / "m.toml", "--answers", answers)
    assert code == 0, err
    made = machine_config.load_config(tmp_path / "m.toml")
    assert {axis: made.get_node_id(axis) for axis in made.axis} == {"X": 2, "Y": 1}


def test_pc_without_can_states_required_option(run_init: Said, tmp_path: Path) -> None:
    code, _, err = run_init("init", tmp_path / "m.toml", "--answers", read_written_config(tmp_path, axis={"X": SHEET}))
    assert code == 2
    assert "bus.can0.interface" in err
    assert "can-adapter.md" in err


def test_can_interface_of_pc_is_proposed(run_init: Said, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, kind in (("can3", 280), ("eth0", 1)):
        (tmp_path / "net" / name).mkdir(parents=True)
        (tmp_path / "net" / name / "type").write_text(f"{kind}\n")
    monkeypatch.setattr("fdhil.cli.init_command.INTERFACES", tmp_path / "net")
    axis = SHEET | RAPID | {"drive": SHEET["drive"] | {"increments_per_rev": 65536}}
    code, _, err = run_init(
        "init", tmp_path / "m.toml", "--answers", read_written_config(tmp_path, axis={"X": axis}), "--offline"
    )
    assert code == 0, err
    made = machine_config.load_config(tmp_path / "m.toml").bus["can0"]
    assert (made.interface, made.channel) == ("socketcan", "can3")


@pytest.mark.parametrize("name", ["sim", "realistic", "four-axes", "vcan", "machine-template"])
def test_config_with_comments_parses_identically(name: str) -> None:
    document = tomllib.loads((ROOT / "configs" / f"{name}.toml").read_text("utf-8"))
    again = tomllib.loads(write_filled_template(document, {"machine.name": 'a "source" \\ of it'}, "head"))
    assert again == document
