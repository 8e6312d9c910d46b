"""Text for a terminal: control characters of foreign names are replaced, and progress is shown."""

import sys
import unicodedata

import click

_LAYOUT = "\n\t"
_REPLACEMENT = "\N{REPLACEMENT CHARACTER}"


def replace_controls(text: str) -> str:
    """Return text with each control or direction character, except newline and tab, replaced by a mark.

    >>> replace_controls("axis \\x1b[2J X\\n") == "axis \\N{REPLACEMENT CHARACTER}[2J X\\n"
    True
    """
    if text.isprintable():
        return text
    return "".join(
        _REPLACEMENT if one not in _LAYOUT and unicodedata.category(one) in ("Cc", "Cf", "Zl", "Zp", "Cs") else one
        for one in text
    )


def print_progress(text: str) -> None:
    """Print progress to stderr if that is a terminal."""
    if sys.stderr.isatty():
        click.echo(text, err=True)
