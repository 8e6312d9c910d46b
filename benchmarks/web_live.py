"""The live page of four axes at 1 kHz: what the web process and the daemon's stream cost, and whether a frame is lost.

python -m benchmarks.web_live [--minutes M]
"""

from __future__ import annotations

import argparse
import asyncio
import json
import tempfile
import threading
import time
import tomllib
from pathlib import Path
from typing import Any

from websockets.asyncio.client import connect

from benchmarks.whole_machine import cpu_s
from fdhil.cli.demo.processes import ChildProcess, SimulatorProcess
from fdhil.cli.demo.toml_writer import format_toml
from fdhil.daemon.daemon_socket import SOCKET_NAME, ask_daemon
from fdhil.errors import FdhilError
from studies.pages import ROOT

ROUND = "G0 X300 Y300 Z300\nG4 P0.3\nG0 X0 Y0 Z0\nG4 P0.3\n"
ROUND_S = 1.5  # at least
WITHOUT_S = 20.0
SECONDS, COLUMNS = 10.0, 700  # what the page shows first on a desk's screen


class Viewer:
    """A browser of the live page as the server sees it: it takes every message and says that it has drawn it."""

    def __init__(self, url: str) -> None:
        self.url = url.replace("http", "ws", 1) + f"/api/live/stream?seconds={SECONDS}&columns={COLUMNS}"
        self.ticks: dict[str, int] = {}
        self.messages = self.bytes = self.coarser = self.skipped_ticks = self.skipped_lines = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._look()), daemon=True)

    async def _look(self) -> None:
        async with connect(self.url, subprotocols=["fdhil"]) as socket:  # type: ignore[list-item]
            begin = json.loads(await socket.recv())
            while not self._stop.is_set():
                message = await socket.recv()
                assert isinstance(message, bytes)
                header = json.loads(message[4 : 4 + int.from_bytes(message[:4], "little")])
                self._count(header, len(message), begin["ticks_per_column"])
                await socket.send(json.dumps({"drawn": header["number"]}))

    def _count(self, header: dict[str, Any], size: int, per_column: int) -> None:
        self.messages += 1
        self.bytes += size
        self.skipped_lines = header["skipped_lines"]
        for part in header["parts"]:
            self.ticks[part["axis"]] = self.ticks.get(part["axis"], 0) + part["columns"] * part["per_column"]
            self.skipped_ticks += part["skipped_ticks"]
            self.coarser += part["per_column"] > per_column

    def __enter__(self) -> Viewer:
        self._thread.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._stop.set()
        self._thread.join(30.0)


def machine() -> dict[str, Any]:
    """Return configs/four-axes.toml at 1 kHz: two buses, as one of 1 Mbit/s does not carry them."""
    document = tomllib.loads((ROOT / "configs" / "four-axes.toml").read_text("utf-8"))
    document["machine"]["sync_period_s"] = 0.001
    document["store"] = {"run_directory": "run"}
    document["bus"] = {
        name: {"interface": "socketcand", "channel": name, "host": "127.0.0.1", "port": 0} for name in ("can0", "can1")
    }
    for k, axis in enumerate(document["axis"].values()):
        axis["drive"]["bus"] = f"can{k // 2}"
        del axis["voltage"]["port"]
    return document


def memory_mb(pid: int) -> float:
    """Return what a process holds in memory."""
    lines = Path(f"/proc/{pid}/status").read_text("utf-8").splitlines()
    return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) / 1024


def status(out: Path) -> dict[str, Any] | None:
    """Return the daemon's status, None while there is none."""
    try:
        return ask_daemon(out / "run" / SOCKET_NAME, {"request": "status"}, timeout_s=60.0)
    except FdhilError:
        return None


