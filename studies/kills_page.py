"""What the kills, hangs and restarts of :mod:`studies.kills` add up to, and their page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from statistics import median
from typing import Any

from studies import pages
from studies.fault_rows import RAMPED, Descent
from tests.fault_matrix import ROWS

LIVE = ("kills", "faults", "hangs", "restarts")
STALE = ("own", "own", "both killed", "foreign", "beyond", "zero")
"""What the drives hold when a guard starts: its own last value (killed alone, or with the daemon), another's, none."""


@dataclass
class Found:
    """What a part of the study saw."""

    frames: int = 0
    sync: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    descents: dict[str, list[Descent | None]] = field(default_factory=dict)

    def merge(self, other: Found) -> None:
        """Add the results of another part."""
        self.frames += other.frames
        self.sync += other.sync
        self.counts += other.counts
        self.wrong += other.wrong
        for row, found in other.descents.items():
            self.descents.setdefault(row, []).extend(found)

    @classmethod
    def parse(cls, document: Mapping[str, Any]) -> Found:
        """Return the result read from a document of its fields."""
        ways = {row: [way and Descent(*way) for way in found] for row, found in document["descents"].items()}
        return cls(**{**document, "counts": Counter(document["counts"]), "descents": ways})


def compute_figures(found: Mapping[str, Found]) -> dict[str, Any]:
    """Return the study's figures."""
    live = Found()
    for name in LIVE:
        live.merge(found[name])
    rows = {}
    for row in RAMPED:
        decided = _describe_ways(found["frames"].descents.get(row, []))
        processes = _describe_ways(live.descents.get(row, []))
        rows[row] = {"decisions": decided, "processes": processes}
    both = {row: [*found["frames"].descents.get(row, []), *live.descents.get(row, [])] for row in RAMPED}
    parts = {
        name: {"sync": part.sync, "frames": part.frames, "counts": dict(part.counts), "wrong": part.wrong[:20]}
        | {"faults": sum(map(len, part.descents.values())), "broken": len(part.wrong)}
        | {"steps": sum(each.startswith("SYNC ") for each in part.wrong)}
        for name, part in found.items()
    }
    figures = {"rows": rows, "parts": parts}
    zero = {row: _describe_ways(ways) for row, ways in both.items() if ways}
    figures["sync_to_zero"] = {
        row: {"median": way["zero_median"], "worst": way["zero_worst"], "trials": way["trials"]}
        for row, way in zero.items()
    }
    return figures | {"goals": evaluate_goals(figures)}


def _describe_ways(ways: list[Descent | None]) -> dict[str, Any]:
    there = [way for way in ways if way is not None]
    if not there:
        return {"trials": len(ways), "within": 0}
    return {
        "trials": len(ways),
        "within": sum(way.within for way in there),
        "shrinking_worst": max(way.shrinking for way in there),
        "zero_median": round(median(way.zero for way in there)),
        "zero_worst": max(way.zero for way in there),
    }


def evaluate_goals(figures: Mapping[str, Any]) -> dict[str, Any]:
    """Return which goals were met, with the figure of each."""
    parts, rows = figures["parts"], figures["rows"]
    least = min(row["decisions"]["trials"] for row in rows.values())
    trials = sum(row[level]["trials"] for row in rows.values() for level in row)
    within = sum(row[level]["within"] for row in rows.values() for level in row)
    late = [row for row, of in rows.items() if max(of[k].get("shrinking_worst", 0) for k in of) > 8]
    killed, again, hung = parts["kills"], parts["restarts"], parts["hangs"]
    live = sum(parts[name]["faults"] for name in LIVE)
    zero, sent = killed["counts"].get("zero", 0), hung["counts"].get("frames while hung", 0)
    frozen = hung["counts"].get("FROZEN at 0", 0)
    started, good = sum(again["counts"].get(s, 0) for s in set(STALE)), again["counts"].get("good", 0)
    noticing = f"shrinking within 8 SYNC, but where noticing takes longer ({', '.join(late) or 'none'})"
    return {
        "R4": _evaluate_goal(
            within == trials and least >= 1000 and live >= 1000,
            f"{within:,} of {trials:,} faults ({least:,} or more of each of {len(rows)} rows, {live:,} of them on "
            f"processes) at 0 within the bound; {noticing}",
        ),
        "R5": _evaluate_goal(
            hung["faults"] > 0 and not sent and not hung["broken"],
            f"{sent} frames after the first period in {hung['faults']} hangs of 0.05 to 5 s; {frozen} of them ended "
            "FROZEN at 0: the zeros were read back too late",
        ),
        "R6": _evaluate_goal(
            zero == killed["faults"] >= 1000 and not killed["steps"],
            f"{zero} of {killed['faults']} kills ended at 0, {killed['steps']} frames broke a limit",
        ),
        "R7": _evaluate_goal(
            good == started >= 500 and not again["broken"],
            f"{good} of {started} restarts as they must be, {again['broken']} steps or wrong outcomes",
        ),
    }


