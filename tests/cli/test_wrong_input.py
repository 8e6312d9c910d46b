"""Wrong input to the commands as processes: one sentence, the right exit code, never a traceback."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from fdhil.sim.hub import Hub
from tests.sim.hub_thread import HubThread
from tests.sim.twin_process import write_config


def fdhil(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "fdhil", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=100)


def assert_told(done: subprocess.CompletedProcess[str], code: int, *words: str) -> None:
    """The exit code, the words, and no traceback."""
    said = done.stdout + done.stderr
    assert done.returncode == code, said
    assert "Traceback" not in said
    for word in words:
        assert word in said


def test_a_wrong_config_is_told_by_the_process_itself(tmp_path: Path) -> None:
    """One process for all of it: the sentence, the exit code, JSON alone on stdout, and no advice of a library."""
    path = write_config(tmp_path)
    path.write_text(path.read_text().replace("Cd = 5.0", "Cd = nan", 1))
    done = fdhil("run", path, "--json")
    assert (done.returncode, done.stderr) == (2, "")
    assert "finite" in json.loads(done.stdout)["error"]["text"]


@pytest.mark.parametrize("sink", ["> /dev/full", "| head -1", ">&-"])
def test_an_output_that_takes_nothing_is_no_traceback(sink: str, tmp_path: Path) -> None:
    """A full disk is trouble; a reader that has seen enough, or none at all, is not."""
    program = tmp_path / "part.ngc"
    program.write_text("G21 G90\n" + "G1 X10 F1000\nX0\n" * 20_000 + "M2\n")
    command = f"{sys.executable} -m fdhil interpret {program} {sink}"
    done = subprocess.run(["bash", "-o", "pipefail", "-c", command], capture_output=True, text=True, timeout=100)
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    assert done.returncode == (3 if sink == "> /dev/full" else 0)
    assert done.stderr.count("\n") == (sink == "> /dev/full")


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


def test_a_demo_without_a_place_for_its_files_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert_told(
        fdhil("demo", "--out", tmp_path / "file" / "out"), 3, "cannot be made: Not a directory; choose another --out"
    )
