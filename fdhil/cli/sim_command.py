"""``fdhil sim``: simulate a machine in a separate process."""

from __future__ import annotations

import json
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil.cli.options import CONFIG, FILE, OutputFile, WritingCommand

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from fdhil.sim import SimulatorService

LINGER_S = 10.0
LOOK_S = 0.1
SHOW_S = 1.0
SHOWN_MM = 0.01  # smaller motion counts as standstill


@click.command(cls=WritingCommand)
@CONFIG
@click.option("--json", "as_json", is_flag=True, help="Write events as JSON lines to stdout; the first is 'ready'.")
@click.option("--faults", type=FILE, help="Fault script (TOML) with faults and their times.")
@click.option("--demand", type=FILE, help="Demand CSV to play at the start; - reads it row by row from standard input.")
@click.option("--program", type=FILE, help="NC program to play at the start.")
@click.option(
    "--trace", type=OutputFile(), help="Record reference, true table position and offset of the first motion (CSV)."
)
def sim(
    config: Path, as_json: bool, faults: Path | None, demand: Path | None, program: Path | None, trace: Path | None
) -> None:
    """Simulate the machine of CONFIG: drives, sensors and NC on a bus for any python-can program.

    The drives boot to pre-operational and only answer requests until the NC is switched on ([sim] nc = true, --demand,
    --program or the panel), or another master provides SYNC, NMT and set-points. Standard input is the operator's
    panel, one JSON object per line:

    \b
      {"command": "nc", "on": true}              {"command": "play", "file": "path.csv"}
      {"command": "feed_hold", "on": true}       {"command": "override", "percent": 50}
      {"command": "set", "axis": "X", "parameters": {"Jt": 0.085}}
      {"command": "temperature", "celsius": 22}  {"command": "fault", "axis": "X", "fault": "reboot"}
      {"command": "trace", "file": "trace.csv"}  {"command": "stop"}  {"command": "quit"}

    With --demand - these lines may be mixed with the rows. The NC starts with the first row and stands still while no
    row arrives. The simulator ends on quit, Ctrl-C or SIGTERM, but not at the end of standard input. On SIGUSR1 it ends
    once no client is on its buses, after 10 s at the latest.
    """
    if demand is not None and program is not None:
        raise click.UsageError("--demand and --program exclude each other; give only one of them")
    _run_simulator(config, as_json, faults, demand or program, trace)


def _run_simulator(path: Path, as_json: bool, script: Path | None, play: Path | None, trace: Path | None) -> None:
    import gc
    import signal

    from fdhil import config
    from fdhil.program import load_trajectory
    from fdhil.sim import SimulatorService, load_script

    machine = config.load_config(path)
    entries = [] if script is None else load_script(script, tuple(machine.axis))

    service = SimulatorService(
        machine,
        _print_json_event if as_json else _print_event,
        load_trajectory,
        panel_fd=_find_panel_descriptor(),
        faults=entries,
    )

    def stop_service(*_: object) -> None:
        service.stop()
        if not service.serving:
            raise KeyboardInterrupt

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, stop_service)
    signal.signal(signal.SIGUSR1, lambda *_: _stop_when_bus_is_free(service, stop_service))
    sys.setswitchinterval(0.0005)  # default 5 ms: SYNC would wait for the thread that serves the sensors
    if not as_json and sys.stderr.isatty():
        shown = PositionLine(lambda: {axis: unit.drive.table_mm for axis, unit in service.machine.units.items()})
        threading.Thread(target=_show_positions, args=(shown,), daemon=True).start()
    gc.freeze()  # permanent objects; keeps the collector short between two SYNCs
    service.run(play, trace)


class PositionLine:
    """The status line with the table positions while an axis moves."""

    def __init__(self, read_mm: Callable[[], Mapping[str, float]]) -> None:
        self._read_mm, self._shown_mm = read_mm, read_mm()
        self._moving = False

    def format_line(self) -> str | None:
        """Return the line while an axis moves and once after it stops; otherwise None."""
        now_mm = self._read_mm()
        moved = any(abs(mm - self._shown_mm[axis]) > SHOWN_MM for axis, mm in now_mm.items())
        self._shown_mm, due = now_mm, moved or self._moving
        self._moving = moved
        return "  ".join(f"{axis} {mm:.3f} mm" for axis, mm in now_mm.items()) if due else None


def _show_positions(shown: PositionLine) -> None:
    while True:
        time.sleep(SHOW_S)
        if line := shown.format_line():
            click.echo(line, err=True)


def _stop_when_bus_is_free(service: SimulatorService, stop: Callable[[], None]) -> None:
    # keep running until guard and daemon have left the bus, so that a correction can ramp to zero; at most LINGER_S
    import signal

    end_s = time.monotonic() + LINGER_S

    def check_bus(*_: object) -> None:
        if not service.has_clients or time.monotonic() > end_s:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            stop()

    signal.signal(signal.SIGALRM, check_bus)
    signal.setitimer(signal.ITIMER_REAL, LOOK_S, LOOK_S)


def _find_panel_descriptor() -> int | None:
    try:
        return sys.stdin.fileno()
    except (AttributeError, OSError, ValueError):
        return None


def _print_json_event(event: dict[str, Any]) -> None:
    click.echo(json.dumps(event))


def _print_event(event: dict[str, Any]) -> None:
    click.echo("\n".join(_format_event(event)))


def _format_event(event: dict[str, Any]) -> list[str]:
    match event["event"]:
        case "ready":
            return _format_ready_event(event)
        case "nc":
            return [f"NC {'on: it sends SYNC and has enabled the drives' if event['on'] else 'off'}"]
        case "playing":
            rows = "rows from standard input" if event["rows"] is None else f"{event['rows']} rows"
            return [f"playing {event['file']}, {rows}"]
        case "finished":
            late = ", ".join(f"{axis} {n}" for axis, n in event["late_rpdo"].items())
            how = "stopped after" if event["stopped"] else "finished"
            trace = f", recorded to {event['trace']}" if event["trace"] else ""
            missing = f"; {n} late rows" if (n := event.get("starved")) else ""
            return [f"{how} {event['rows']} rows of {event['file']}; late offset frames: {late}{missing}{trace}"]
        case "error":
            return [f"error: {event['text']}"]
    rest = ", ".join(f"{key} {value}" for key, value in event.items() if key != "event")
    return [f"{event['event']}: {rest}"]


def _format_ready_event(event: dict[str, Any]) -> list[str]:
    lines = ["the simulator is ready"]
    for name, bus in event["buses"].items():
        arguments = ", ".join(f"{key}={value!r}" for key, value in bus.items())
        load, worst = event["bus_load"][name], event["bus_load_worst"][name]
        lines.append(f"  bus {name}: can.Bus({arguments})")
        lines.append(f"  bus load of {name}: {load:.0%} at this SYNC period ({worst:.0%} with the most stuff bits)")
    for axis, drive in event["drives"].items():
        lines.append(f"  drive {axis}: node {drive['node_id']}, {drive['eds']}")
    for axis, m in event["modbus"].items():
        where = f"Modbus TCP {m['host']}:{m['port']}" if "port" in m else f"serial line {m['device']}"
        lines.append(f"  voltage sensor {axis}: {where}")
    return lines
