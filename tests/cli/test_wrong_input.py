"""Wrong input to commands as processes: one sentence, the correct exit code, no traceback."""

from __future__ import annotations

import inspect
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fdhil.cli.main import cli, iterate_commands
from fdhil.sim.wire.tcp_hub import TcpHub
from tests.daemon.machine_rig import fdhil
from tests.sim.hub_thread import HubThread
from tests.sim.simulator_process import write_config

Said = tuple[int, str, str]


def assert_error(said: Said, code: int, *words: str) -> None:
    got, out, err = said
    assert (got, out) == (code, ""), said
    assert "Traceback" not in err
    for word in words:
        assert word in err


@pytest.mark.usefixtures("processes")
def test_process_reports_wrong_config(tmp_path: Path) -> None:
    """One process covers sentence, exit code, JSON on stdout, and hidden library warnings."""
    path = write_config(tmp_path)
    path.write_text(path.read_text().replace("Cd = 5.0", "Cd = nan", 1))
    command = [sys.executable, "-m", "fdhil", "run", str(path), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert (done.returncode, done.stderr) == (2, "")
    assert "finite" in json.loads(done.stdout)["error"]["text"]


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("sink", ["> /dev/full", "| head -1", ">&-"])
def test_full_output_gives_no_traceback(sink: str, tmp_path: Path) -> None:
    """A full disk is an error; a reader that closed the pipe is not."""
    program = tmp_path / "part.ngc"
    program.write_text("G21 G90\n" + "G1 X10 F1000\nX0\n" * 2_000 + "M2\n")
    command = f"{sys.executable} -m fdhil interpret {program} {sink}"
    done = subprocess.run(["bash", "-o", "pipefail", "-c", command], capture_output=True, text=True, timeout=100)
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    assert done.returncode == (3 if sink == "> /dev/full" else 0)
    assert done.stderr.count("\n") == (sink == "> /dev/full")


def run_with_closed_stdout(*arguments: str | Path) -> int:
    read, write = os.pipe()
    os.close(read)
    try:
        done = subprocess.run(
            [sys.executable, "-m", "fdhil", *map(str, arguments)], stdout=write, stderr=subprocess.PIPE
        )
    finally:
        os.close(write)
    assert b"Traceback" not in done.stderr, done.stderr
    return done.returncode


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("form", [(), ("--json",)], ids=["text", "json"])
def test_undelivered_answer_exits_3(form: tuple[str, ...], tmp_path: Path) -> None:
    """Neither with fdhil's own output, nor with a table of rich, which raises another exception."""
    config, program, out = write_config(tmp_path), tmp_path / "part.ngc", tmp_path / "page.html"
    program.write_text("G21 G90\nG1 X1 F1000\nM2\n")
    for command in (
        ("doctor", config, "--offline"),
        ("audit", config),
        ("correct", program, "--config", config),
        ("advise", program, "--config", config, "--tolerance-um", "1"),
        ("acceptance", config, "--by", "somebody", "--out", out),
    ):
        assert run_with_closed_stdout(*command, *form) == 3, command
    assert run_with_closed_stdout("interpret", program, *form) == 0


def test_commands_with_exit_code_1_require_delivered_answer() -> None:
    """A command that returns or exits with a number must use the decorator."""
    for name, command in iterate_commands(cli):
        assert command.callback is not None
        body = inspect.getsource(inspect.unwrap(command.callback))
        marked = (
            Path(command.callback.__code__.co_filename).name == "cli_errors.py" or "@require_delivered_answer" in body
        )
        answers = inspect.signature(command.callback).return_annotation == "int" or "exit(1)" in body
        assert marked or not answers, name


@pytest.mark.usefixtures("processes")
def test_unknown_completion_shell_fails() -> None:
    for shell, code in (("bash", 0), ("foo", 1)):
        asked = os.environ | {"_FDHIL_COMPLETE": f"{shell}_source"}
        assert (
            subprocess.run([Path(sys.executable).with_name("fdhil")], env=asked, stdout=subprocess.DEVNULL).returncode
            == code
        )


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize(
    "arguments",
    [("acceptance", "machine.toml", "--by"), ("interpret",), ("history", "machine.toml", "--json", "--axis")],
)
def test_undecodable_argument_is_reported(arguments: tuple[str, ...], tmp_path: Path) -> None:
    write_config(tmp_path)
    command = [sys.executable, "-m", "fdhil", *arguments, os.fsdecode(b"k\xe4se")]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=100)
    assert done.returncode == 2
    assert "'k\\udce4se' is not valid text" in (
        json.loads(done.stdout)["error"]["text"] if done.stdout else done.stderr
    )
    assert "Traceback" not in done.stderr


def run_in_shell(command: str, redirected: str) -> tuple[int, str]:
    line = f"{sys.executable} -m fdhil {command} {redirected}"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, timeout=100)
    return done.returncode, done.stderr


@pytest.mark.usefixtures("processes")
def test_closed_stdin_reads_as_ended(tmp_path: Path) -> None:
    path = write_config(tmp_path)
    path.write_text(path.read_text() + '[web]\nusers_file = "users.json"\n')
    for command, word in (
        (f"init {tmp_path}/new.toml --offline", "--answers FILE"),
        (f"web-user {path} bob", "password"),
    ):
        code, err = run_in_shell(command, "<&-")
        assert (code, "Traceback" in err) == (2, False), err
        assert word in err
    assert not (tmp_path / "new.toml").exists()


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize(("command", "code"), [("interpret absent.ngc", 3), ("predict", 2), ("run absent.toml", 2)])
def test_full_stderr_keeps_exit_code(command: str, code: int) -> None:
    assert run_in_shell(command, "2> /dev/full")[0] == code


@pytest.mark.usefixtures("real_time")
def test_bus_without_drives_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hub = HubThread(TcpHub("can0"))
    hub.start()
    try:
        port = hub.hub.settings["port"]
        config = write_config(tmp_path, bus=f'interface = "socketcand"\nport = {port}')
        assert_error(fdhil("scan", config, capsys=capsys), 3, "no node sent a frame and none answered")
        code, _, err = fdhil("commission", config, "--yes", capsys=capsys)
        assert code == 3
        assert "no frame was received on the bus and node-ID 1 did not answer" in err
    finally:
        hub.stop()


def test_missing_sensor_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hub = HubThread(TcpHub("can0"))
    hub.start()
    try:
        bus = f'interface = "socketcand"\nport = {hub.hub.settings["port"]}'
        sensor = 'source = "modbus"\nport = 1\ntimeout_s = 0.3'
        config = write_config(tmp_path, bus=bus, axes="X", voltage=sensor)
        assert_error(fdhil("run", config, capsys=capsys), 3, "127.0.0.1:1 cannot be reached")
    finally:
        hub.stop()


def test_demo_without_writable_folder_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    message = fdhil("demo", "--out", tmp_path / "file" / "out", capsys=capsys)
    assert_error(message, 3, "cannot be created: Not a directory; choose another --out")
