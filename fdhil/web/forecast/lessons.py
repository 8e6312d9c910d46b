"""What programs have learned: the curve of each one by its passes, and what the daemon measured of the last ones."""

from collections.abc import Mapping, Sequence
from typing import Any

from fdhil.config import MachineConfig
from fdhil.store.lessons import kept_lessons

SHOWN = 30


def lessons(config: MachineConfig, names: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the curve of every program that has learned on this very machine, the newest first.

    ``names`` are those of known programs by digest. ``curve_um`` is the RMS of the contour error that each pass
    measured, ``without_um`` that of the last one in which nothing learned was in force.
    """
    told = []
    for stamp_s, program, lesson in kept_lessons(config.store.directory / "lessons", config.digest)[:SHOWN]:
        name = next((name for digest, name in names.items() if digest.startswith(program)), None)
        told.append(
            {
                "program": program,
                "name": name,
                "last_s": stamp_s,
                "passes": len(lesson.curve_um),
                "curve_um": list(lesson.curve_um),
                "without_um": lesson.without_um,
                "gain": lesson.gain,
            }
        )
    return told


def passes(status: Mapping[str, Any] | None) -> Sequence[Mapping[str, Any]]:
    """Return the passes that the running daemon has measured, oldest first; none where no daemon runs."""
    return [] if status is None else status.get("passes", [])
