"""CONFIG defaults to ./machine.toml, misspelt words get a suggestion, written files are reported."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
import pytest

from fdhil.cli.main import cli, iterate_commands
from fdhil.cli.options import ConfigFirstCommand
from tests.bench import bench_toml
from tests.daemon.machine_rig import fdhil

DEMAND = "time_s,X_mm,Y_mm\n" + "".join(f"{k / 1000:.3f},{min(k, 400) / 100:.5f},0\n" for k in range(800))


def write_config(command: click.Command) -> click.Argument | None:
    return next((p for p in command.params if p.name == "config" and isinstance(p, click.Argument)), None)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "machine.toml").write_text(bench_toml())
    (tmp_path / "part.csv").write_text(DEMAND)
    return tmp_path


@pytest.mark.parametrize("name", [name for name, command in iterate_commands(cli) if write_config(command) is not None])
def test_config_defaults_to_machine_toml(name: str) -> None:
    command = dict(iterate_commands(cli))[name]
    config, arguments = write_config(command), [p for p in command.params if isinstance(p, click.Argument)]
    assert config is not None
    assert config.default == Path("machine.toml")
    assert config is arguments[-1] or isinstance(command, ConfigFirstCommand)


@pytest.mark.parametrize(
    "arguments",
    [("arm", "part.csv"), ("acknowledge", "3", "4"), ("acknowledge", "--all"), ("arm", "--method", "flatness")],
)
def test_argument_is_recognised_when_config_is_omitted(arguments: tuple[str, ...], folder: Path, capsys: Any) -> None:
    code, _, err = fdhil(*arguments, capsys=capsys)
    assert (code, "daemon" in err) == (3, True), err  # parsed; only the daemon is missing
    (folder / "machine.toml").unlink()
    code, _, err = fdhil(*arguments, capsys=capsys)
    assert code == 2
    assert "machine.toml cannot be used: file: is not in this folder (name the configuration, or create one" in err


def test_predict_uses_machine_toml_and_reports_written_files(folder: Path, capsys: Any) -> None:
    code, out, err = fdhil("predict", "part.csv", "--out", "p.csv", capsys=capsys)
    assert (code, err) == (0, "wrote p.csv\n")
    assert "um" in out
    code, out, err = fdhil("predict", "part.csv", "--out", "p.csv", "--json", capsys=capsys)
    assert (code, err) == (0, "")
    json.loads(out)
    code, _, err = fdhil("predict", "gone.csv", "--out", "p.csv", capsys=capsys)
    assert (code, "wrote" in err) == (3, False)


@pytest.mark.parametrize(
    ("typed", "meant"), [(["xstatus"], "status"), (["fleet", "colect"], "collect"), (["status", "--wach"], "--watch")]
)
def test_unknown_command_suggests_nearest_one(typed: list[str], meant: str, capsys: Any) -> None:
    code, _, err = fdhil(*typed, capsys=capsys)
    assert code == 2
    assert f"Did you mean '{meant}'" in err


@pytest.mark.parametrize(
    "arguments",
    [
        ("demo", "--out", "out"),
        ("paper", "--out", "out"),
        ("predict", "part.csv", "--report", "r.html"),
        ("report", "--out", "r.html"),
        ("acceptance", "--out", "r.html"),
        ("history", "--plot", "h.svg"),
    ],
)
def test_missing_library_is_reported_before_start(
    arguments: tuple[str, ...], folder: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = set(folder.iterdir())
    monkeypatch.setattr("fdhil.report.report_page.find_spec", lambda _name: None)
    code, out, err = fdhil(*arguments, capsys=capsys)
    assert (code != 0, out) == (True, "")
    assert err == "fdhil: a report needs two libraries (the extra 'report'): pip install jinja2 matplotlib\n"
    assert set(folder.iterdir()) == before
