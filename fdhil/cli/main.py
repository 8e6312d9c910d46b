"""Entry point of ``fdhil``: the commands in their groups, each imported when it is called."""

import os
import sys
import warnings
from collections.abc import Iterator, Mapping
from importlib import import_module

import click

from fdhil.cli.citation import print_citation
from fdhil.cli.cli_errors import SuggestingGroup, prepare_streams, run_safely

__all__ = ["COMMANDS", "cli", "main", "run_safely"]

# group -> command -> ("module:function", help line); listed here so that --help imports none of the modules
GROUPS: Mapping[str, Mapping[str, tuple[str, str]]] = {
    "Try": {
        "demo": ("fdhil.cli.demo:demo", "Run the whole loop on a simulated machine and write a report."),
        "paper": ("fdhil.cli.paper:paper", "Test the claims of the reference paper on simulated machines."),
        "sim": ("fdhil.cli.sim_command:sim", "Simulate a machine with drives, sensors and NC."),
    },
    "Set up": {
        "init": ("fdhil.cli.init_command:init", "Create a configuration from NC files, drives and questions."),
        "scan": ("fdhil.cli.bus_commands:scan", "List the nodes on the CAN bus."),
        "check": ("fdhil.cli.bus_commands:check", "Compare the drives on the bus with the configuration."),
        "commission": ("fdhil.cli.commission_command:commission", "Commission the drives, step by step."),
        "doctor": ("fdhil.cli.doctor:doctor", "Diagnose the PC, bus, drives, sensors, store and clock."),
        "eds": ("fdhil.cli.eds_command:eds", "Assess a drive from its EDS or DCF file."),
    },
    "Run": {
        "run": ("fdhil.cli.daemon_commands:run", "Run the daemon: identify, predict, and correct once armed."),
        "status": ("fdhil.cli.daemon_commands:status", "Show the daemon's status."),
        "arm": ("fdhil.cli.daemon_commands:arm", "Arm the correction of one program."),
        "disarm": ("fdhil.cli.daemon_commands:disarm", "Ramp the correction to zero and disarm."),
        "adopt": ("fdhil.cli.daemon_commands:adopt", "Ramp an offset that is still applied to zero."),
        "acknowledge": ("fdhil.cli.daemon_commands:acknowledge", "Acknowledge pending notices."),
        "web": ("fdhil.cli.web_commands:web", "Serve the machine pages for a browser."),
        "web-user": ("fdhil.cli.web_commands:web_user", "Manage web users and their roles."),
        "publish": ("fdhil.cli.publish_command:publish", "Publish status over OPC UA, MQTT, MTConnect or Prometheus."),
    },
    "Programs": {
        "predict": ("fdhil.cli.prediction_commands:predict", "Predict the path error of a program before the cut."),
        "correct": ("fdhil.cli.prediction_commands:correct", "Plan the correction of a program."),
        "advise": ("fdhil.cli.advise_command:advise", "Compute the highest feed per line that keeps a tolerance."),
        "interpret": ("fdhil.cli.interpret_command:interpret", "List the motions of an NC program."),
        "record": ("fdhil.cli.record_command:record", "Record the demand of an air cut from the bus."),
        "play": ("fdhil.cli.play_command:play", "Stream a program to the drives of a bench without NC."),
    },
    "Look back": {
        "identify": ("fdhil.cli.identify_command:identify", "Identify a drive from recordings."),
        "history": ("fdhil.cli.history_commands:history", "Show parameters, trends and notices over time."),
        "report": ("fdhil.cli.history_commands:report", "Write an HTML report of the history."),
        "replay": ("fdhil.cli.history_commands:replay", "Repeat the analysis of recorded windows, bit for bit."),
        "compare": (
            "fdhil.cli.compare_command:compare",
            "Compare passes, models or recordings before and after a change.",
        ),
        "audit": ("fdhil.cli.audit_command:audit", "Show and verify the audit log."),
        "acceptance": ("fdhil.cli.acceptance_command:acceptance", "Write the acceptance report of a machine."),
        "export": ("fdhil.cli.history_commands:export", "Convert a recording or bus log to another format."),
    },
    "Plant": {
        "uplink": ("fdhil.cli.fleet_commands:uplink", "Send this machine's records to the fleet server."),
        "fleet": ("fdhil.cli.fleet_commands:fleet", "Collect and compare the histories of many machines."),
        "offers": ("fdhil.cli.offers_commands:offers", "List, accept or reject proposed configuration changes."),
    },
}
COMMANDS = {name: entry for commands in GROUPS.values() for name, entry in commands.items()}
NAME_WIDTH = max(map(len, COMMANDS))


EPILOG = """\b
Examples:
  fdhil demo                     try everything without hardware
  fdhil init                     configure a machine
  fdhil predict --help           show the help of one command

\b
Exit codes:
  0  done, or the answer is yes
  1  refused, or the answer is no
  2  wrong option or configuration
  3  a device, file or port cannot be reached

\b
Shell completion (bash; zsh_source and fish_source likewise):
  eval "$(_FDHIL_COMPLETE=bash_source fdhil)"
"""


class LazyGroup(SuggestingGroup):
    """A group that imports the module of a command when the command is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands, group by group."""
        return list(COMMANDS)

    def find_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import and return one command, or None if the name is unknown."""
        if cmd_name not in COMMANDS:
            return None
        module, _, attribute = COMMANDS[cmd_name][0].partition(":")
        command = getattr(import_module(module), attribute)
        assert isinstance(command, click.Command)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the groups of commands without importing any of them."""
        for title, commands in GROUPS.items():
            with formatter.section(title):
                formatter.write_dl([(name.ljust(NAME_WIDTH), text) for name, (_, text) in commands.items()])


def iterate_commands(group: click.Group, before: str = "") -> Iterator[tuple[str, click.Command]]:
    """Yield each command with its full name, as "fleet collect"; imports all of them."""
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if isinstance(command, click.Group):
            yield from iterate_commands(command, f"{before}{name} ")
        elif command is not None:
            yield f"{before}{name}", command


@click.group(cls=LazyGroup, epilog=EPILOG, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="fdhil", prog_name="fdhil")
@click.option(
    "--cite",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=print_citation,
    help="Show the BibTeX entries of fdhil and its reference paper, then exit.",
)
def cli() -> None:
    """Identify feed drives during rapid moves, predict path errors, and feed corrections back.

    A fresh installation sends no frame: writing to a drive needs commissioning, then arming. Where CONFIG is
    optional, it defaults to ./machine.toml.
    """


def main() -> None:
    """Run the command line. An error of fdhil becomes one sentence on stderr and its exit code."""
    prepare_streams()
    if not sys.warnoptions:  # warnings of libraries are for developers, who enable them with -W
        warnings.simplefilter("ignore")
        os.environ.setdefault("PYTHONWARNINGS", "ignore")  # for child processes as well
    sys.exit(run_safely(cli))


if __name__ == "__main__":
    main()
