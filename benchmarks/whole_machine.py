"""The daemon beside the twin in real time: how many frames came, how many were lost, what each process cost.

python -m benchmarks.whole_machine [SECONDS]
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
import tomllib
from pathlib import Path

from fdhil.cli.demo import loop
from fdhil.cli.demo.processes import ChildProcess, SimulatorProcess
from fdhil.cli.demo.toml_writer import format_toml
from fdhil.daemon.daemon_socket import SOCKET_NAME, ask_daemon
from fdhil.errors import FdhilError

PROGRAM = "G21 G90\n" + "G0 X300 Y300\nG4 P0.3\nG0 X0 Y0\nG4 P0.3\n" * 100 + "M2\n"


def cpu_s(pid: int) -> float:
    """Return the processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text("utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    """Let the NC shuttle in real time while the daemon listens and identifies, and print what was counted."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 60.0
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        document = tomllib.loads(Path(loop.__file__).with_name("machine.toml").read_text("utf-8"))
        document["sim"]["pace"] = "realtime"
        (out / "twin.toml").write_text(format_toml(document), "utf-8")
        (out / "shuttle.ngc").write_text(PROGRAM, "utf-8")
        with SimulatorProcess(out / "twin.toml", out / "twin.log") as twin:
            place = twin.ready["buses"]["can0"]
            document["bus"] = {"can0": {"interface": "socketcand", "port": place["port"]}}
            (out / "machine.toml").write_text(format_toml(document), "utf-8")
            with ChildProcess("daemon", ["fdhil", "run", str(out / "machine.toml")], out / "daemon.log") as daemon:
                _measure(twin, daemon, out, seconds)


def _status(out: Path) -> dict[str, object] | None:
    try:
        return ask_daemon(out / "data" / "run" / SOCKET_NAME, {"request": "status"})
    except FdhilError:
        return None


def _measure(twin: SimulatorProcess, daemon: ChildProcess, out: Path, seconds: float) -> None:
    while _status(out) is None:
        daemon.check_running()
        time.sleep(0.1)
    twin.send_command("nc", on=True)
    twin.await_event("nc", 30.0)
    twin.send_command("play", file=str(out / "shuttle.ngc"))
    twin.await_event("playing", 30.0)
    before, start = _status(out), time.monotonic()
    cpu = {process.name: cpu_s(process.pid) for process in (twin, daemon)}
    time.sleep(seconds)
    after, took = _status(out), time.monotonic() - start
    assert before is not None
    assert after is not None
    frames = [status["frames"] for status in (before, after)]
    assert all(isinstance(counted, dict) for counted in frames)
    received = frames[1]["received"] - frames[0]["received"]  # type: ignore[index]
    lost = frames[1]["lost"] - frames[0]["lost"]  # type: ignore[index]
    print(f"{took:.0f} s: {received} frames received ({received / took:.0f}/s), {lost} lost")
    for process in (twin, daemon):
        print(f"{process.name}: {100 * (cpu_s(process.pid) - cpu[process.name]) / took:.0f} % of a core")
    axes = after["axes"]
    assert isinstance(axes, dict)
    for name, axis in axes.items():
        print(f"axis {name}: {axis['accepted']} rapids accepted, {axis['refused']} refused")


if __name__ == "__main__":
    main()
