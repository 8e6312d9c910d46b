"""``fdhil publish``: publish the daemon's status on the shop-floor network."""

from collections.abc import Mapping
from pathlib import Path

import click

from fdhil import config as machine_config
from fdhil import tables
from fdhil.cli.options import CONFIG, LINES, OutputFile, WritingCommand
from fdhil.config import MachineConfig
from fdhil.errors import FdhilError

EXTRAS: Mapping[str, str] = {"prometheus": "web", "mtconnect": ""}  # other extras have the name of the protocol


@click.command(cls=WritingCommand)
@click.argument("protocol", type=click.Choice(list(tables.PUBLISHERS)))
@CONFIG
@click.option(
    "--devices",
    type=OutputFile(),
    help="Write the Devices.xml of the MTConnect agent to this file and exit (only mtconnect).",
)
@LINES
def publish(protocol: str, config: Path, devices: Path | None, as_json: bool) -> None:
    """Publish parameters, verdicts, alarms and offsets of CONFIG's daemon over PROTOCOL.

    Runs as a separate process that polls the daemon's status; nothing from the network reaches the machine.
    [publish.PROTOCOL] of CONFIG sets the address; by default only this computer can connect. While the daemon does not
    respond, no values are published; polling continues. Stops on SIGTERM or Ctrl-C.
    """
    if devices is not None and protocol != "mtconnect":
        raise click.UsageError("--devices applies only to mtconnect")
    machine = machine_config.load_config(config)
    if devices is not None:
        _write_devices(machine, devices)
        return
    from fdhil.daemon import write_lines_as_json
    from fdhil.shopfloor import run_publisher

    try:
        publisher = tables.load_entry(tables.PUBLISHERS, protocol)
    except ImportError as error:
        extra = EXTRAS.get(protocol, protocol)
        what = f"fdhil publish {protocol} needs the library {error.name}, which is not installed"
        raise FdhilError(f"{what}: pip install 'fdhil[{extra}]'") from None
    with write_lines_as_json(as_json):
        run_publisher(publisher, machine)


def _write_devices(machine: MachineConfig, file: Path) -> None:
    from fdhil.shopfloor import build_agent_devices
    from fdhil.store import open_output

    with open_output(file) as written:
        written.write(build_agent_devices(machine).encode())
    click.echo("restart the agent, which reads the file at its start", err=True)
