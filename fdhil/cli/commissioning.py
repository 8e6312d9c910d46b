"""``fdhil scan``, ``check`` and ``commission``: list a bus, compare it with the config, and set its drives up."""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil import config as machine_config
from fdhil.errors import ConfigError, ConfigFault, DeviceError, DriveFault
from fdhil.guard.protocol import SOCKET_NAME

if TYPE_CHECKING:
    from fdhil.commissioning.config_check import Place
    from fdhil.commissioning.scan import BusScan, Description, Node
    from fdhil.config import MachineConfig

CONFIG = click.argument("config", type=click.Path(path_type=Path))
AS_JSON = click.option("--json", "as_json", is_flag=True, help="Write one JSON document to stdout and nothing else.")
SCAN_HEAD = ("node\naxis", "NMT state\nheartbeat", "device\nprofile", "vendor\nproduct", "revision\nserial", "EDS")
STATES: Mapping[bool | None, tuple[str, str]] = {
    True: ("ok", "green"),
    False: ("differs", "red"),
    None: ("not compared", "yellow"),
}
STEPS: Mapping[str, str] = {
    "listen": "Listening: the NC must be off. A bus on which nothing is heard is asked whether the drive is there; "
    "nothing else is sent.",
    "compare": "Reading identity, PDO mapping, scale, option codes and following-error window, and comparing them with "
    "the config. Nothing moves.",
    "enable": "Starting SYNC and switching the drive on, held where it stands.",
    "sign test": "Moving the axis by +10 um with the offset 0x60B0: it must be held, added to the demand, and the "
    "position must follow, in this direction and by this much.",
    "feed-forward test": "Ramping the offset to and fro: does its slope reach the speed feed-forward? The correction "
    "depends on the answer.",
    "watchdog test": "Sending our heartbeat, then keeping it back: the drive must stop by itself, as it must when "
    "fdhil dies.",
    "restore": "Taking the offset to zero, switching the drive off and giving back what was changed.",
}
FEEDFORWARD: Mapping[bool | None, str] = {
    True: "the speed feed-forward sees the offset",
    False: "the speed feed-forward does not see the offset",
    None: "whether the speed feed-forward sees the offset could not be told, and arming will be refused",
}


@click.command()
@CONFIG
@click.option("--eds", "places", multiple=True, type=click.Path(path_type=Path),
              help="EDS or DCF file, or a folder of them; left out: the folder of CONFIG.")  # fmt: skip
@AS_JSON
def scan(config: Path, places: tuple[Path, ...], as_json: bool) -> None:
    """List what is on the CAN buses of CONFIG: node-IDs, identity, device name, NMT state, heartbeat, fitting EDS.

    Listens for some seconds and then only reads, by SDO. Where an NC runs the bus (SYNC, NMT commands, set-points or
    SDO requests are heard) nothing at all is sent, and the list holds what was heard. Exit codes: 0 something was
    found, 2 wrong option or configuration, 3 a bus cannot be reached or nothing is on it.
    """
    machine = machine_config.load(config)
    from fdhil.commissioning.scan import scan_bus  # late: --help imports nothing heavy

    descriptions = _descriptions(places, config.parent)
    scans = []
    for name in machine.bus:
        _progress(f"listening on bus {name}, then asking the nodes")
        scans.append(scan_bus(name, machine, descriptions))
    if as_json:
        click.echo(json.dumps({"schema": "fdhil-scan-1", "buses": [asdict(found) for found in scans]}))
    else:
        _show_scans(scans)


def _descriptions(places: Sequence[Path], folder: Path) -> list[Description]:
    """Read the EDS files; one that was named must be readable, of those that only lie there it is told."""
    from fdhil.commissioning.scan import read_descriptions

    found, faults = read_descriptions(places or [folder])
    if faults and places:
        raise faults[0]
    for fault in faults:
        _progress(f"not used: {fault}")
    return found


def _progress(text: str) -> None:
    if sys.stderr.isatty():
        click.echo(text, err=True)


def _show_scans(scans: Sequence[BusScan]) -> None:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    from fdhil.cli.status_view import open_console

    out = open_console()
    for found in scans:
        nc = f"an NC runs it ({found.master} heard), so no node was asked" if found.master else "no NC is heard"
        period = f", SYNC every {found.sync_period_s * 1e3:.3f} ms" if found.sync_period_s else ""
        out.print(Text(f"bus {found.bus}: {nc}{period}; {len(found.nodes)} nodes"))
        table = Table(*SCAN_HEAD, box=box.SIMPLE_HEAD, pad_edge=False)
        for node in found.nodes:
            table.add_row(*map(Text, _node_row(node, "not asked" if found.master else "no answer")))
        out.print(table)
        for node in found.nodes:
            for emergency in node.emergencies:
                out.print(Text(f"node {node.node_id} reports {emergency}"), soft_wrap=True)


