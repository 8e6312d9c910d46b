"""Entry point: the list of commands."""

import os
import sys
import warnings
from collections.abc import Iterator, Mapping
from importlib import import_module

import click

from fdhil.cli.citation import cite
from fdhil.cli.failing import SuggestingGroup, prepare_streams, run_safely

__all__ = ["COMMANDS", "cli", "main", "run_safely"]

# command -> ("module:function", the line of `fdhil --help`); listed here so that --help imports none of them
COMMANDS: Mapping[str, tuple[str, str]] = {
    "demo": ("fdhil.cli.demo:demo", "Run the whole loop on the simulated machine and write a report."),
    "paper": ("fdhil.cli.paper:paper", "Reproduce the paper that fdhil is based on, claim by claim."),
    "init": ("fdhil.cli.init:init", "Create a machine's configuration from NC files, drives and questions."),
    "scan": ("fdhil.cli.commissioning:scan", "List the nodes on the bus with identity, state and heartbeat."),
    "check": ("fdhil.cli.commissioning:check", "Compare the drives on the bus with the configuration."),
    "commission": ("fdhil.cli.commission:commission", "Commission the drives step by step."),
    "run": ("fdhil.cli.service:run", "Run the daemon: listen, identify, predict; correct only when armed."),
    "status": ("fdhil.cli.service:status", "Show the daemon's status."),
    "arm": ("fdhil.cli.service:arm", "Arm the correction of one program."),
    "disarm": ("fdhil.cli.service:disarm", "Ramp the correction to zero and disarm."),
    "adopt": ("fdhil.cli.service:adopt", "Take over an offset that a drive still applies, and ramp it to zero."),
    "web": ("fdhil.cli.web:web", "Serve the pages that show the machine in a browser."),
    "web-user": ("fdhil.cli.web:web_user", "Manage web users and their roles."),
    "acknowledge": ("fdhil.cli.service:acknowledge", "Acknowledge pending notices."),
    "doctor": ("fdhil.cli.doctor:doctor", "Diagnose the PC, bus, drives, sensors, store and clock."),
    "eds": ("fdhil.cli.eds:eds", "Show what fdhil can do with a drive, from its EDS or DCF file."),
    "play": ("fdhil.cli.play:play", "Stream a program to the drives of a test bench that has no NC."),
    "sim": ("fdhil.cli.sim:sim", "Run the simulated machine with drives, sensors and NC."),
    "publish": ("fdhil.cli.publish:publish", "Publish the daemon's values over OPC UA, MQTT, MTConnect or Prometheus."),
    "uplink": ("fdhil.cli.fleet:uplink", "Send this machine's records to the fleet server."),
    "fleet": ("fdhil.cli.fleet:fleet", "Collect and compare the histories of many machines."),
    "offers": ("fdhil.cli.offers:offers", "List, accept or reject proposed configuration changes."),
    "record": ("fdhil.cli.record:record", "Record the demand of an air cut from the bus."),
    "identify": ("fdhil.cli.identify:identify", "Identify a drive from recordings."),
    "interpret": ("fdhil.cli.program:interpret", "List the motions of an NC program."),
    "predict": ("fdhil.cli.prediction:predict", "Predict the path error of a program before it is cut."),
    "correct": ("fdhil.cli.prediction:correct", "Plan the correction of a program."),
    "compare": ("fdhil.cli.compare:compare", "Compare two passes, models or recordings, before and after a change."),
    "advise": ("fdhil.cli.advise:advise", "Compute the highest feed per line that keeps a tolerance."),
    "replay": ("fdhil.cli.records:replay", "Repeat the analysis of a recorded window, bit for bit."),
    "history": ("fdhil.cli.records:history", "Show the history of the parameters."),
    "audit": ("fdhil.cli.audit:audit", "Show the audit log."),
    "report": ("fdhil.cli.records:report", "Write an HTML report of the history."),
    "acceptance": ("fdhil.cli.acceptance:acceptance", "Write the acceptance report of a machine."),
    "export": ("fdhil.cli.records:export", "Convert a recording or a bus log to another file format."),
}


class LazyGroup(SuggestingGroup):
    """A group that imports a command's module when that command is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the commands in the order of the workflow."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import one command; None for an unknown name."""
        if cmd_name not in COMMANDS:
            return None
        module, _, attribute = COMMANDS[cmd_name][0].partition(":")
        command = getattr(import_module(module), attribute)
        assert isinstance(command, click.Command)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands without importing any of them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in COMMANDS.items()])


def leaves(group: click.Group, before: str = "") -> Iterator[tuple[str, click.Command]]:
    """Yield every command that does something, by its words, as "fleet collect"; this imports all of them."""
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if isinstance(command, click.Group):
            yield from leaves(command, f"{before}{name} ")
        elif command is not None:
            yield f"{before}{name}", command


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="fdhil", prog_name="fdhil")
@click.option(
    "--cite",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=cite,
    help="Show how to cite fdhil and the paper that it follows, as BibTeX.",
)
def cli() -> None:
    """Identify feed drives during rapid moves, predict path errors, and feed corrections back.

    A fresh installation sends no frame: writing to a drive needs commissioning, then arming. CONFIG, where it is left
    out, is ./machine.toml. Exit codes: 0 done, 1 the answer is no, 2 wrong option or config, 3 device, file or port
    trouble.

    Shell completion: eval "$(_FDHIL_COMPLETE=bash_source fdhil)" (or zsh_source, fish_source).
    """


def main() -> None:
    """Run the command line; an error of fdhil is one sentence on stderr and its exit code."""
    prepare_streams()
    if not sys.warnoptions:  # advice of libraries is for developers, who ask for it with -W
        warnings.simplefilter("ignore")
        os.environ.setdefault("PYTHONWARNINGS", "ignore")  # of the processes started from here, too
    sys.exit(run_safely(cli))


if __name__ == "__main__":
    main()
