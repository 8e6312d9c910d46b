"""What becomes of recordings: judged one by one, counted by kind, told as a table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from typing import TypeVar

from fdhil.config import Identification
from fdhil.identification.windows import find_windows
from fdhil.validation import analyse, pool
from studies import faults

GOOD = "good"
Made = TypeVar("Made")


@dataclass(frozen=True, slots=True)
class Judged:
    """One recording: its kind, the fault's severity, windows listed, whether its pool was accepted, all codes.

    ``left_open`` names what each accepted window that does not tell all leaves null.
    """

    seed: int
    kind: str
    severity: float
    windows: int
    refused: int
    accepted: bool
    codes: tuple[str, ...]
    texts: tuple[str, ...]
    left_open: tuple[str, ...]


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
    left_open: Counter[str] = field(default_factory=Counter)
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
    told = [o.estimate for o in outcomes if o.verdict.accepted and o.estimate is not None]
    return Judged(
        seed,
        kind,
        spoilt.severity,
        len(outcomes),
        refused,
        verdict.accepted and not alone,
        codes=tuple(sorted({reason.code for reason in reasons})),
        texts=tuple(dict.fromkeys(str(reason) for reason in reasons)),
        left_open=tuple(" and ".join(estimate.missing) for estimate in told if estimate.missing),
    )


def survey(seeds: Iterable[int], one: Callable[[int], Made], processes: int) -> Iterator[Made]:
    """Yield what ``one`` makes of each seed."""
    if processes < 2:
        yield from map(one, seeds)
        return
    with ProcessPoolExecutor(processes) as executor:
        yield from executor.map(one, seeds, chunksize=8)


def tally(judged: Iterable[Judged], kinds: Mapping[str, faults.Kind]) -> dict[str, Tally]:
    """Count by kind."""
    counted: dict[str, Tally] = {GOOD: Tally()} | {name: Tally() for name in kinds}
    for one in judged:
        entry = counted[one.kind]
        entry.count += 1
        entry.accepted += one.accepted
        entry.windows += one.windows
        entry.refused += one.refused
        entry.severities.append(one.severity)
        entry.codes.update(one.codes)
        entry.left_open.update(one.left_open)
        is_good = one.kind == GOOD
        entry.right += not one.codes if is_good else bool(kinds[one.kind].named & set(one.codes))
        if one.accepted != is_good:
            entry.wrong.append(one.seed)
    return counted


def tables(counted: Mapping[str, Tally], kinds: Mapping[str, faults.Kind]) -> str:
    """Return what became of good recordings, and a table of the bad ones."""
    fine = counted[GOOD]
    lines = [
        f"Good: {fine.windows} windows of {fine.count} recordings, {fine.refused} windows refused "
        f"({fine.refused / max(1, fine.windows):.2%}), {len(fine.wrong)} recordings without a validated pool. "
        f"Reasons: {listed(fine.codes) or 'none'}.",
    ]
    if fine.left_open:
        nulls = ", ".join(f"{count} without {names}" for names, count in fine.left_open.most_common())
        lines.append(f"{fine.left_open.total()} windows are accepted with a null and its reason: {nulls}.")
    lines += [
        "",
        "| fault | matrix | recordings | smallest severity | accepted | named rightly | reasons given |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, kind in kinds.items():
        entry = counted[name]
        if entry.count:
            least = f"{min(entry.severities):.3g} {kind.unit}" if kind.unit else ""
            lines.append(
                f"| {name} | {kind.matrix} | {entry.count} | {least} | {entry.accepted} "
                f"| {entry.right / entry.count:.0%} | {listed(entry.codes)} |"
            )
    bad_ones = [counted[name] for name in kinds]
    lines.append(
        f"| all | | {sum(e.count for e in bad_ones)} | | {sum(e.accepted for e in bad_ones)} "
        f"| {sum(e.right for e in bad_ones) / max(1, sum(e.count for e in bad_ones)):.0%} | |"
    )
    return "\n".join(lines) + "\n"


def listed(codes: Counter[str]) -> str:
    """Return codes with their counts, the most frequent first."""
    return ", ".join(f"{count} {code}" for code, count in codes.most_common())
