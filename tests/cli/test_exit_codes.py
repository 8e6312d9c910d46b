"""Every command with every wrong input: exit code, one sentence, no traceback, and the same as JSON."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import click
import pytest

from fdhil.cli.main import cli, iterate_commands
from tests.bench import axis_toml, bench_toml
from tests.daemon.machine_rig import fdhil
from tests.reserved_port import reserve_port

DONE, USAGE, TROUBLE = 0, 2, 3
LEAVES = dict(iterate_commands(cli))
RECORDING = "time_s,voltage_V,current_A,speed_rad_per_s,position_m\n"
# what a command is called with where the configuration is what is wrong
WITH_CONFIG = {
    "scan": ["{config}"],
    "check": ["{config}"],
    "doctor": ["{config}"],
    "commission": ["{config}", "--yes"],
    "run": ["{config}"],
    "status": ["{config}"],
    "arm": ["{config}", "part.ngc"],
    "disarm": ["{config}"],
    "adopt": ["{config}", "--yes"],
    "acknowledge": ["{config}", "--all"],
    "audit": ["{config}"],
    "web": ["{config}"],
    "web-user": ["{config}", "anna", "--remove"],
    "publish": ["prometheus", "{config}"],
    "sim": ["{config}"],
    "record": ["{config}", "--out", "out.csv"],
    "history": ["{config}"],
    "report": ["{config}", "--out", "out.html"],
    "acceptance": ["{config}", "--out", "out.html"],
    "identify": ["shuttle.csv", "--config", "{config}"],
    "predict": ["part.ngc", "--config", "{config}"],
    "correct": ["part.ngc", "--config", "{config}"],
    "advise": ["part.ngc", "--config", "{config}", "--tolerance-um", "50"],
    "replay": ["shuttle.csv", "--config", "{config}"],
    "play": ["part.ngc", "--config", "{config}"],
    "uplink": ["{config}"],
    "offers list": ["{config}"],
    "offers accept": ["{config}", "friction", "--by", "Bert"],
    "offers reject": ["{config}", "friction", "--by", "Bert", "--reason", "another oil"],
}
WITHOUT_CONFIG = {
    "demo": ["--out", "out"],
    "init": ["new.toml", "--offline"],
    "paper": ["--out", "out"],
    "eds": ["drive.eds"],
    "interpret": ["part.ngc"],
    "export": ["w.parquet", "--out", "out.csv"],
    "compare": ["before.json", "after.json"],
    # with another kind of configuration
    "fleet collect": ["fleet.toml"],
    "fleet status": ["fleet.toml"],
    "fleet trend": ["fleet.toml", "--machine", "mill-1", "--axis", "X", "--parameter", "ft"],
    "fleet compare": ["fleet.toml", "--parameter", "ft"],
    "fleet outliers": ["fleet.toml"],
    "fleet key": ["works.key"],
    "fleet sign": ["change.toml", "--key", "works.key", "--by", "Anna", "--out", "out.offer"],
    "fleet stage": ["fleet.toml", "change.toml"],
    "fleet service": ["fleet.toml", "--machine", "mill-1"],
    "fleet services": ["fleet.toml"],
    "fleet retain": ["fleet.toml"],
    "fleet export": ["fleet.toml", "--anonymous", "given"],
    "fleet web": ["fleet.toml"],
    "fleet web-user": ["fleet.toml", "anna", "--remove"],
    "fleet reanalyse": ["fleet.toml", "--workers", "0"],
}
# what a command is called with where the file that it works on is what is wrong
WITH_FILE = {
    "arm": ["bench.toml", "{file}"],
    "eds": ["{file}"],
    "identify": ["{file}"],
    "replay": ["{file}"],
    "export": ["{file}", "--out", "out.csv"],
    "interpret": ["{file}"],
    "predict": ["{file}", "--config", "bench.toml"],
    "correct": ["{file}", "--config", "bench.toml"],
    "acceptance": ["bench.toml", "--out", "out.html", "--measured-circle", "{file}"],
    "advise": ["{file}", "--config", "bench.toml", "--tolerance-um", "50"],
    "play": ["{file}", "--config", "bench.toml", "--dry-run"],
}
TAKE_ANY_NUMBER = ("identify", "replay", "acknowledge", "offers list")  # of files, or of notices
SUFFIXES = {
    "arm": [".ngc"],
    "eds": [".eds", ".dcf"],
    "identify": [".csv", ".mat", ".mf4", ".h5"],
    "acceptance": [".csv"],
    "replay": [".csv", ".parquet"],
    "export": [".parquet", ".mat", ".mf4", ".h5"],
    "interpret": [".ngc"],
}
# what a command is called with where the file that it is to write cannot be
WITH_OUT = {
    "predict": ["part.ngc", "--config", "bench.toml", "--out", "{out}"],
    "correct": ["part.ngc", "--config", "bench.toml", "--report", "{out}"],
    "advise": ["part.ngc", "--config", "bench.toml", "--tolerance-um", "50", "--out", "{out}"],
    "export": ["w.parquet", "--out", "{out}"],
    "report": ["bench.toml", "--out", "{out}"],
    "acceptance": ["bench.toml", "--out", "{out}"],
    "record": ["bench.toml", "--out", "{out}"],
    "sim": ["bench.toml", "--trace", "{out}"],
    "history": ["bench.toml", "--plot", "{out}"],
}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("bench.toml").write_text(bench_toml())
    Path("part.ngc").write_text("G21 G90 G64\nG1 X10 F1000\nM2\n")
    Path("profile.toml").write_text(f'[machine]\nname = "m"\n{axis_toml("X")}[axis.X.drive]\nprofile = "maxon_epos4"\n')
    Path("key.toml").write_text(bench_toml().replace("screw_pitch_mm", "screw_pich_mm", 1))
    for suffix in (".toml", ".csv", ".parquet", ".ngc", ".eds", ".dcf", ".mat", ".mf4", ".h5"):
        Path(f"junk{suffix}").write_bytes(bytes(range(256)) * 8)
        Path(f"empty{suffix}").touch()
        Path(f"folder{suffix}").mkdir()
        Path(f"loop{suffix}").symlink_to(f"loop{suffix}")  # unreadable even for root
    for suffix in ("", ".png"):
        os.mkfifo(f"pipe{suffix}")
        Path(f"dir{suffix}").mkdir()
    return tmp_path


def run_with_error(capsys: Any, code: int, *arguments: str) -> str:
    message = fdhil(*arguments, capsys=capsys)
    assert message[0] == code, message
    assert message[1] == ""
    first, *rest = message[2].splitlines()
    assert first.startswith("fdhil: "), message[2]
    assert all(line.startswith("  ") for line in rest), message[2]  # faults of a configuration, one per line
    assert "Traceback" not in message[2]
    code_of_json, out, err = fdhil(*arguments, "--json", capsys=capsys)
    assert (code_of_json, err) == (code, "")
    document = json.loads(out)
    if document["schema"] == "fdhil-identify-1":  # the other files of a batch are reported as well
        error = document["files"][0]["error"]
    else:
        assert set(document) == {"schema", "error"}
        assert document["schema"] == "fdhil-error-1"
        error = document["error"]
    assert error["class"].isidentifier()
    assert len(error["text"]) > 20
    return str(message[2])


def test_tables_of_this_module_list_every_command() -> None:
    assert {*WITH_CONFIG, *WITHOUT_CONFIG} == set(LEAVES)


@pytest.mark.parametrize("command", LEAVES)
def test_every_command_has_json_and_refuses_unknown_option(command: str, capsys: Any) -> None:
    assert any("--json" in option.opts for option in LEAVES[command].params)
    arguments = [text.format(config="bench.toml") for text in (WITH_CONFIG | WITHOUT_CONFIG)[command]]
    assert f"fdhil {command} --help" in run_with_error(capsys, USAGE, *command.split(), *arguments, "--no-such-option")
    if command not in TAKE_ANY_NUMBER:
        assert "Got unexpected" in run_with_error(capsys, USAGE, *command.split(), *arguments, "a", "b", "c")


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ("absent.toml", "No such file"),
        ("folder.toml", "directory"),
        ("junk.toml", "is not valid TOML"),
        ("empty.toml", "missing"),
        ("loop.toml", "symbolic links"),
        ("key.toml", "did you mean 'screw_pitch_mm'?"),
        ("profile.toml", "axis.X.drive.profile: must be one of fdhil_twin"),
    ],
)
def test_wrong_configuration_exits_2(config: str, words: str, capsys: Any) -> None:
    for command, arguments in WITH_CONFIG.items():
        given = [text.format(config=config) for text in arguments]
        assert words in run_with_error(capsys, USAGE, *command.split(), *given), command


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("kind", ["absent", "folder", "junk", "empty", "loop"])
def test_unreadable_file_exits_3(kind: str, capsys: Any) -> None:
    for command, arguments in WITH_FILE.items():
        for suffix in SUFFIXES.get(command, [".ngc", ".csv"]):
            run_with_error(capsys, TROUBLE, command, *(text.format(file=kind + suffix) for text in arguments))
    assert not Path("out.csv").exists()


@pytest.mark.parametrize(
    ("out", "words"), [("dir", "a folder"), ("pipe", "a pipe"), ("no/such/file", "does not exist")]
)
def test_unwritable_file_exits_3_before_computation(out: str, words: str, capsys: Any) -> None:
    for command, arguments in WITH_OUT.items():
        name = f"{out}.png" if command == "history" else out
        assert words in run_with_error(capsys, TROUBLE, command, *(text.format(out=name) for text in arguments))
    assert Path("dir").is_dir()
    assert Path("pipe").is_fifo()


@pytest.mark.usefixtures("processes")
def test_file_without_permission_exits_3_and_config_exits_2() -> None:
    """In a process without root's privileges."""
    for suffix in (".toml", ".ngc", ".csv"):
        Path(f"locked{suffix}").write_text("")
        Path(f"locked{suffix}").chmod(0)
    calls = [[command, *(t.format(file="locked.ngc") for t in arguments)] for command, arguments in WITH_FILE.items()]
    configs = [["predict", "part.ngc", "--config", "locked.toml"], ["history", "locked.toml"]]
    script = (
        "import json, sys; from fdhil.cli.main import cli, run_safely\n"
        "def code(given):\n    sys.argv = ['fdhil', *given]\n    return run_safely(cli)\n"
        "print(json.dumps([code(given) for given in json.load(sys.stdin)]), file=sys.stderr)"
    )
    command = [sys.executable, "-c", script]
    if os.geteuid() == 0:
        command = ["setpriv", "--bounding-set=-dac_override,-dac_read_search", *command]
    as_json = ["arm", "bench.toml", "locked.ngc", "--json"]
    given = json.dumps([as_json, *calls, *configs])
    done = subprocess.run(command, input=given, capture_output=True, text=True, timeout=300)
    *reported, codes = done.stderr.splitlines()
    assert json.loads(codes) == [TROUBLE] * len([as_json, *calls]) + [USAGE] * len(configs), reported
    assert len(reported) == len(calls) + len(configs)
    assert "locked.ngc: Permission denied" in json.loads(done.stdout)["error"]["text"]


