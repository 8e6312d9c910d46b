"""``fdhil publish``: tells a network of the shop floor what the daemon knows."""

from collections.abc import Mapping
from pathlib import Path

import click

from fdhil import config as machine_config
from fdhil import tables
from fdhil.cli.options import CONFIG, LINES, OutputFile, Writing
from fdhil.config import MachineConfig
from fdhil.errors import FdhilError

EXTRAS: Mapping[str, str] = {"prometheus": "web", "mtconnect": ""}  # the others are called as their protocol


@click.command(cls=Writing)
@click.argument("protocol", type=click.Choice(list(tables.PUBLISHERS)))
@CONFIG
@click.option(
    "--devices",
    type=OutputFile(),
    help="With mtconnect: write the Devices.xml that its agent needs to this file, and stop.",
)
@LINES
def publish(protocol: str, config: Path, devices: Path | None, as_json: bool) -> None:
    """Publish the values of CONFIG's daemon over PROTOCOL: parameters with intervals, verdicts, alarms, offsets.

    A process of its own for each protocol, which only asks the daemon for its status: nothing that comes over the
    network reaches the machine. [publish.PROTOCOL] of CONFIG says where; by default no other computer can reach it.
    While the daemon does not respond, no values are published; polling continues. Stops on SIGTERM or Ctrl-C.
    """
    if devices is not None and protocol != "mtconnect":
        raise click.UsageError("--devices is of use with mtconnect alone")
    machine = machine_config.load(config)
    if devices is not None:
        _write_devices(machine, devices)
        return
    from fdhil.daemon import journal
    from fdhil.shopfloor.process import run

    try:
        publisher = tables.load(tables.PUBLISHERS, protocol)
    except ImportError as error:
        extra = EXTRAS.get(protocol, protocol)
        what = f"fdhil publish {protocol} needs the library {error.name}, which is not installed"
        raise FdhilError(f"{what}: pip install 'fdhil[{extra}]'") from None
    with journal.lines_as_json(as_json):
        run(publisher, machine)


def _write_devices(machine: MachineConfig, file: Path) -> None:
    from fdhil.shopfloor.mtconnect import devices
    from fdhil.store.output import open_output

    with open_output(file) as written:
        written.write(devices(machine).encode())
    click.echo("restart the agent: it reads the file once", err=True)
