"""``fdhil interpret``: one document on stdout, or one sentence on stderr and the exit code."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fdhil.cli.main import cli, run_safely


def call(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    """Run the command line with ``arguments``."""
    monkeypatch.setattr("sys.argv", ["fdhil", *arguments])
    return run_safely(cli)


def test_json_lists_all_kinds_of_motion(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "p.ngc"
    program.write_text("G0 X1\nG1 Y2 F60\n\nG3 X1 Y4 J1\nG4 P1.5\nM2\n")
    assert call(monkeypatch, "interpret", str(program), "--json") == 0
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


def test_an_error_is_one_sentence_and_nothing_on_stdout(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "p.ngc"
    program.write_text("G0 X1\nG1 X2\n")
    assert call(monkeypatch, "interpret", str(program)) == 3
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("\n") == 1
    assert "line 2" in shown.err
    assert call(monkeypatch, "interpret", str(tmp_path / "none.ngc")) == 3


def test_the_table_has_a_row_per_motion(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "p.ngc"
    program.write_text("G0 X1\nX2\n")
    assert call(monkeypatch, "interpret", str(program)) == 0
    assert len(capsys.readouterr().out.splitlines()) == 2
