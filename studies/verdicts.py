"""How often a good rapid is refused, and whether any bad one is accepted (``python -m studies.verdicts``).

Every recording is simulated anew with its own seed: drive, move, noise, resolution and sampling are drawn; each bad one
gets one fault of random severity. The table goes to ``docs/studies/verdicts.md``.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from fdhil.config import Identification
from fdhil.identification.windows import find_windows
from fdhil.validation import analyse, pool
from studies import faults

GOOD = "good"


@dataclass(frozen=True, slots=True)
class Judged:
    """One recording: its kind, the fault's severity, windows listed, whether its pool was accepted, all codes."""

    seed: int
    kind: str
    severity: float
    windows: int
    refused: int
    accepted: bool
    codes: tuple[str, ...]
    texts: tuple[str, ...]


@dataclass
class Tally:
    """What became of the recordings of one kind."""

    count: int = 0
    accepted: int = 0
    right: int = 0
    windows: int = 0
    refused: int = 0
    severities: list[float] = field(default_factory=list)
    codes: Counter[str] = field(default_factory=Counter)
    wrong: list[int] = field(default_factory=list)


def judge(kind: str, seed: int, spoilt: faults.Spoilt) -> Judged:
    """Return what the validation says of one recording."""
    settings = Identification()
    outcomes = [analyse(window, settings) for window in find_windows(spoilt.recording)]
    _, verdict = pool(outcomes, settings)
    reasons = [reason for outcome in outcomes for reason in outcome.verdict.reasons] + list(verdict.reasons)
    refused = sum(not outcome.verdict.accepted for outcome in outcomes)
    # what differs between two rapids is seen where both are believed
    alone = kind in faults.BETWEEN and refused > 0
    codes = tuple(sorted({reason.code for reason in reasons}))
    texts = tuple(dict.fromkeys(str(reason) for reason in reasons))
    return Judged(seed, kind, spoilt.severity, len(outcomes), refused, verdict.accepted and not alone, codes, texts)


def good(seed: int, study: int = 1) -> Judged:
    """Judge one good recording."""
    return judge(GOOD, seed, faults.good(np.random.default_rng([study, 1, seed])))


def bad(seed: int, study: int = 1) -> Judged:
    """Judge one recording with the kind of fault that ``seed`` chooses."""
    names = list(faults.KINDS)
    name = names[seed % len(names)]
    return judge(name, seed, faults.KINDS[name].make(np.random.default_rng([study, 2, seed])))


def survey(seeds: Iterable[int], judge_one: Callable[[int], Judged], processes: int) -> Iterator[Judged]:
    """Yield what became of each seed."""
    if processes < 2:
        yield from map(judge_one, seeds)
        return
    with ProcessPoolExecutor(processes) as executor:
        yield from executor.map(judge_one, seeds, chunksize=16)


def tally(judged: Iterable[Judged]) -> dict[str, Tally]:
    """Count by kind."""
    kinds: dict[str, Tally] = {GOOD: Tally()} | {name: Tally() for name in faults.KINDS}
    for one in judged:
        entry = kinds[one.kind]
        entry.count += 1
        entry.accepted += one.accepted
        entry.windows += one.windows
        entry.refused += one.refused
        entry.severities.append(one.severity)
        entry.codes.update(one.codes)
        is_good = one.kind == GOOD
        entry.right += not one.codes if is_good else bool(faults.KINDS[one.kind].named & set(one.codes))
        if one.accepted != is_good:
            entry.wrong.append(one.seed)
    return kinds


def page(kinds: dict[str, Tally], heading: str) -> str:
    """Return the tables of one study."""
    fine = kinds[GOOD]
    lines = [
        heading,
        "",
        f"Good: {fine.windows} windows of {fine.count} recordings, {fine.refused} windows refused "
        f"({fine.refused / max(1, fine.windows):.2%}), {len(fine.wrong)} recordings without a validated pool. "
        f"Reasons: {listed(fine.codes) or 'none'}.",
        "",
        "| fault | matrix | recordings | smallest severity | accepted | named rightly | reasons given |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, kind in faults.KINDS.items():
        entry = kinds[name]
        if entry.count:
            least = f"{min(entry.severities):.3g} {kind.unit}" if kind.unit else ""
            lines.append(
                f"| {name} | {kind.matrix} | {entry.count} | {least} | {entry.accepted} "
                f"| {entry.right / entry.count:.0%} | {listed(entry.codes)} |"
            )
    bad_ones = [kinds[name] for name in faults.KINDS]
    lines.append(
        f"| all | | {sum(e.count for e in bad_ones)} | | {sum(e.accepted for e in bad_ones)} "
        f"| {sum(e.right for e in bad_ones) / max(1, sum(e.count for e in bad_ones)):.0%} | |"
    )
    return "\n".join(lines) + "\n"


def listed(codes: Counter[str]) -> str:
    """Return codes with their counts, the most frequent first."""
    return ", ".join(f"{count} {code}" for code, count in codes.most_common())


INTRODUCTION = """# Good windows refused, bad windows accepted

Written by `python -m studies.verdicts`. Every recording is simulated anew: drives from 15 to 250 V and 3 to 150 A,
windings of 3 to 20 ms, inertia and friction to match, pitch 5 to 40 mm, rapids of 9 to 60 m/min at 1.5 to 8 m/s2 with
5 to 60 ms smoothing, rows 0.25 to 2 ms apart, voltage as means or instants, noise 0.1 to 0.5 %, sensors in steps of
0.001 to 0.2 % of their peak, positions in 0.1 to 5 um. Each bad recording has one fault of random severity, whose
smallest is listed. "Named rightly" means that one of the reasons given is the class of that fault. Seeds of recordings
that were judged wrongly are printed.
"""


def main() -> None:
    """Run the study and write its page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--good", type=int, default=1500, help="recordings; each holds one or two windows")
    parser.add_argument("--bad", type=int, default=3000)
    parser.add_argument("--study", type=int, nargs="+", default=[1], help="seeds of whole studies")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("docs/studies/verdicts.md"))
    options = parser.parse_args()
    parts = [INTRODUCTION]
    for study in options.study:
        results = list(survey(range(options.good), partial(good, study=study), options.processes))
        results += survey(range(options.bad), partial(bad, study=study), options.processes)
        kinds = tally(results)
        parts.append(page(kinds, f"## Study {study}"))
        print(parts[-1])
        wrong = {name: entry.wrong for name, entry in kinds.items() if entry.wrong}
        print("judged wrongly, by seed:", wrong, flush=True)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text("\n".join(parts))


if __name__ == "__main__":
    main()
