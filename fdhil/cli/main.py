"""Entry point: the list of commands."""

import os
import sys
import warnings
from collections.abc import Iterator, Mapping
from importlib import import_module

import click

from fdhil.cli.failing import prepare_streams, run_safely

__all__ = ["COMMANDS", "cli", "main", "run_safely"]

# command -> ("module:function", the line of `fdhil --help`); listed here so that --help imports none of them
COMMANDS: Mapping[str, tuple[str, str]] = {
    "demo": ("fdhil.cli.demo:demo", "Run the whole loop on the simulated machine and write a report."),
    "paper": ("fdhil.cli.paper:paper", "Reproduce the paper that fdhil goes back to, claim by claim."),
    "init": ("fdhil.cli.init:init", "Make a machine's configuration: the NC's files, the drives, questions."),
    "scan": ("fdhil.cli.commissioning:scan", "List what is on the bus: nodes, identity, state, heartbeat."),
    "check": ("fdhil.cli.commissioning:check", "Check that the machine on the bus is the one in the config."),
    "commission": ("fdhil.cli.commission:commission", "Commission the drives, step by step."),
    "run": ("fdhil.cli.service:run", "Run the daemon: listen, identify, predict; correct only when armed."),
    "status": ("fdhil.cli.service:status", "Ask the running daemon how it is."),
    "arm": ("fdhil.cli.service:arm", "Arm the correction of one program."),
    "disarm": ("fdhil.cli.service:disarm", "Ramp the correction to zero and disarm."),
    "adopt": ("fdhil.cli.service:adopt", "Ramp to zero what an earlier correction may have left in the drives."),
    "web": ("fdhil.cli.web:web", "Show the machine in a browser: a process of its own, a client of the daemon."),
    "web-user": ("fdhil.cli.web:web_user", "Say who may log in to the pages in the browser, and may do what."),
    "acknowledge": ("fdhil.cli.service:acknowledge", "Tell that somebody has seen notices, who and when."),
    "doctor": ("fdhil.cli.doctor:doctor", "Tell what is wrong with this PC, bus, drives, sensors, store, clock."),
    "eds": ("fdhil.cli.eds:eds", "Tell from a drive's EDS or DCF file what fdhil can and cannot do with it."),
    "play": ("fdhil.cli.play:play", "Stream a program to the drives of a test bench that has no NC."),
    "sim": ("fdhil.cli.sim:sim", "Run the simulated machine: drives, sensors, NC."),
    "publish": ("fdhil.cli.publish:publish", "Tell OPC UA, MQTT, MTConnect or Prometheus what the daemon knows."),
    "uplink": ("fdhil.cli.fleet:uplink", "Send what this machine records to the history of many machines."),
    "fleet": ("fdhil.cli.fleet:fleet", "Gather what many machines tell, and ask all of them."),
    "offers": ("fdhil.cli.offers:offers", "Look at the changes that the works offers; accept or reject them."),
    "record": ("fdhil.cli.record:record", "Record the demand of an air cut from the bus, by listening."),
    "identify": ("fdhil.cli.identify:identify", "Identify a drive from recordings."),
    "interpret": ("fdhil.cli.program:interpret", "List the motions of an NC program."),
    "predict": ("fdhil.cli.prediction:predict", "Predict the path error of a program before it is cut."),
    "correct": ("fdhil.cli.prediction:correct", "Plan the correction of a program."),
    "advise": ("fdhil.cli.advise:advise", "Tell the highest feed of each line within a tolerance."),
    "replay": ("fdhil.cli.records:replay", "Analyse a recorded window again, bit by bit as the daemon did."),
    "history": ("fdhil.cli.records:history", "Show how the parameters moved."),
    "audit": ("fdhil.cli.audit:audit", "Show who asked the machine for what, and what he was answered."),
    "report": ("fdhil.cli.records:report", "Write an HTML report of the stored history."),
    "acceptance": ("fdhil.cli.acceptance:acceptance", "Write the acceptance report of a machine, to be signed."),
    "export": ("fdhil.cli.records:export", "Write a recording, or a log of the bus, in another file format."),
}


class LazyGroup(click.Group):
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
def cli() -> None:
    """Identify feed drives during rapid moves, predict path errors, and feed corrections back.

    A fresh installation sends no frame: writing to a drive needs commissioning, then arming. Exit codes: 0 done, 1 the
    answer is no, 2 wrong option or config, 3 device, file or port trouble.

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