def main() -> None:
    """Let the NC shuttle while the daemon listens and a viewer looks on, and print what was counted."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--minutes", type=float, default=1.0)
    seconds = 60 * options.parse_args().minutes
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        document = machine()
        (out / "twin.toml").write_text(format_toml(document), "utf-8")
        rounds = round((seconds + WITHOUT_S + 60) / ROUND_S)
        (out / "shuttle.ngc").write_text("G21 G90\n" + ROUND * rounds + "M2\n", "utf-8")
        with SimulatorProcess(out / "twin.toml", out / "twin.log") as twin:
            for name, place in twin.ready["buses"].items():
                document["bus"][name]["port"] = place["port"]
            (out / "machine.toml").write_text(format_toml(document), "utf-8")
            with ChildProcess("daemon", ["fdhil", "run", str(out / "machine.toml")], out / "daemon.log") as daemon:
                while status(out) is None:
                    daemon.check_running()
                    time.sleep(0.1)
                twin.send_command("nc", on=True)
                twin.await_event("nc", 60.0)
                twin.send_command("play", file=str(out / "shuttle.ngc"))
                twin.await_event("playing", 120.0)
                command = ["fdhil", "web", str(out / "machine.toml"), "--port", "0", "--json"]
                with ChildProcess("web", command, out / "web.log") as web:
                    url = web.await_event("ready")["url"]
                    measure(out, (twin, daemon, web), url, seconds)


def measure(out: Path, processes: tuple[ChildProcess, ChildProcess, ChildProcess], url: str, seconds: float) -> None:
    """Measure without a viewer, then with one, and print both."""
    _, daemon, web = processes
    time.sleep(5.0)
    before = part(out, processes, WITHOUT_S)
    with Viewer(url) as viewer:
        time.sleep(5.0)
        seen, messages, size, began_mb = dict(viewer.ticks), viewer.messages, viewer.bytes, memory_mb(web.pid)
        during = part(out, processes, seconds)
        ticks = {axis: viewer.ticks[axis] - seen[axis] for axis in viewer.ticks}
        messages, size = viewer.messages - messages, viewer.bytes - size
    rate_hz = max(ticks.values()) / during["took_s"]
    print(
        f"4 axes on 2 buses, {rate_hz:.0f} SYNC/s, {during['took_s']:.0f} s: {during['frames']} frames received,",
        end=" ",
    )
    print(f"{during['lost']} lost; {during['dropped']} records dropped (wanted: 0 and 0)")
    if during["missed"]:  # a twin that stands still for a quarter of a second looks like a whole turn of SYNC's counter
        print(f"besides, SYNC's counter went on by {during['missed']} where a stalled host let the twin stand still")
    for k, process in enumerate(processes):
        print(f"{process.name}: {during['cpu'][k]:.1f} % of a core, without a viewer {before['cpu'][k]:.1f} %", end="")
        print(" (wanted: <= 10 %)" if process is web else "")
    print(f"web process: {began_mb:.0f} MB after 5 s, {memory_mb(web.pid):.0f} MB at the end", end="; ")
    print(f"daemon {memory_mb(daemon.pid):.0f} MB")
    print(f"viewer: {messages} messages, {size / during['took_s'] / 1000:.1f} kB/s; ticks drawn of each axis", end=" ")
    print(f"{min(ticks.values())} to {max(ticks.values())};", end=" ")
    print(f"skipped {viewer.skipped_ticks}, coarser {viewer.coarser}, lost by the web process {viewer.skipped_lines}")


def part(out: Path, processes: tuple[ChildProcess, ...], seconds: float) -> dict[str, Any]:
    """Let it run for so long; return what was counted meanwhile."""
    start, cpu, first = time.monotonic(), [cpu_s(process.pid) for process in processes], status(out)
    while time.monotonic() - start < seconds:
        time.sleep(min(1.0, seconds))
        for process in processes:
            process.check_running()
    took, last = time.monotonic() - start, status(out)
    assert first is not None
    assert last is not None
    used = [100 * (cpu_s(process.pid) - began) / took for process, began in zip(processes, cpu, strict=True)]
    received, lost = (last["frames"][key] - first["frames"][key] for key in ("received", "lost"))
    missed = _missed(last) - _missed(first)
    counted = {"frames": received, "lost": lost - missed, "missed": missed}
    dropped = last["counters"]["records_dropped"] - first["counters"]["records_dropped"]
    return {"took_s": took, "cpu": used, "dropped": dropped, **counted}


def _missed(told: dict[str, Any]) -> int:
    return sum(count for name, count in told["counters"].items() if name.endswith(".sync_missed"))


if __name__ == "__main__":
    main()