def _evaluate_goal(met: bool, figure: str) -> dict[str, Any]:
    return {"met": met, "figure": figure}


def page(run: pages.Run, figures: Mapping[str, Any]) -> str:
    """Return the study's page."""
    parts = figures["parts"]
    broken = sum(part["broken"] for part in parts.values())
    lines = pages.write_head("Kills, hangs and restarts while a correction runs", "kills", run)
    sync, frames = (sum(parts[name][key] for name in LIVE) for key in ("sync", "frames"))
    lines += pages.wrap_paragraph(
        f"""{sync:,} SYNC of guard and daemon as processes on a hub, {frames:,} offset frames judged by the wire and by
        what the drives held: **{broken or "no"} promises broken**."""
    )
    lines += pages.write_table(
        ("goal", "figure", "met"),
        [[name, goal["figure"], "yes" if goal["met"] else "**no**"] for name, goal in figures["goals"].items()],
    )
    lines += ["", "## What was done", ""]
    lines += pages.wrap_paragraph(HOW)
    counts = parts["restarts"]["counts"]
    lines += pages.write_table(("what the drives held when a guard started", "times", "what must happen"), [
        ["its own last value, the guard alone was killed", str(counts.get("own", 0)), "adopted, ramped to 0"],
        ["the same, the daemon was killed with it", str(counts.get("both killed", 0)), "adopted, ramped to 0"],
        ["another node's value within 250 um", str(counts.get("foreign", 0)), "adopted, ramped to 0"],
        ["another node's value beyond 250 um", str(counts.get("beyond", 0)), "FROZEN, not one frame"],
        ["nothing", str(counts.get("zero", 0)), "OFF, not one frame"],
    ])  # fmt: skip
    lines += ["", "## Row by row: SYNC from the fault", ""]
    lines += pages.wrap_paragraph(BOUNDS)
    lines += pages.write_table(
        (
            "row",
            "fault",
            "class",
            "noticed after at most",
            "shrinking, worst",
            "0, median",
            "0, worst",
            "times",
            "of these on processes",
        ),
        [_format_line(row, of) for row, of in figures["rows"].items()],
    )
    wrong = [each for part in parts.values() for each in part["wrong"]]
    return "\n".join([*lines, "", *(f"* {each}" for each in wrong[:40])])


def _format_line(row: str, of: Mapping[str, Any]) -> list[str]:
    levels = [of[level] for level in of if of[level].get("within")]
    whole = [max(level[key] for level in levels) if levels else "" for key in ("shrinking_worst", "zero_worst")]
    middle = of["decisions"].get("zero_median", "")
    trials = sum(of[level]["trials"] for level in of)
    reported = (row, ROWS[row].fault, f"`{RAMPED[row].code}`", RAMPED[row].detected, whole[0], middle, whole[1])
    return [*map(str, reported), f"{trials:,}", str(of["processes"]["trials"] or "")]


COLUMNS = (
    "row",
    "fault",
    "class",
    "noticed after",
    "shrinking, worst",
    "0, median",
    "0, worst",
    "times",
    "on processes",
)
HOW = """The guard is `python -m fdhil.guard`, started on a descriptor of its own as `fdhil-guard` does. The daemon is
a process of its own with the client through which `fdhil run` speaks to the guard: it loads a table, arms and says
that it lives; SIGKILL ends it between two SYNC, at any row of the program. The simulated machine (physics, NC,
drives) is stepped by the study, 1 ms by the clock for a SYNC or as long as the guard takes for its frames, so that a
fault falls between two known SYNC. Every program has two
axes, each with offsets of its own up to 250 um."""
BOUNDS = """Counted from the last SYNC before the fault: to the first frame from which on no offset grows, and to the
first frames with 0 on both axes. The bound on zero is that of the [safety page](../explanation/safety.md): noticing +
1 + |o|/S + 3 S/A, with the S and A of this machine (65 and 6 increments). An offset that moves outward must first be
braked: 4 SYNC, and S/A of its own speed. Noticing takes longer than a few SYNC where a drive shows the object every
tenth SYNC only (A19, E9, E15), where a gap is held for ten SYNC at first (A8, E6, E17), where the loop itself may be
late for ten (F14), and for a heartbeat its own time-out (A22, 100 ms). A row without "on processes" was had by the
guard's decisions alone, in one process, by the same frames. Where a frame is not waited for (after a hang) SYNC goes
on at 1 ms by the clock, and a hang of so many SYNC is given as many to digest them."""
