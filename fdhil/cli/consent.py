"""Asks the operator before anything is sent.

While a question waits for its answer an NC may be switched on. So an answer is passed on only when the buses have been
listened to for a while after it; whoever sends then is refused by the bus (:mod:`fdhil.commissioning.bus_watch`).
"""

import sys
import time

import click

LOOK_S = 0.25  # SYNC of any NC comes meanwhile


def agreed(question: str) -> bool:
    """Whether the operator says yes; where nobody is there to be asked, nobody does."""
    try:
        yes = click.confirm(question, err=True)
    except click.Abort:
        if sys.stdin.isatty():
            raise  # Ctrl-C
        return False
    listen_again()
    return yes


def answered(question: str) -> str:
    """Return what the operator answers, in one line; empty where nobody is there to be asked."""
    try:
        answer = str(click.prompt(question, default="", show_default=False, err=True))
    except click.Abort:
        if sys.stdin.isatty():
            raise  # Ctrl-C
        return ""
    listen_again()
    return answer


def listen_again() -> None:
    """Give the threads that listen to open buses time to hear an NC."""
    time.sleep(LOOK_S)
