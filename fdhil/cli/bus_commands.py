"""``fdhil scan`` and ``check``: list the nodes of a bus, and compare them with the configuration. Nothing moves."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil import config as machine_config
from fdhil.cli.cli_errors import require_delivered_answer
from fdhil.cli.options import AS_JSON, CONFIG, FILE
from fdhil.cli.terminal_text import print_progress
from fdhil.errors import DeviceError
from fdhil.guard import SOCKET_NAME

if TYPE_CHECKING:
    from fdhil.commissioning import BusScan, DeviceDescription, Mark, Place, ScannedNode
    from fdhil.config import MachineConfig

ReportToGuard = Callable[[Mapping[str, str]], Sequence[Mapping[str, str]] | None]
SCAN_HEAD = ("node\naxis", "NMT state\nheartbeat", "device\nprofile", "vendor\nproduct", "revision\nserial", "EDS")
STATES: Mapping[bool | None, tuple[str, str]] = {
    True: ("ok", "green"),
    False: ("differs", "red"),
    None: ("not compared", "yellow"),
}


@click.command()
@CONFIG
@click.option("--eds", "places", multiple=True, type=FILE,
              help="EDS or DCF file, or folder of such files (default: the folder of CONFIG).")  # fmt: skip
@AS_JSON
def scan(config: Path, places: tuple[Path, ...], as_json: bool) -> None:
    """List the nodes on CONFIG's CAN buses: identity, name, NMT state, heartbeat, matching EDS.

    Listens for some seconds, then reads by SDO. If an NC runs the bus (SYNC, NMT commands, set-points or SDO requests
    are received), nothing is sent, and the list contains only what was received.
    """
    machine = machine_config.load_config(config)
    from fdhil.commissioning import scan_bus  # late: --help imports nothing heavy

    descriptions = _read_eds_files(places, config.parent)
    scans = []
    for name in machine.bus:
        print_progress(f"listening on bus {name}, then querying the nodes")
        scans.append(scan_bus(name, machine, descriptions))
    if as_json:
        click.echo(json.dumps({"schema": "fdhil-scan-1", "buses": [asdict(found) for found in scans]}))
    else:
        _show_scans(scans)


def _read_eds_files(places: Sequence[Path], folder: Path) -> list[DeviceDescription]:
    # a named file must be readable; an unreadable one in the default folder is only reported
    from fdhil.commissioning import read_descriptions

    found, faults = read_descriptions(places or [folder])
    if faults and places:
        raise faults[0]
    for fault in faults:
        print_progress(f"not used: {fault}")
    return found


def _show_scans(scans: Sequence[BusScan]) -> None:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    from fdhil.cli.status_view import open_console

    out = open_console()
    for found in scans:
        nc = f"an NC runs it ({found.master} received), so no node was queried" if found.master else "no NC is active"
        period = f", SYNC every {found.sync_period_s * 1e3:.3f} ms" if found.sync_period_s else ""
        out.print(Text(f"bus {found.bus}: {nc}{period}; {len(found.nodes)} nodes"))
        table = Table(*SCAN_HEAD, box=box.SIMPLE_HEAD, pad_edge=False)
        for node in found.nodes:
            table.add_row(*map(Text, _format_node_row(node, "not queried" if found.master else "no answer")))
        out.print(table)
        for node in found.nodes:
            for emergency in node.emergencies:
                out.print(Text(f"node {node.node_id} reports {emergency}"), soft_wrap=True)


def _format_node_row(node: ScannedNode, unanswered: str) -> list[str]:
    """Return the cells of a node, most with two lines, so that a row fits 80 columns."""
    period = node.heartbeat_s or (node.answers.heartbeat_s if node.answers else None)
    beat = f"{period * 1e3:.0f} ms" if period else "none"
    seen = [f"{node.node_id}\n{node.axis or ''}", f"{node.nmt or 'unknown'}\n{beat}"]
    if node.answers is None:
        return [*seen, unanswered, "", "", ""]
    answers, who = node.answers, node.answers.identity
    number = answers.device_type & 0xFFFF
    profile = f"CiA {number}" if number else "none"
    eds = f"{answers.eds.file}\n({answers.eds.fit})" if answers.eds else "no match"
    ids = (f"{who.vendor_id:08X}\n{who.product_code:08X}", f"{who.revision:08X}\n{who.serial}")
    return [*seen, f"{answers.name or 'unnamed'}\n{profile}", *ids, eds]


@click.command()
@CONFIG
@AS_JSON
@require_delivered_answer
def check(config: Path, as_json: bool) -> int:
    """Compare the drives on the bus with CONFIG: identity, PDO mapping, scales, cycle, rapid signal, sensors.

    Each point is ok, differs (with expected value, found value and next action), or was not compared. Only listens and
    reads. If an NC runs the bus, it only listens, and points that need an SDO request are not compared.
    """
    machine = machine_config.load_config(config)
    from fdhil.commissioning import check_machine, read_void_mark

    marks = {axis: read_void_mark(machine.store.directory, axis) for axis in machine.axis}
    with _connect_guard(machine) as tell:
        found = check_machine(machine, print_progress)
        _record_comparison(machine, found, tell, marks)
    differ = sum(finding.ok is False for _, finding in found)
    if as_json:
        click.echo(json.dumps(_build_check_document(found)))
    else:
        _show_check(found)
    return int(differ > 0)


def _record_comparison(
    machine: MachineConfig, found: Sequence[Place], tell: ReportToGuard, marks: Mapping[str, Mark | None]
) -> None:
    """Confirm the records of drives that match their commissioning, void the others, and inform a running guard.

    A doubt that arose after the comparison remains: in the guard, and in a mark that differs from ``marks``.
    """
    from fdhil.commissioning import RECORD_POINT, clear_void_mark, is_record_void, mark_record_void

    directory, seen = machine.store.directory, {}
    for place, finding in found:
        if finding.point == RECORD_POINT:
            axis = place.removeprefix("axis ")
            seen[axis] = finding.found if finding.ok else ""
            if not finding.ok:
                mark_record_void(directory, axis, finding.cause)
    answer = tell(seen) if seen else []
    if answer is None:
        return
    refused = [each for each in answer if seen.get(each["axis"]) != ""]
    for each in refused:
        advice = "run fdhil check again; where it is refused again, stop fdhil-guard and start it again"
        click.echo(f"{each['code']}: {each['text']}; {advice}", err=True)
    if not all(each["axis"] for each in refused):  # the guard accepted none of it
        return
    for axis in {axis for axis, digest in seen.items() if digest} - {each["axis"] for each in refused}:
        clear_void_mark(directory, axis, marks[axis])
        if is_record_void(directory, axis):
            text = "its drive changed again after the comparison, so its record stays void"
            click.echo(f"RecordVoid: axis {axis}: {text}; run fdhil check again", err=True)


@contextmanager
def _connect_guard(machine: MachineConfig) -> Iterator[ReportToGuard]:
    """Read from a running guard how often each drive was touched, and yield a function that reports the comparison.

    That function returns the refusals of the guard, or None if the guard ended before it could answer. The connection
    stays open meanwhile, because a restarted guard would not know the earlier counts.
    """
    from fdhil.arming import GuardClient, get_operator_token

    def report_to_guard(seen: Mapping[str, str]) -> Sequence[Mapping[str, str]] | None:
        try:
            return guard.report_comparison(token, seen, touched).get("refused", []) if touched is not None else []
        except DeviceError as error:
            click.echo(f"the guard could not be informed; void records stay void: {error}", err=True)
            return None

    directory, touched = machine.guard_directory, None
    with ExitStack() as held:
        if (directory / SOCKET_NAME).exists():
            try:
                token = get_operator_token(machine.run_directory)
                guard = held.enter_context(GuardClient(directory))
                touched = guard.read_touch_counts(token)
            except DeviceError as error:
                click.echo(f"the guard could not be informed: {error}", err=True)
        yield report_to_guard


def _build_check_document(found: Sequence[Place]) -> dict[str, Any]:
    points = [
        {
            "place": place,
            "point": finding.point,
            "state": STATES[finding.ok][0],
            "expected": finding.expected,
            "found": finding.found,
            "cause": "" if finding.ok else finding.cause,
            "advice": "" if finding.ok else finding.advice,
        }
        for place, finding in found
    ]
    return {
        "schema": "fdhil-check-1",
        "matches": all(finding.ok is not False for _, finding in found),
        "complete": all(finding.ok is not None for _, finding in found),
        "points": points,
    }


def _show_check(found: Sequence[Place]) -> None:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    from fdhil.cli.status_view import open_console

    out = open_console()
    table = Table("", "point", "result", "expected", "found", box=box.SIMPLE_HEAD, pad_edge=False)
    for place, finding in found:
        state, colour = STATES[finding.ok]
        row = (place, finding.point, Text(state, colour), finding.expected, finding.found)
        table.add_row(*(cell if isinstance(cell, Text) else Text(cell) for cell in row))
    out.print(table)
    for place, finding in found:
        if finding.ok is False:
            out.print(Text(f"{place}: {finding.cause}; {finding.advice}"), soft_wrap=True)
    for (place, cause, advice), points in _group_open_points(found).items():
        out.print(Text(f"{place}: {', '.join(points)} not compared: {cause}; {advice}"), soft_wrap=True)
    differ, open_ = (sum(finding.ok is state for _, finding in found) for state in (False, None))
    rest = f", {open_} could not be compared" if open_ else ""
    out.print(f"{len(found) - differ - open_} points ok, {differ} differ{rest}")


def _group_open_points(found: Sequence[Place]) -> dict[tuple[str, str, str], list[str]]:
    points: dict[tuple[str, str, str], list[str]] = {}
    for place, finding in found:
        if finding.ok is None:
            points.setdefault((place, finding.cause, finding.advice), []).append(finding.point)
    return points
