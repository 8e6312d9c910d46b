"""Prompts the operator before anything is sent.

An NC may be switched on while a prompt waits. So an answer takes effect only after the buses were monitored for a
while; sending is then refused by :mod:`fdhil.commissioning.bus_watch` if another master is active.
"""

import sys
import time

import click

LOOK_S = 0.25  # longer than any NC's SYNC period


def ask_yes_no(question: str) -> bool:
    """Return whether the operator confirms; False if standard input has ended."""
    try:
        yes = click.confirm(question, err=True)
    except click.Abort:
        if sys.stdin.isatty():
            raise  # Ctrl-C
        return False
    wait_for_bus_watch()
    return yes


def ask_text(question: str) -> str:
    """Return the operator's answer, one line; empty if standard input has ended."""
    try:
        answer = str(click.prompt(question, default="", show_default=False, err=True))
    except click.Abort:
        if sys.stdin.isatty():
            raise  # Ctrl-C
        return ""
    wait_for_bus_watch()
    return answer


def wait_for_bus_watch() -> None:
    """Wait until the threads that monitor the open buses would have detected an NC."""
    time.sleep(LOOK_S)
