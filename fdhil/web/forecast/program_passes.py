"""Learning curves of programs, the daemon's measurements of the last passes, and the stored passes."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from fdhil.config import MachineConfig
from fdhil.store import StoredNotice, format_date, list_learned

SHOWN = 30
_NUMBER = r"([\d.]+)"
_PASS = re.compile(
    rf"pass (\d+) of (.+?): contour error measured {_NUMBER} um RMS, {_NUMBER} at most "
    rf"\(predicted (?:at most {_NUMBER.strip('()')}[^,]*, )?{_NUMBER}[^;]*; without correction {_NUMBER} predicted"
)
"""The report of a pass by ``fdhil.arming.pass_monitor``, which the history stores as a notice."""


def list_learning_curves(config: MachineConfig, names: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the learning curve of every program that has learned on this machine, the newest first.

    ``names`` maps digests to names of known programs. ``curve_um`` is the measured RMS contour error of each pass,
    ``without_um`` that of the last pass without learned offsets.
    """
    curves = []
    for stamp_s, program, learned in list_learned(config.store.directory / "lessons", config.digest)[:SHOWN]:
        name = next((name for digest, name in names.items() if digest.startswith(program)), None)
        curves.append(
            {
                "program": program,
                "name": name,
                "last_s": stamp_s,
                "passes": len(learned.curve_um),
                "curve_um": list(learned.curve_um),
                "without_um": learned.without_um,
                "gain": learned.gain,
            }
        )
    return curves


def list_measured_passes(status: Mapping[str, Any] | None) -> Sequence[Mapping[str, Any]]:
    """Return the passes that the running daemon has measured, oldest first; none without a daemon."""
    return [] if status is None else status.get("passes", [])


def parse_stored_passes(notices: Iterable[StoredNotice]) -> Iterator[dict[str, Any]]:
    """Yield the stored passes in the order of their notices; errors in um, RMS except ``max_um``."""
    for stored in notices:
        found = _PASS.match(stored.notice.text) if stored.notice.code == "PassMeasured" else None
        if found is not None:
            figures = dict(
                zip(
                    ("measured_um", "max_um", "predicted_um", "without_um"), map(float, found.groups()[2:]), strict=True
                )
            )
            ended = re.search(r"; it (?:was ended by|ended early:) ([^;:]+)", stored.notice.text)
            about = {
                "number": stored.number,
                "time": format_date(stored.stamp),
                "pass": int(found[1]),
                "program": found[2],
            }
            yield {**about, **figures, "severity": stored.notice.severity, "ended_by": ended[1] if ended else None}
