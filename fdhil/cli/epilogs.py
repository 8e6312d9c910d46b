"""End of the help of each command: an example and the exit codes, from ``epilogs.toml``."""

import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path

DEFAULTS = {
    "done": "done",
    "no": "",
    "wrong": "wrong option or configuration",
    "trouble": "a file or the configuration cannot be read or written",
}


@cache
def _read_entries() -> Mapping[str, Mapping[str, str]]:
    return tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))


def read_epilog(name: str) -> str | None:
    """Return the epilog of a command by its full name, as "fleet collect"; None for other names."""
    if (entry := _read_entries().get(name)) is None:
        return None
    codes = [entry.get(key, meaning) for key, meaning in DEFAULTS.items()]
    lines = [f"  {code}  {meaning}" for code, meaning in enumerate(codes) if meaning]
    return "\n".join(["\b", "Example:", f"  {entry['example']}", "", "\b", "Exit codes:", *lines])