def _node_row(node: Node, unanswered: str) -> list[str]:
    """Return the cells of a node, two figures above each other in most, so that a row fits 80 columns."""
    period = node.heartbeat_s or (node.answers.heartbeat_s if node.answers else None)
    beat = f"{period * 1e3:.0f} ms" if period else "none"
    heard = [f"{node.node_id}\n{node.axis or ''}", f"{node.nmt or 'unknown'}\n{beat}"]
    if node.answers is None:
        return [*heard, unanswered, "", "", ""]
    said, who = node.answers, node.answers.identity
    number = said.device_type & 0xFFFF
    profile = f"CiA {number}" if number else "none"
    eds = f"{said.eds.file}\n({said.eds.fit})" if said.eds else "none fits"
    ids = (f"{who.vendor_id:08X}\n{who.product_code:08X}", f"{who.revision:08X}\n{who.serial}")
    return [*heard, f"{said.name or 'unnamed'}\n{profile}", *ids, eds]


@click.command()
@CONFIG
@AS_JSON
def check(config: Path, as_json: bool) -> int:
    """Check that the machine on the bus is the one in CONFIG: identity, mapping, scales, cycle, rapid signal, sensors.

    Each point is ok, differs (with what was expected, what was found and what to do), or could not be compared. Only
    listens and reads; where an NC runs the bus it only listens, and what belongs to the NC's SDO channel is not
    compared. Exit codes: 0 nothing differs, 1 something does, 2 wrong option or configuration, 3 a bus cannot be
    reached.
    """
    machine = machine_config.load(config)
    from fdhil.commissioning.config_check import check_machine

    found = check_machine(machine, _progress)
    _tell_compared(machine, found)
    differ = sum(finding.ok is False for _, finding in found)
    if as_json:
        click.echo(json.dumps(_check_document(found)))
    else:
        _show_check(found)
    return int(differ > 0)


def _tell_compared(machine: MachineConfig, found: Sequence[Place]) -> None:
    """Drives that are as they were commissioned have their records hold again, others void; a running guard is told."""
    from fdhil.commissioning.compare import POINT
    from fdhil.commissioning.void import confirm_record, void_record

    directory, seen = machine.store.directory, {}
    for place, finding in found:
        if finding.point == POINT:
            axis = place.removeprefix("axis ")
            seen[axis] = finding.found if finding.ok else ""
            if not finding.ok:
                void_record(directory, axis, finding.cause)
    refused = _guard_told(machine, seen)
    for axis, digest in seen.items():
        if digest and axis not in refused:
            confirm_record(directory, axis)


def _guard_told(machine: MachineConfig, seen: Mapping[str, str]) -> set[str]:
    """Tell the guard, where one runs, which drives were compared; return the axes whose records stay void there."""
    from fdhil.arming.guard_client import GuardClient
    from fdhil.arming.token import operator_token

    directory = machine.guard_directory
    if not seen or not (directory / SOCKET_NAME).exists():
        return set()
    try:
        with GuardClient(directory) as guard:
            answer = guard.compared(operator_token(machine.run_directory), seen)
    except DeviceError as error:
        click.echo(f"the guard was not told: {error}", err=True)
        return set()
    told = [each for each in answer.get("refused", []) if seen.get(each["axis"]) != ""]
    for each in told:
        click.echo(f"{each['code']}: {each['text']}; stop fdhil-guard and start it again", err=True)
    return {each["axis"] for each in told}


def _check_document(found: Sequence[Place]) -> dict[str, Any]:
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
    for (place, cause, advice), points in _open_points(found).items():
        out.print(Text(f"{place}: {', '.join(points)} not compared: {cause}; {advice}"), soft_wrap=True)
    differ, open_ = (sum(finding.ok is state for _, finding in found) for state in (False, None))
    rest = f", {open_} could not be compared" if open_ else ""
    out.print(f"{len(found) - differ - open_} points ok, {differ} differ{rest}")


def _open_points(found: Sequence[Place]) -> dict[tuple[str, str, str], list[str]]:
    """The points that could not be compared, by place and reason."""
    points: dict[tuple[str, str, str], list[str]] = {}
    for place, finding in found:
        if finding.ok is None:
            points.setdefault((place, finding.cause, finding.advice), []).append(finding.point)
    return points