def test_permissions_are_not_checked_before_reading() -> None:
    types = [(name, option.type) for name, command in LEAVES.items() for option in command.params]
    assert not {name for name, kind in types if isinstance(kind, click.Path) and kind.readable}


def test_input_file_is_never_overwritten(capsys: Any) -> None:
    Path("w.parquet").write_bytes(b"window")
    for command, arguments in WITH_OUT.items():
        read = next(text for text in arguments if "." in text)
        if command not in ("history", "sim"):
            before = Path(read).read_bytes()
            assert "choose another name" in run_with_error(
                capsys, USAGE, command, *(text.format(out=f"./{read}") for text in arguments)
            )
            assert Path(read).read_bytes() == before
    both = ["--out", "once.csv", "--report", "once.csv"]
    run_with_error(capsys, USAGE, "predict", "part.ngc", "--config", "bench.toml", *both)


def test_unknown_picture_suffix_exits_2(capsys: Any) -> None:
    assert ".png, .svg, .pdf" in run_with_error(capsys, USAGE, "history", "bench.toml", "--plot", "drift.bmp")


def test_null_device_is_written_and_kept(capsys: Any) -> None:
    device = Path(os.devnull).stat().st_rdev
    assert fdhil("predict", "part.ngc", "--config", "bench.toml", "--out", os.devnull, capsys=capsys)[0] == DONE
    assert Path(os.devnull).stat().st_rdev == device
    assert Path(os.devnull).is_char_device()


