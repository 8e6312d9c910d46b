"""``fdhil interpret``: one document on stdout, or one sentence on stderr with the exit code."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from fdhil.cli.main import cli, run_safely
from tests.bench import bench_toml


def run_cli(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr("sys.argv", ["fdhil", *arguments])
    return run_safely(cli)


def test_json_lists_all_motion_kinds(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "p.ngc"
    program.write_text("G0 X1\nG1 Y2 F60\n\nG3 X1 Y4 J1\nG4 P1.5\nM2\n")
    assert run_cli(monkeypatch, "interpret", str(program), "--json") == 0
    assert json.loads(capsys.readouterr().out) == {
        "schema": "fdhil-interpret-1",
        "motions": [
            {"line": 1, "kind": "rapid", "end": [1.0, 0.0, 0.0]},
            {"line": 2, "kind": "feed", "end": [1.0, 2.0, 0.0], "feed": 60.0},
            {"line": 4, "kind": "arc", "end": [1.0, 4.0, 0.0], "centre": [1.0, 3.0, None], "turns": 1, "plane": "XY",
             "feed": 60.0},
            {"line": 5, "kind": "dwell", "seconds": 1.5},
        ],
    }  # fmt: skip


def test_error_is_one_sentence_with_empty_stdout(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "p.ngc"
    program.write_text("G0 X1\nG1 X2\n")
    assert run_cli(monkeypatch, "interpret", str(program)) == 3
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("\n") == 1
    assert "line 2" in shown.err
    assert run_cli(monkeypatch, "interpret", str(tmp_path / "none.ngc")) == 3


def test_table_has_one_row_per_motion(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "p.ngc"
    program.write_text("G0 X1\nX2\n")
    assert run_cli(monkeypatch, "interpret", str(program)) == 0
    assert len(capsys.readouterr().out.splitlines()) == 2


PROBED = "(finds the edge of the part, then works from it)\nG21 G90 G64\nG0 X0 Y0\nG38.2 X20 F300\n#1=#5061\n"
PROBED += "G10 L20 P0 X0\nG0 X5\nG1 X[#1] F1000\nM2\n"


def load_document(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *more: str
) -> dict[str, Any]:
    program = tmp_path / "p.ngc"
    program.write_text(text)
    run_cli(monkeypatch, "interpret", str(program), "--json", *more)
    return dict(json.loads(capsys.readouterr().out))


def test_probe_is_listed_and_following_position_is_unknown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    document = load_document(PROBED, tmp_path, capsys, monkeypatch)
    assert document["motions"][1] == {"line": 4, "kind": "probe", "end": [20.0, 0.0, 0.0], "feed": 300.0}
    assert document["motions"][2] == {"line": 7, "kind": "rapid", "end": [25.0, 0.0, 0.0]}
    (note,) = document["notes"]
    assert note["code"] == "UnknownAfterProbe"
    assert note["text"].startswith("line 4: the touch point of the probe is unknown")


def test_rotary_motion_is_listed_in_degrees_and_millimetres(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    text = "G0 X20 A45\nF100 G1 A90\nG20\nG2 I0.1 B5 U1\nG21 G0 X0\nG91 A10\nM2\n"
    motions = load_document(text, tmp_path, capsys, monkeypatch)["motions"]
    assert [motion.get("rotary") for motion in motions] == [
        {"A": 45.0},
        {"A": 90.0},
        {"B": 5.0, "U": 25.4},
        None,
        {"A": 100.0},
    ]
    assert motions[1]["end"] == [20.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("text", "code", "told"),
    [
        (
            "G0 X0\nG1 X10. F1000.\nG4 P500\nM30\n",
            "LongDwell",
            "line 3: the axes dwell for 500 s; P is read in sec",
        ),
        (
            "G0 X0\nG1 X10000 F1000.\nM30\n",
            "FarPosition",
            "line 2: axis X moves to 10000 mm, beyond the reach of most",
        ),
    ],
)
def test_ambiguous_number_gives_note(
    text: str,
    code: str,
    told: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (note,) = load_document(text, tmp_path, capsys, monkeypatch)["notes"]
    assert note["code"] == code
    assert note["text"].startswith(told)
    assert "[nc]" in note["advice"]
    machine = tmp_path / "machine.toml"
    machine.write_text(bench_toml() + '[nc]\ndwell_unit = "ms_without_point"\nintegers = "thousandths"\n')
    document = load_document(text, tmp_path, capsys, monkeypatch, "--config", str(machine))
    assert "notes" not in document
    assert document["motions"][1]["end"] == [10.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("G0 X1\nG0 Z1\n", "line 2, 'Z': moves axis Z, which the configuration lacks"),
        (
            "G0 X1 A0\nG1 A5 F10\n",
            "line 2, 'A': moves axis A, which the configuration lacks; add [axis.A]",
        ),
        ("G0 X1\nG0 X9000000\n", "line 2, 'X': axis X at 9000000 mm: the set-point"),
    ],
)
def test_motion_beyond_machine_is_refused(
    text: str, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "machine.toml").write_text(bench_toml())
    document = load_document(text, tmp_path, capsys, monkeypatch, "--config", str(tmp_path / "machine.toml"))
    assert document["error"]["text"].startswith(told)