@click.command()
@CONFIG
@click.option("--axis", "only", help="Commission this axis; left out: all, one after the other.")
@click.option(
    "--set-pdos", is_flag=True, help="Write the PDOs of the drives' profiles, save them in the drives; no more."
)
@click.option("--yes", is_flag=True, help="Do not ask before an axis moves, or PDOs are written.")
@AS_JSON
def commission(config: Path, only: str | None, set_pdos: bool, yes: bool, as_json: bool) -> int:
    """Commission the drives of CONFIG, step by step: what arming a correction asks for.

    The NC must be off, the axis free to move a tenth of a millimetre, and the machine's own safety functions effective.
    Reads and compares the drive's set-up, asks, switches the drive on, moves the axis by 10 um, finds out where the
    offset acts, proves the drive's watchdog, and writes the signed record into the store. Whatever fails, also Ctrl-C,
    the offset goes back to zero and the drive is switched off. With --set-pdos nothing moves: what differs from the
    profile in the drive's PDOs is written and saved, and that is all. Exit codes: 0 commissioned, 1 refused, by you or
    because the drive is not set up as it must be, 2 wrong option or configuration, 3 the drive or the bus cannot be
    reached.
    """
    machine = machine_config.load(config)
    axes = [only] if only else list(machine.axis)
    if axes[0] not in machine.axis:
        fault = ConfigFault("--axis", f"there is no axis {only}", f"one of {', '.join(machine.axis)}")
        raise ConfigError(str(config), [fault])
    done: dict[str, Any] = {}
    refused = None
    with _stopped_like_ctrl_c():
        for axis in axes:
            try:
                step = _set_pdos if set_pdos else _commission_axis
                done[axis] = step(machine, axis, yes, as_json)
            except DriveFault as fault_found:
                refused = str(fault_found)
                break
    if as_json:
        click.echo(json.dumps({"schema": "fdhil-commission-1", "axes": done, "refused": refused}))
    if refused is not None:
        click.echo(f"refused: {refused}", err=True)
    return int(refused is not None)


@contextmanager
def _stopped_like_ctrl_c() -> Iterator[None]:
    """A terminal that closes, or a kill, must leave the drive as Ctrl-C does: offset zero, switched off."""
    before = {number: signal.signal(number, signal.default_int_handler) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _commission_axis(machine: MachineConfig, axis: str, yes: bool, quiet: bool) -> dict[str, Any]:
    """Run all steps for one axis and save its record; DriveFault when it is refused."""
    from fdhil.cli.bus_lock import lock_bus
    from fdhil.commissioning import steps
    from fdhil.commissioning.record import save_record

    with lock_bus(machine.bus[machine.axis[axis].drive.bus]):  # the guard reads the record when it starts
        record = steps.commission(machine, axis, _guide(machine, axis, yes, quiet))
    path = save_record(record, machine.store.directory, machine.store.commissioning_key)
    if not quiet:
        click.echo(
            f"axis {axis} is commissioned: moved {record.sign_test_um:+.1f} um, "
            f"{FEEDFORWARD[record.offset_in_feedforward]}, watchdog {record.watchdog}; record {path}"
        )
    return {**asdict(record), "record": str(path), "digest": record.digest}


def _set_pdos(machine: MachineConfig, axis: str, yes: bool, quiet: bool) -> dict[str, Any]:
    """Set the PDOs of one drive up; DriveFault when it refuses, or the operator does."""
    from fdhil.cli.bus_lock import lock_bus
    from fdhil.commissioning.master import Master
    from fdhil.commissioning.pdo_setup import set_up_pdos
    from fdhil.drivers.cia402.profile_file import load_profile

    profile = load_profile(machine.axis[axis].drive)
    if not yes:
        question = (
            f"The PDOs of drive {axis} are written as profile {profile.name} has them, and saved in it. May they?"
        )
        _confirm(axis, question, "nothing was written; start again with --yes where nobody can be asked")
    with lock_bus(machine.bus[machine.axis[axis].drive.bus]), Master(machine, axis) as master:
        done = set_up_pdos(master)
    written = ", ".join(done.written) or "none, all were right"
    kept = {True: ", saved in the drive", False: ", NOT saved: lost when the drive is off", None: ""}[done.saved]
    if not quiet:
        click.echo(f"axis {axis}: PDOs written: {written}{kept}")
    return {"pdos_written": list(done.written), "saved": done.saved}


def _guide(machine: MachineConfig, axis: str, yes: bool, quiet: bool) -> Callable[[str], None]:
    """Return the function that tells, and asks, before each step."""
    numbers = {step: number for number, step in enumerate(STEPS, 1)}

    def guide(step: str) -> None:
        if step == "enable" and not yes:
            _ask(machine, axis)
        text = f"axis {axis}, step {numbers[step]} of {len(STEPS)}, {step}: {STEPS[step]}"
        if quiet:
            _progress(text)
        else:
            click.echo(text)

    return guide


def _ask(machine: MachineConfig, axis: str) -> None:
    """Ask before anything moves; DriveFault when the answer is no, or nobody is there to give one."""
    from fdhil.commissioning.steps import largest_move_um

    question = (
        f"The set-up of axis {axis} is as it must be. Now the drive is switched on and the axis moves by 10 um, "
        f"then up to {largest_move_um(machine, axis):.0f} um to and fro. Is it free to move, and may it?"
    )
    advice = "nothing was moved or written; start again when it may move, with --yes where nobody can be asked"
    _confirm(axis, question, advice)


def _confirm(axis: str, question: str, advice: str) -> None:
    try:
        agreed = click.confirm(question, err=True)
    except click.Abort:
        if sys.stdin.isatty():
            raise  # Ctrl-C
        agreed = False
    if not agreed:
        raise DriveFault(f"drive {axis}", f"nobody said yes; {advice}")
