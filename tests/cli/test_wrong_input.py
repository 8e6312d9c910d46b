"""Wrong input to the commands as their entry point runs them: one sentence, the right exit code, never a traceback.

A start of Python costs a second, so most run in this process; that a process does the same is shown once per command
that serves.
"""

from __future__ import annotations

import io
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

from fdhil.cli.main import cli, run_safely
from fdhil.sim.hub import Hub
from tests.sim.hub_thread import HubThread
from tests.sim.twin_process import write_config

Done = subprocess.CompletedProcess[str]


def fdhil(*arguments: object) -> Done:
    """Run a command line in this process as ``main`` does."""
    command = ["fdhil", *map(str, arguments)]
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.setattr("sys.argv", command)
        code = run_safely(cli)
    return subprocess.CompletedProcess(command, code, out.getvalue(), err.getvalue())


def process(*arguments: object) -> Done:
    """Run it as a process."""
    command = [sys.executable, "-m", "fdhil", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True)


def assert_told(done: Done, code: int, *words: str) -> None:
    """The exit code, the words, and no traceback."""
    said = done.stdout + done.stderr
    assert done.returncode == code, said
    assert "Traceback" not in said
    for word in words:
        assert word in said


@pytest.fixture
def port_in_use() -> Iterator[int]:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        yield int(listener.getsockname()[1])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("screw_pitch_mm", "screw_pich_mm", ("axis.X.screw_pich_mm: is no key", "did you mean 'screw_pitch_mm'?")),
        ("screw_pitch_mm", "screw_pitch", ("axis.X.screw_pitch: is no key", "did you mean 'screw_pitch_mm'?")),
        ("Cd = 5.0", "Cd = nan", ("axis.X.nominal.Cd", "finite")),
        ("[machine]", "[machine", ("is no TOML",)),
    ],
    ids=["typo", "missing unit", "nan", "no toml"],
)
@pytest.mark.parametrize("command", ["sim", "run"])
def test_a_wrong_config_tells_where(command: str, old: str, new: str, words: tuple[str, ...], tmp_path: Path) -> None:
    path = write_config(tmp_path)
    path.write_text(path.read_text().replace(old, new, 1))
    assert_told(fdhil(command, path), 2, *words)


def test_a_port_in_use_is_told(port_in_use: int, tmp_path: Path) -> None:
    config = write_config(tmp_path, bus=f'interface = "socketcand"\nport = {port_in_use}')
    assert_told(process("sim", config), 3, str(port_in_use))


def test_a_hub_that_is_not_there_is_told(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    assert_told(process("run", write_config(tmp_path, bus=f'interface = "socketcand"\nport = {port}')), 3, str(port))


def test_a_bus_without_drives_is_told(tmp_path: Path) -> None:
    hub = HubThread(Hub("can0"))
    hub.start()
    try:
        port = hub.hub.settings["port"]
        config = write_config(tmp_path, bus=f'interface = "socketcand"\nport = {port}')
        assert_told(fdhil("run", config), 3, "there is no drive on the bus")
    finally:
        hub.stop()


def test_a_sensor_that_is_not_there_is_told(tmp_path: Path) -> None:
    hub = HubThread(Hub("can0"))
    hub.start()
    try:
        bus = f'interface = "socketcand"\nport = {hub.hub.settings["port"]}'
        sensor = 'source = "modbus"\nport = 1\ntimeout_s = 0.3'
        assert_told(
            fdhil("run", write_config(tmp_path, bus=bus, axes="X", voltage=sensor)), 3, "127.0.0.1:1 cannot be reached"
        )
    finally:
        hub.stop()


@pytest.mark.parametrize("command", ["replay", "identify", "export"])
def test_a_recording_that_is_none_is_told(command: str, tmp_path: Path) -> None:
    path = tmp_path / ("window.parquet" if command != "identify" else "recording.csv")
    path.write_bytes(b"not a recording")
    options = ["--out", tmp_path / "out.csv"] if command == "export" else []
    assert_told(fdhil(command, path, *options), 3, str(path.name))
    assert path.read_bytes() == b"not a recording"


def test_a_program_with_an_unknown_word_is_told(tmp_path: Path) -> None:
    path = tmp_path / "part.ngc"
    path.write_text("G21 G90\nG1 X10 F1000\nG187 X3\nM2\n")
    assert_told(fdhil("interpret", path), 3, "line 3", "G187")


@pytest.mark.parametrize("command", ["status", "disarm"])
def test_a_daemon_that_does_not_run_is_told(command: str, tmp_path: Path) -> None:
    assert_told(fdhil(command, write_config(tmp_path)), 3, "is not running")


def test_a_demo_without_a_place_for_its_files_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert_told(
        fdhil("demo", "--out", tmp_path / "file" / "out"), 3, "cannot be made: Not a directory; choose another --out"
    )
