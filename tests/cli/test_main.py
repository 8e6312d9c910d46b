"""The command line as a whole: list of commands, exit codes, no tracebacks."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import warnings
from importlib import import_module

import click
import pytest

from fdhil.cli.main import COMMANDS, cli, main, run_safely
from fdhil.errors import ConfigError, ConfigFault, ConnectError


def run_fdhil(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "fdhil", *arguments], capture_output=True, text=True)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_exists_with_help(name: str) -> None:
    module, _, attribute = COMMANDS[name][0].partition(":")
    command = getattr(import_module(module), attribute)
    assert isinstance(command, click.Command)
    text = command.get_help(click.Context(command, info_name=name))
    assert len(text.splitlines()) > 5
    assert command.help


@pytest.mark.usefixtures("processes")
def test_help_imports_no_numerics() -> None:
    code = (
        "import sys; from fdhil.cli.main import cli; cli.main(['--help'], standalone_mode=False); print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "Set up:" in done.stdout
    for heavy in ("numpy", "scipy", "numba", "pyarrow", "canopen", "pymodbus", "pydantic", "rich"):
        assert heavy not in done.stdout.split()


@pytest.mark.usefixtures("processes")
def test_unknown_command_and_option_exit_2() -> None:
    assert run_fdhil("identfy").returncode == 2
    done = run_fdhil("predict", "--no-such-option")
    assert done.returncode == 2
    assert "Traceback" not in done.stderr


def test_errors_are_one_sentence_with_exit_code(capsys: pytest.CaptureFixture[str]) -> None:
    @click.command()
    def broken() -> None:
        raise ConnectError("can0", "is not there; bring it up with `ip link set can0 up`")

    @click.command()
    def misconfigured() -> None:
        raise ConfigError("machine.toml", [ConfigFault("axis.X", "is missing"), ConfigFault("nc", "is no table")])

    argv, sys.argv = sys.argv, ["fdhil"]
    try:
        assert run_safely(broken) == 3
        assert run_safely(misconfigured) == 2
    finally:
        sys.argv = argv
    message = capsys.readouterr().err
    assert "fdhil: can0: is not there; bring it up" in message
    assert "axis.X: is missing" in message
    assert "nc: is no table" in message


def test_commands_are_listed_in_workflow_order() -> None:
    listed = cli.list_commands(click.Context(cli))
    assert listed[:8] == ["demo", "paper", "sim", "init", "scan", "check", "commission", "doctor"]


def test_entry_point_hides_library_warnings(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Warnings of libraries are for developers; child processes hide them as well."""
    monkeypatch.setattr("sys.argv", ["fdhil", "--version"])
    monkeypatch.setattr("sys.warnoptions", [])
    monkeypatch.setenv("PYTHONWARNINGS", "")
    monkeypatch.delenv("PYTHONWARNINGS")
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        with pytest.raises(SystemExit):
            main()
        warnings.warn("overflow encountered", RuntimeWarning, stacklevel=1)
    assert shown == []
    assert os.environ["PYTHONWARNINGS"] == "ignore"
    assert "fdhil" in capsys.readouterr().out


def test_ctrl_c_is_reported_as_json(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    @click.command()
    @click.option("--json", "as_json", is_flag=True)
    def stopped(as_json: bool) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sys.argv", ["fdhil", "--json"])
    assert run_safely(stopped) == 130
    assert json.loads(capsys.readouterr().out)["error"]["class"] == "Stopped"
