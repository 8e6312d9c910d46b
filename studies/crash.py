"""Crash consistency, measured (``python -m studies crash``).

Every call with which the product writes its records fails, lies or ends the process; the power of a machine that keeps
records is cut; disks are full or read-only, clocks are set. What was acknowledged must be there afterwards, nothing
half may be believed, and the next start must do. Each part, each kind of record and each seed of the power cuts can be
measured alone: what was not asked for stays as it was. Needs Debian's ``strace``, ``faketime`` and ``e2fsprogs``.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from studies import pages
from studies.crash_page import evaluate_goals, page
from tests.crash import clocks as wrong_clocks
from tests.crash import disks as small_disks
from tests.crash.loops import KINDS, tried
from tests.crash.stored_records import KEEPERS
from tests.integration import power_cuts

__all__ = ["evaluate_goals", "main", "page"]

MOST_TOLD = 20
FREE_BYTES = (1, 100, 1000, 5000, *range(0, 96 << 10, 4096))
Figures = Mapping[str, Any]
Found = Iterator[tuple[str, dict[str, Any]]]


def fail_calls(options: argparse.Namespace, folder: Path) -> Found:
    """Have each call fail in each way, kind by kind."""
    for name in options.kinds or KINDS:
        found = tried(name, folder / name, options.each)
        yield name, vars(found) | {"wrong": found.wrong[:MOST_TOLD], "wrongs": len(found.wrong)}


def cut_power(options: argparse.Namespace, folder: Path) -> Found:
    """Cut the power of a machine."""
    power_cuts.prepare()
    found = vars(power_cuts.cut_power(options.cuts, folder, seed=options.seed, pictures=options.pictures))
    yield f"seed {options.seed}", found | {"lost": found["lost"][:MOST_TOLD], "losts": len(found["lost"])}


def fill_disks(options: argparse.Namespace, folder: Path) -> Found:
    """Keep records on disks with little room, and on one that is read-only."""
    for name in options.kinds or KEEPERS:
        make, wrong, kept, refused = KEEPERS[name], list[str](), 0, 0
        for free in (*FREE_BYTES, None):
            place = folder / f"{name} {free}"
            place.mkdir()
            reported = small_disks.read_only(make, place) if free is None else small_disks.filled(make, place, free)
            kept, refused = kept + len(reported.kept), refused + len(reported.refused)
            lost = set(reported.kept) - set(reported.found) - {small_disks.LATER}
            wrong += [*reported.wrong, *(f"{free} bytes free: {number} is lost" for number in sorted(lost))]
        yield name, {"disks": len(FREE_BYTES) + 1, "acknowledged": kept, "refused": refused, "wrong": wrong[:MOST_TOLD]}


def shift_clocks(options: argparse.Namespace, folder: Path) -> Found:
    """Have the guard ramp down while its clock is wrong, or is set."""
    del options
    usual = wrong_clocks.ramp(folder / "usual", wrong_clocks.NEVER_SET)
    for name, clock in wrong_clocks.CLOCKS.items():
        frames = wrong_clocks.ramp(folder / name, clock)
        changed = sum(frame != before for frame, before in zip(frames, usual, strict=False))
        yield name, {"frames": len(usual), "changed": changed + abs(len(frames) - len(usual))}


PARTS: Mapping[str, Callable[[argparse.Namespace, Path], Found]] = {
    "calls": fail_calls,
    "cuts": cut_power,
    "disks": fill_disks,
    "clocks": shift_clocks,
}


def measure_parts(options: argparse.Namespace) -> dict[str, Any]:
    """Measure the requested parts; the others stay as they are in the file."""
    path = options.out / "crash.json"
    parts = json.loads(path.read_text("utf-8"))["figures"]["parts"] if path.exists() else {}
    for part in options.parts:
        run = pages.describe_provenance("")
        with tempfile.TemporaryDirectory(prefix="crash-") as folder:
            for name, found in PARTS[part](options, Path(folder)):
                print(f"{part}, {name}: {pages.join_words([f'{k} {v}' for k, v in found.items()])[:300]}", flush=True)
                parts.setdefault(part, {})[name] = found | {"date": run["date"], "commit": run["commit"]}
    return {"parts": parts, "goals": evaluate_goals(parts)}


def main() -> None:
    """Measure and write the page; exit code 1 when a goal is not met."""
    parser = argparse.ArgumentParser(prog="python -m studies.crash", description=__doc__)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), help="measure these")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, help="of the calls and disks: these kinds of record")
    parser.add_argument("--each", type=int, help="of the calls: faults of each kind, by chance; left out: all")
    parser.add_argument("--cuts", type=int, default=20)
    parser.add_argument("--pictures", type=int, default=15, help="of the disk, before each cut")
    parser.add_argument("--seed", type=int, default=1, help="of the power cuts")
    found = pages.run_study("crash", parser, lambda options: str(options.seed), measure_parts)
    sys.exit(not all(goal["met"] for goal in found["goals"].values()))


if __name__ == "__main__":
    main()