def test_occupied_port_exits_3(capsys: Any) -> None:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        port = listener.getsockname()[1]
        Path("taken.toml").write_text(bench_toml() + f'[bus.can0]\ninterface = "socketcand"\nport = {port}\n')
        assert str(port) in run_with_error(capsys, TROUBLE, "sim", "taken.toml")


@pytest.mark.parametrize("command", ["scan", "check", "commission", "record", "run"])
def test_missing_bus_exits_3(command: str, capsys: Any) -> None:
    with reserve_port() as port:
        Path("absent_bus.toml").write_text(bench_toml() + f'[bus.can0]\ninterface = "socketcand"\nport = {port}\n')
        arguments = [text.format(config="absent_bus.toml") for text in WITH_CONFIG[command]]
        assert f"127.0.0.1:{port} cannot be reached" in run_with_error(capsys, TROUBLE, command, *arguments)


@pytest.mark.parametrize("command", ["status", "arm", "disarm"])
def test_missing_daemon_exits_3(command: str, capsys: Any) -> None:
    message = run_with_error(
        capsys, TROUBLE, command, *(text.format(config="bench.toml") for text in WITH_CONFIG[command])
    )
    assert "fdhil run" in message


def test_missing_history_exits_3(capsys: Any) -> None:
    for command in ("history", "report"):
        message = run_with_error(
            capsys, TROUBLE, command, *(text.format(config="bench.toml") for text in WITH_CONFIG[command])
        )
        assert "history" in message
