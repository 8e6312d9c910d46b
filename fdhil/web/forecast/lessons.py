"""What programs have learned, what the daemon measured of the last passes, and the history of all passes."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from fdhil.config import MachineConfig
from fdhil.store.lessons import kept_lessons
from fdhil.store.notice_document import date_of
from fdhil.store.rows import StoredNotice

SHOWN = 30
_NUMBER = r"([\d.]+)"
_PASS = re.compile(
    rf"pass (\d+) of (.+?): contour error measured {_NUMBER} um RMS, {_NUMBER} at most "
    rf"\(predicted (?:at most {_NUMBER.strip('()')}[^,]*, )?{_NUMBER}[^;]*; without correction {_NUMBER} predicted"
)
"""How ``fdhil.arming.passes`` reports a pass: its notice is what the history keeps of it."""


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


def jobs(notices: Iterable[StoredNotice]) -> Iterator[dict[str, Any]]:
    """Yield the passes that the history keeps, in the order of its notices; errors in um, RMS but ``max_um``."""
    for stored in notices:
        found = _PASS.match(stored.notice.text) if stored.notice.code == "PassMeasured" else None
        if found is not None:
            figures = dict(
                zip(
                    ("measured_um", "max_um", "predicted_um", "without_um"), map(float, found.groups()[2:]), strict=True
                )
            )
            ended = re.search(r"; it (?:was ended by|ended early:) ([^;:]+)", stored.notice.text)
            about = {"number": stored.number, "time": date_of(stored.stamp), "pass": int(found[1]), "program": found[2]}
            yield {**about, **figures, "severity": stored.notice.severity, "ended_by": ended[1] if ended else None}
