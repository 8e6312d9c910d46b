"""``fdhil doctor``: diagnose PC, buses, drives, sensors, store, clock and permissions; causes come first."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil import config as machine_config
from fdhil.cli.cli_errors import require_delivered_answer
from fdhil.cli.doctor.trouble import Trouble
from fdhil.cli.options import AS_JSON, CONFIG, PositiveFloat
from fdhil.cli.terminal_text import print_progress
from fdhil.daemon import find_newest_record_s

if TYPE_CHECKING:
    from fdhil.config import MachineConfig

SCHEMA = "fdhil-doctor-1"


@click.command()
@CONFIG
@click.option("--offline", is_flag=True, help="Examine only this PC; do not access buses and sensors.")
@click.option("--latency", "seconds", type=PositiveFloat(1.0, 86_400.0), metavar="SECONDS",
              help="Measure the wake-up latency for this time, s; the acceptance report lists it.")  # fmt: skip
@AS_JSON
@require_delivered_answer
def doctor(config: Path, offline: bool, seconds: float | None, as_json: bool) -> int:
    """Diagnose the PC, bus, drives, sensors, store, clock and permissions.

    The most urgent problem comes first. Problems that depend on it may be hidden, so correct it and run the command
    again. Only reads (--latency stores its result). If an NC runs the bus, nothing is sent; with the NC off, the drives
    are read as by fdhil check.
    """
    machine = machine_config.load_config(config)
    from fdhil.cli.doctor.latency import examine_latency, format_histogram, format_latency

    latency = _measure_and_store_latency(machine, seconds) if seconds is not None else None
    troubles = [*_examine_all(machine, offline), *(examine_latency(latency) if latency is not None else ())]
    found = sorted(troubles, key=lambda trouble: not trouble.grave)  # stable: keeps the order of causes
    if as_json:
        grave = sum(trouble.grave for trouble in found)
        document = {"schema": SCHEMA, "healthy": not grave, "troubles": [asdict(t) for t in found]}
        click.echo(json.dumps(document if latency is None else document | {"latency": latency}))
    else:
        if latency is not None:
            click.echo(f"wrote {latency['file']}", err=True)
            click.echo(format_latency(latency))
            click.echo("\n".join(format_histogram(latency["histogram_us"])))
        _show_troubles(found)
    return int(any(trouble.grave for trouble in found))


def _measure_and_store_latency(machine: MachineConfig, seconds: float) -> dict[str, Any]:
    from fdhil.cli.doctor.latency import measure_latency, store_latency

    print_progress(f"measuring the wake-up latency of this PC for {seconds:g} s")
    found = measure_latency(machine, seconds)
    return found | {"file": str(store_latency(machine, found))}


def _examine_all(config: MachineConfig, offline: bool) -> Iterator[Trouble]:
    # causes before their effects: this PC, its interfaces, the devices, the guard
    from fdhil.cli.doctor import (  # late: --help imports nothing heavy
        computer,
        devices,
        offers_check,
        storage,
        uplink_check,
    )

    yield from _examine_permitted("store", lambda: storage.examine_store(config))
    yield from _examine_permitted("clock", lambda: computer.examine_clock(find_newest_record_s(config.store.directory)))
    yield from computer.examine_processors()
    secrets = list(_examine_permitted("sockets", lambda: storage.examine_secrets(config)))
    yield from secrets
    buses = computer.examine_buses(config, offline)
    for troubles in buses.values():
        yield from troubles
    if not offline:
        received = {name for name, troubles in buses.items() if not any(trouble.grave for trouble in troubles)}
        recorded = {trouble.place for trouble in secrets if trouble.code == storage.RECORD_BAD}
        yield from devices.examine_devices(config, received, recorded, print_progress)
    yield from _examine_permitted("daemon", lambda: devices.examine_daemon(config))
    yield from _examine_permitted("guard", lambda: devices.examine_guard(config))
    yield from _examine_permitted("uplink", lambda: uplink_check.examine_uplink(config, offline))
    yield from _examine_permitted("offers", lambda: offers_check.examine_offers(config))


def _examine_permitted(place: str, examine: Callable[[], Iterator[Trouble]]) -> Iterator[Trouble]:
    try:
        yield from examine()
    except PermissionError as error:
        what = f"this user has no permission to read {error.filename or place}"
        means = f"problems of the {place} cannot be detected"
        yield Trouble("NotSeen", place, what, means, "run fdhil doctor as the user of the daemon, or with sudo")


def _show_troubles(found: list[Trouble]) -> None:
    from rich.text import Text

    from fdhil.cli.status_view import open_console

    out = open_console()
    for number, trouble in enumerate(found, 1):
        head = Text.assemble((f"{number}. {trouble.place}: ", "red" if trouble.grave else "yellow"), trouble.what)
        out.print(head.append(f"\n   means: {trouble.means}\n   fix:   {trouble.mend}"), soft_wrap=True)
    grave = sum(trouble.grave for trouble in found)
    if found:
        out.print(f"{grave} to fix, {len(found) - grave} to improve; fix the first and run it again")
    else:
        out.print("no problem found")
