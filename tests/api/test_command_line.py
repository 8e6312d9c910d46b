"""``fdhil identify`` for laboratories: any move, proposed maps, pictures, pages; and the citation."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

import fdhil
from fdhil.cli.citation import PAPER, TITLE
from fdhil.cli.main import cli
from fdhil.errors import FdhilError
from tests.api.independent_motor import TRUTH
from tests.api.motor_recordings import record_motor
from tests.api.test_read import write_csv

ROOT = Path(__file__).parents[2]


@pytest.fixture
def scope_trace(tmp_path: Path) -> Path:
    """Return an oscilloscope's file of voltage steps."""
    return write_csv(tmp_path / "scope.csv", "Time [s],CH1,CH2,Speed [rpm]", "tuiw", rpm=True)


def run_command(*arguments: object, answer: str | None = None) -> Result:
    return CliRunner().invoke(cli, [*map(str, arguments)], standalone_mode=False, input=answer)


def read_pool(result: Result) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(result.stdout)["files"][0]["pooled"]
    return document


def test_question_mark_writes_a_usable_column_map(scope_trace: Path) -> None:
    asked = run_command("identify", scope_trace, "--columns", "?")
    assert asked.return_value == 1
    written = scope_trace.with_suffix(".columns.toml")
    assert "fits the equations" in asked.stderr
    assert str(written) in asked.stderr
    result = run_command("identify", scope_trace, "--columns", written, "--any-move", "--json")
    assert result.return_value == 0, result.output
    assert read_pool(result)["parameters"]["Jt"]["value"] == pytest.approx(TRUTH["Jt"], rel=0.02)


def test_question_mark_keeps_an_existing_column_map(scope_trace: Path) -> None:
    written = scope_trace.with_suffix(".columns.toml")
    written.write_text("# mine")
    result = run_command("identify", scope_trace, "--columns", "?")
    assert "is not overwritten" in str(result.exception)
    assert written.read_text() == "# mine"


def test_laboratory_recording_without_any_move_names_the_option(tmp_path: Path) -> None:
    m = record_motor("rapids")
    head = "# format: fdhil-recording-1\n# sample_rate_hz: 1000\n# axis: X\n# voltage_sampling: interval_mean\n"
    rows = [f"{t:.3f},{u:.4f},{i:.4f},0.0" for t, u, i in zip(m.time, m.voltage, m.current, strict=True)]
    path = tmp_path / "still.csv"
    path.write_text(head + "\n".join(["time_s,voltage_V,current_A,speed_rad_per_s", *rows, ""]))
    assert "--any-move" in run_command("identify", path).output


def test_picture_and_page_are_written(scope_trace: Path, tmp_path: Path) -> None:
    run_command("identify", scope_trace, "--columns", "?")
    columns = scope_trace.with_suffix(".columns.toml")
    page = tmp_path / "page.html"
    result = run_command("identify", scope_trace, "--columns", columns, "--any-move", "--report", page, "--plot")
    assert result.return_value == 0, result.output
    assert scope_trace.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    text = page.read_text("utf-8")
    for title in (
        "Parameters",
        "Correlation of the residuals",
        "Correlation of the estimates",
        "Most informative further recording",
    ):
        assert title in text


def test_unknown_picture_format_is_refused(scope_trace: Path) -> None:
    assert "must end in .png, .svg, .pdf" in str(run_command("identify", scope_trace, "--plot", "p.bmp").exception)


def test_picture_of_several_recordings_is_refused(scope_trace: Path) -> None:
    assert "--plot applies to one recording" in str(
        run_command("identify", scope_trace, scope_trace, "--plot").exception
    )


def test_command_and_python_write_the_same_document(scope_trace: Path) -> None:
    run_command("identify", scope_trace, "--columns", "?")
    columns = scope_trace.with_suffix(".columns.toml")
    result = run_command("identify", scope_trace, "--columns", columns, "--any-move", "--json")
    assert json.loads(fdhil.identify(fdhil.read(scope_trace, columns), any_move=True).to_json()) == json.loads(
        result.stdout
    )


def test_readme_commands_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = re.findall(r"```python\n(import fdhil\n.*?)```", (ROOT / "README.md").read_text("utf-8"), re.DOTALL)
    assert len(code) == 1
    write_csv(tmp_path / "scope.csv", "Time (s),CH1 (V),CH2 (A),n_act (rpm)", rpm=True)
    monkeypatch.chdir(tmp_path)
    exec(code[0], {})
    assert (tmp_path / "result.html").is_file()


def test_citation_matches_the_citation_file() -> None:
    shown, file = run_command("--cite").output, (ROOT / "CITATION.cff").read_text("utf-8")
    for words in (TITLE, PAPER, "Desforges", "Habbadi", "Dessein"):
        assert words in shown
        assert words in file


WITHOUT_EXTRAS = """
import sys
for name in ("pyarrow", "can", "canopen", "pymodbus", "serial", "matplotlib", "fastapi"):
    sys.modules[name] = None
import fdhil
from tests.api.motor_recordings import record_motor
m = record_motor("chirp")
print(fdhil.identify(fdhil.Recording(m.time, m.voltage, m.current, m.speed), any_move=True).validated)
"""


@pytest.mark.usefixtures("processes")
def test_identification_runs_without_optional_libraries() -> None:
    done = subprocess.run([sys.executable, "-c", WITHOUT_EXTRAS], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.strip() == "True", done.stderr


def test_missing_parquet_library_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    for name in ("fdhil.store.parquet_library", "fdhil.store.recording_parquet", "fdhil.store.window_file"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.raises(FdhilError, match=r"pip install 'fdhil\[machine\]'"):
        fdhil.read("rapid.parquet")
