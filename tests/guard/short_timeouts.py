"""Runs a guard whose timeouts a test can shorten: a file in its run directory stands for ten seconds of silence.

``python -m tests.guard.short_timeouts CONFIG`` starts it as fdhil-guard does; with ``--settings`` it is the guard
itself.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from fdhil.guard.guard_settings import GuardSettings

BUS, DAEMON = "bus_silent_for_long", "daemon_silent_for_long"


def shorten(name: str, file: str) -> None:
    usual = getattr(GuardSettings, name).fget
    setattr(
        GuardSettings,
        name,
        property(lambda self: 0.2 if (Path(self.run_directory) / file).exists() else usual(self)),
    )


_execv = os.execv


def execute(program: str, arguments: list[str]) -> None:
    _execv(program, [__spec__.name if word == "fdhil.guard" else word for word in arguments])


def main() -> int:
    if "--settings" in sys.argv:
        from fdhil.guard.__main__ import main as guard

        shorten("silence_s", BUS)
        shorten("daemon_lost_s", DAEMON)
        return guard()
    from fdhil.cli import guard as command

    os.execv = execute  # type: ignore[assignment]
    command.main()
    return 0


if __name__ == "__main__":
    sys.exit(main())
