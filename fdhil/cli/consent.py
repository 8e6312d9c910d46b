"""Asks the operator before anything is sent."""

from __future__ import annotations

import sys

import click


def agreed(question: str) -> bool:
    """Whether the operator says yes; where nobody is there to be asked, nobody does."""
    try:
        return click.confirm(question, err=True)
    except click.Abort:
        if sys.stdin.isatty():
            raise  # Ctrl-C
        return False
