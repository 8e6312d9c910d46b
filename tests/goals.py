"""The goals R1 to R20 beyond single faults: the limit of each, and its latest measurement with date and command.

A study has its goals in its figures, ``"goals": {"R2": {"met": true, "figure": "0 of 1,204 ..."}}``; a test proves one
by the marker ``goal("R19")`` and reports its figure by ``record_property("goal", "...")``. Goals with neither are
listed as not measured.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

TEXT = """
R1 | every fault survived, each told by its class | all rows here, 25 of them on a real SocketCAN interface too
R2 | acknowledged records lost | 0 with any call failed or killed, and 0 in 60 power cuts
R3 | limits broken on the bus | 0 in 10,000,000 random SYNC
R4 | time to zero after a fault | within the bound of the ramp, at 1,000 random times, each row that ramps
R5 | frames that a hung guard sends | none after one period
R6 | daemon killed in the cut | the guard is at zero 1,000 of 1,000 times, no step beyond the limit
R7 | guard restarted over an offset | 0 steps beyond the limit in 500
R8 | wrong values of a wire accepted | 0 of 100,000 stale Modbus answers, 10,000 stale SDO answers, 100,000 wrong counts
R9 | loss told | what is told lost is what was lost, over 1,000,000 frames
R10 | recordings judged wrongly | 0 of 3,000 faulty ones validated to harm, at most 1 % of 2,000 clean ones refused
R11 | the guard's own tests | every branch, every vector of interlocks, mutation score of 95 %
R12 | fuzzed inputs | 1,000,000 a target: no undeclared exception, 1 s and 256 MB at most
R13 | long life | memory, descriptors and threads flat over 168 h at speed-up and over hours of real time
R14 | confinement of the units | systemd's figure is 1.5 at most for each
R15 | a default installation is mute | 0 frames, 0 listening TCP ports
R16 | who may write by HTTP | every route refuses a wrong login, origin and host; no secret in any output
R17 | a mutated configuration | means the same, or is refused with line and key
R18 | clock jumps | 0 frames of a ramp changed, 0 records out of order
R19 | messages | every class has its cause, its effect and its next action, as the documents have them
R20 | wrong set-ups of a drive | 12 and more, all refused by the commissioning
"""
GOALS: dict[str, tuple[str, str]] = {
    identity: (goal, bar)
    for identity, goal, bar in ((cell.strip() for cell in line.split("|")) for line in TEXT.strip().splitlines())
}
SOURCE = "make faults"


def read_study_goals(folder: Path) -> dict[str, list[dict[str, Any]]]:
    """Return the goals of the studies' figures, with command, day and commit of each study."""
    found: dict[str, list[dict[str, Any]]] = {}
    for path in sorted(folder.glob("*.json")):
        document = json.loads(path.read_text("utf-8"))
        run = document.get("run", {})
        for goal, reported in _read_goals(document).items():
            if goal not in GOALS:
                raise ValueError(f"{path.name} tells of a goal {goal} that there is not")
            when = {"by": run.get("command", ""), "date": run.get("date", ""), "commit": run.get("commit", "")}
            found.setdefault(goal, []).append({"met": bool(reported["met"]), "figure": str(reported["figure"]), **when})
    return found


def _read_goals(document: Mapping[str, Any]) -> Mapping[str, Mapping[str, Any]]:
    figures = document.get("figures", {})
    if document.get("study") == "verdicts":
        return {"R10": evaluate_verdicts(figures)}
    reported = figures.get("goals", {}) if isinstance(figures, Mapping) else {}
    return reported if isinstance(reported, Mapping) else {}


def evaluate_verdicts(figures: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> dict[str, Any]:
    """Return R10: faulty recordings that were validated, and windows of clean ones that were refused.

    Only harmful outcomes count: a fault too small for any parameter may cause a warning with the model kept.
    """
    kinds = [(name, kind) for study in figures.values() for name, kind in study.items()]
    bad = [kind for name, kind in kinds if name != "good"]
    good = [kind for name, kind in kinds if name == "good"]
    counts = ("count", "accepted", "silent", "harmful")
    faulty, validated, silent, harmful = (sum(kind[key] for kind in bad) for key in counts)
    clean, windows, refused = (sum(kind[key] for kind in good) for key in ("count", "windows", "refused"))
    figure = (
        f"{validated} of {faulty:,} faulty ones validated, {silent} of them without a warning, {harmful} to harm; "
        f"{refused} of {windows:,} windows of {clean:,} clean refused"
    )
    met = not harmful and faulty >= 3000 and clean >= 2000 and refused <= 0.01 * windows
    return {"met": met, "figure": figure}


def format_goal_lines(found: Mapping[str, Sequence[Mapping[str, Any]]]) -> Iterator[str]:
    """Yield the table in Markdown; a goal is met if all its measurements agree."""
    yield "| goal | about | to reach | measured | met | by | on |"
    yield "|---|---|---|---|---|---|---|"
    for identity, (goal, bar) in GOALS.items():
        reported = found.get(identity, ())
        measured = "; ".join(dict.fromkeys(each["figure"] for each in reported)) or "not measured"
        met = "yes" if reported and all(each["met"] for each in reported) else "**no**" if reported else ""
        by = ", ".join(dict.fromkeys(f"`{each['by']}`" for each in reported))
        days = ", ".join(dict.fromkeys(f"{each['date']} ({each['commit']})" for each in reported))
        yield f"| {identity} | {goal} | {bar} | {measured} | {met} | {by} | {days} |"


def summarise_goals(found: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Return the figures in one sentence."""
    met = sum(bool(told) and all(each["met"] for each in told) for told in found.values())
    return f"{met} of {len(GOALS)} goals are met, {len(found) - met} not, {len(GOALS) - len(found)} not measured."
