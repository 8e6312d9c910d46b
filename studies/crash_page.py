"""The page of the crash study, and its figures for the goals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from studies import pages
from tests.crash.call_faults import FAULTS

Figures = Mapping[str, Any]
LEAST_CUTS = 60


def evaluate_goals(parts: Figures) -> dict[str, Any]:
    """Return the figures for the goals."""
    every = {part: list(parts.get(part, {}).values()) for part in ("calls", "cuts", "disks", "clocks")}
    runs = sum(sum(kind["runs"].values()) for kind in every["calls"])
    cuts, lost = (
        _sum_figure(every["cuts"], "cuts") + _sum_figure(every["cuts"], "pictures"),
        _sum_figure([*every["calls"], *every["cuts"]], "losts", "lost"),
    )
    kept = _sum_figure([*every["calls"], *every["disks"]], "acknowledged") + _sum_figure(every["cuts"], "checked")
    wrong = sum(len(found.get("wrong", found.get("damage", ()))) for part in every.values() for found in part)
    keeps = (
        f"{lost} of {kept:,} acknowledged records lost in {runs:,} calls that failed, lied or were the last, {cuts} "
    )
    keeps += f"power cuts and {_sum_figure(every['disks'], 'disks')} full or read-only disks; {wrong} other faults"
    frames, changed = _sum_figure(every["clocks"], "frames"), _sum_figure(every["clocks"], "changed")
    rounds = sum(sum(found["acknowledged"].values()) for found in every["cuts"])
    order = f"{changed} of {frames} frames of a ramp changed by {len(every['clocks'])} wrong clocks; "
    disordered = sum("out of order" in text for found in every["cuts"] for text in found["damage"])
    order += f"{disordered} of {rounds:,} records out of order that were kept while the clock was set again and again"
    sound = not lost and not wrong
    return {
        "R2": {"met": sound and runs > 0 and cuts >= LEAST_CUTS, "figure": keeps},
        "R18": {"met": sound and frames > 0 and rounds > 0 and not changed, "figure": order},
    }


def _sum_figure(found: list[Any], *names: str) -> int:
    """Return the sum of a figure, under the first of its names that there is."""
    return sum(next((one[name] for name in names if name in one), 0) for one in found)


def page(run: pages.Run, figures: Figures) -> str:
    """Return the page."""
    lines = [
        *pages.write_head("What was acknowledged is there", "crash", run),
        *pages.wrap_paragraph(
            """fdhil keeps rapids, parameters, notices, the audit, lessons, commissioning records and more on a disk.
            A
            record is acknowledged when the call that keeps it returns. This page tries to make one disappear, or to
            have
            half of one believed. `python -m studies crash` measures all of it, `--parts`, `--kinds` and `--seed` a
            part."""
        ),
    ]
    for goal, reported in figures["goals"].items():
        lines += pages.wrap_paragraph(f"Goal {goal}, {'met' if reported['met'] else 'not met'}: {reported['figure']}.")
    for part, write in (
        ("calls", _describe_calls),
        ("cuts", _describe_power_cuts),
        ("disks", _describe_disks),
        ("clocks", _describe_clocks),
    ):
        if part in figures["parts"]:
            lines += [*write(figures["parts"][part]), "", *_describe_measurement(figures["parts"][part])]
    return "\n".join(lines)


def _describe_measurement(found: Figures) -> list[str]:
    """Return when and with which code a part was measured."""
    reported = sorted({f"{one['date']} at commit {one['commit']}" for one in found.values()})
    return pages.wrap_paragraph(f"Measured on {pages.join_words(reported)}.")


def _describe_calls(kinds: Figures) -> list[str]:
    whole = sorted(name for name, kind in kinds.items() if kind["tried"] == kind["faults"])
    part = [f"{name} ({kind['tried']} of {kind['faults']})" for name, kind in kinds.items() if name not in whole]
    text = f"""A process keeps three records while strace has its nth open, write, sync, rename, link or removal
        fail, lie or kill it, for every n. Then the product starts again, must have all that was acknowledged, each
        record whole, and keeps one more. "Full from then on" is a disk that stays full. A kernel that says that it
        wrote and did not can lose a record ("lost to a lie"): none of those may be believed half. "Wrong" are losses,
        ends with anything but a sentence, and starts that did not do. All faults were tried of:
        {pages.join_words(whole)}."""
    if part:
        text += f" By chance so many of: {pages.join_words(part)}."
    names = ("record", "calls", *FAULTS, "acknowledged", "refused", "lost", "lost to a lie", "wrong")
    rows = []
    for name, kind in kinds.items():
        runs = [f"{kind['runs'].get(fault, 0):,}" for fault in FAULTS]
        rest = [f"{kind[key]:,}" for key in ("acknowledged", "refused", "lost", "lost_by_lies", "wrongs")]
        rows.append([name, str(sum(kind["calls"].values())), *runs, *rest])
    return ["## Each call fails, lies or is the last", "", *pages.wrap_paragraph(text), *pages.write_table(names, rows)]


def _describe_power_cuts(seeds: Figures) -> list[str]:
    text = """A Linux of its own (user mode, ext4) keeps records of every kind and sets its clock before each round of
        them: an hour on or back, to 1970, ten years ahead. It is killed at a random moment, which loses what its kernel
        had not written, and boots again on that disk. It is also stopped for a moment and its disk is copied: that is
        what a cut there would leave. Of such a picture the journal is played, and the product starts upon what is
        there. It must have all that was acknowledged, in order, and keep one more. Not tried: a disk that reorders or
        drops what it said was written."""
    rows = []
    for name, found in seeds.items():
        acknowledged = sum(found["acknowledged"].values())
        counts = [
            found["cuts"],
            found["pictures"],
            acknowledged,
            found["checked"],
            found["losts"],
            len(found["damage"]),
        ]
        rows.append([name, *(f"{count:,}" for count in counts)])
    names = ("", "killed and booted", "pictures", "acknowledged", "looked for, over all cuts", "lost", "damage")
    return ["## The power is cut", "", *pages.wrap_paragraph(text), *pages.write_table(names, rows)]


def _describe_disks(kinds: Figures) -> list[str]:
    text = """A real disk in memory of 4 MiB is filled but for some bytes (none to 96 KiB), where writes really become
        short; one is read-only. The product starts and keeps on such a disk, says what is the matter, and starts
        again
        when there is room."""
    keys = ("disks", "acknowledged", "refused")
    rows = [[name, *(f"{kind[key]:,}" for key in keys), str(len(kind["wrong"]))] for name, kind in kinds.items()]
    return [
        "## The disk is full, or read-only",
        "",
        *pages.wrap_paragraph(text),
        *pages.write_table(("record", *keys, "wrong"), rows),
    ]


def _describe_clocks(found: Figures) -> list[str]:
    text = """The guard's process has the clock of libfaketime: wrong from the start, or set while a correction is in
        force
        and again during the ramp that an emergency of the drive starts at the same row of the path each time. Its
        frames,
        from 20 rows before the fault to the first zero, are compared with those under a clock that is never set. Its
        own time is that of SYNC; only silence is measured, by the clock that nobody can set."""
    rows = [[name, str(one["frames"]), str(one["changed"])] for name, one in found.items()]
    return [
        "## The clock is wrong",
        "",
        *pages.wrap_paragraph(text),
        *pages.write_table(("clock", "frames", "changed"), rows),
    ]
