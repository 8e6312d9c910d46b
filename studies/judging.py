"""Assesses recordings one by one, counts them by kind, and writes the table."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from typing import Any, TypeVar

from scipy.stats import beta

from fdhil.config import Identification
from fdhil.identification.rapid_windows import find_windows
from fdhil.pipeline import analyse_window, pool_windows
from fdhil.records import WindowOutcome
from studies import drives, faults, harm
from studies.pages import wrap_paragraph, write_table
from studies.scenes import Scene

GOOD = "good"
NAMED = 0.9  # kinds that are named rightly less often are told by name
Made = TypeVar("Made")


@dataclass(frozen=True, slots=True)
class Judged:
    """One recording: its kind, the fault's severity, windows listed, whether its pool was accepted, all codes.

    ``left_open`` names what each accepted window that does not tell all leaves null, ``harm`` what would go wrong with
    what was accepted, and ``warned`` are the codes of its warnings.
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
    harm: tuple[str, ...] = ()
    warned: tuple[str, ...] = ()


@dataclass
class Tally:
    """The results of the recordings of one kind; ``least`` is the smallest severity, ``wrong`` holds seeds.

    ``silent`` counts those that were accepted without a warning; None where that was not counted.
    """

    count: int = 0
    accepted: int = 0
    harmful: int = 0
    silent: int | None = None
    right: int = 0
    windows: int = 0
    refused: int = 0
    least: float | None = None
    codes: Counter[str] = field(default_factory=Counter)
    left_open: Counter[str] = field(default_factory=Counter)
    wrong: list[int] = field(default_factory=list)

    @classmethod
    def parse(cls, told: Mapping[str, Any]) -> Tally:
        """Return the tally of a page's figures."""
        return cls(**{**told, "codes": Counter(told["codes"]), "left_open": Counter(told["left_open"])})


def assess_recording(
    kind: str, seed: int, corrupted: faults.FaultyRecording, scene: Scene | None = None, *, configured: bool = False
) -> Judged:
    """Return the validation's verdict of one recording, ``configured`` with the machine's section.

    Of a ``scene`` with the true drive is told, too, what of that does harm.
    """
    settings = Identification()
    axis = harm.make_axis(scene) if configured and scene is not None else None
    outcomes = [analyse_window(window, settings, axis, drives.CYCLE_S) for window in find_windows(corrupted.recording)]
    _, verdict = pool_windows(outcomes, settings)
    reasons = [reason for outcome in outcomes for reason in outcome.verdict.reasons] + list(verdict.reasons)
    refused = sum(not outcome.verdict.accepted for outcome in outcomes)
    # what differs between two rapids is seen where both are believed
    alone = kind in faults.BETWEEN and refused > 0
    reported = [o.estimate for o in outcomes if o.verdict.accepted and o.estimate is not None]
    return Judged(
        seed,
        kind,
        corrupted.severity,
        len(outcomes),
        refused,
        verdict.accepted and not alone,
        codes=tuple(sorted({reason.code for reason in reasons})),
        texts=tuple(dict.fromkeys(str(reason) for reason in reasons)),
        left_open=tuple(" and ".join(estimate.missing) for estimate in reported if estimate.missing),
        harm=() if scene is None or kind in faults.BETWEEN else _measure_harm(outcomes, corrupted.scene or scene),
        warned=tuple(sorted({warning.code for o in outcomes for warning in o.verdict.warnings})),
    )


def _measure_harm(outcomes: Iterable[WindowOutcome], scene: Scene) -> tuple[str, ...]:
    reported = [o.estimate for o in outcomes if o.verdict.accepted and o.estimate is not None]
    wrong = [text for estimate in reported for text in harm.find_deviating_parameters(estimate, scene.drive)]
    models = [
        p for p in (estimate.build_parameters() for estimate in reported) if math.isfinite(sum(p.as_dict().values()))
    ]
    return (*wrong, *(harm.measure_path_error_um(models, scene) if models else ()))


def assess_seeds(seeds: Iterable[int], one: Callable[[int], Made], processes: int) -> Iterator[Made]:
    """Yield the result of ``one`` for each seed."""
    if processes < 2:
        yield from map(one, seeds)
        return
    with ProcessPoolExecutor(processes) as executor:
        yield from executor.map(one, seeds, chunksize=8)


def count_by_kind(judged: Iterable[Judged], kinds: Mapping[str, faults.Kind]) -> dict[str, Tally]:
    """Count by kind."""
    counted: dict[str, Tally] = {GOOD: Tally()} | {name: Tally() for name in kinds}
    for one in judged:
        entry = counted[one.kind]
        entry.count += 1
        entry.accepted += one.accepted
        entry.harmful += bool(one.harm)
        silent = one.accepted and not one.codes and not one.warned
        entry.silent = (entry.silent or 0) + silent
        entry.windows += one.windows
        entry.refused += one.refused
        entry.least = one.severity if entry.least is None else min(entry.least, one.severity)
        entry.codes.update(one.codes)
        entry.left_open.update(one.left_open)
        is_good = one.kind == GOOD
        entry.right += not one.codes if is_good else bool(kinds[one.kind].named & {*one.codes, *one.warned})
        if one.harm or (not one.accepted if is_good else silent):
            entry.wrong.append(one.seed)
    return counted


def describe_results(counted: Mapping[str, Tally], kinds: Mapping[str, faults.Kind]) -> list[str]:
    """Return the results of valid and faulty recordings, in words and as a table."""
    fine, bad = counted[GOOD], [counted[name] for name in kinds]
    parts = ("count", "accepted", "harmful", "right")
    recordings, accepted, harmful, right = (sum(getattr(e, part) for e in bad) for part in parts)
    silent = sum(entry.accepted if entry.silent is None else entry.silent for entry in bad)
    lines = wrap_paragraph(
        f"""Good: {fine.windows} windows of {fine.count} recordings, {fine.refused} windows refused
        ({_format_percent(fine.refused, fine.windows)}; {_compute_upper_bound(fine.refused, fine.windows)}),
        {len(fine.wrong)} recordings
        without a validated pool{_count_warned(fine)}. Reasons: {count_codes(fine.codes) or "none"}."""
    )
    if fine.left_open:
        nulls = ", ".join(f"{count} without {names}" for names, count in fine.left_open.most_common())
        lines += wrap_paragraph(f"{fine.left_open.total()} windows are accepted with a null and its reason: {nulls}.")
    lines += wrap_paragraph(
        f"""Bad: {recordings} recordings, {accepted} accepted, {silent} of them without a warning, {harmful} to harm
        ({_compute_upper_bound(harmful, recordings)}), {_format_percent(right, recordings)} named rightly.
        {_find_worst_kinds(counted, kinds)}"""
    )
    wrong = [f"{name} {', '.join(map(str, entry.wrong))}" for name, entry in counted.items() if entry.wrong]
    lines += wrap_paragraph(f"Judged wrongly, or without a warning, by seed: {'; '.join(wrong) or 'none'}.")
    rows = [_format_row(name, kind, counted[name]) for name, kind in kinds.items() if counted[name].count]
    columns = [
        "fault",
        "matrix",
        "recordings",
        "smallest severity",
        "accepted",
        "without a warning",
        "harmful",
        "named rightly",
        "reasons given",
    ]
    return [*lines, *write_table(columns, rows), ""]


def _count_warned(fine: Tally) -> str:
    return "" if fine.silent is None else f", {fine.accepted - fine.silent} accepted with a warning"


def _format_row(name: str, kind: faults.Kind, entry: Tally) -> list[str]:
    least = f"{entry.least:.3g} {kind.unit}" if kind.unit else ""
    right = f"{entry.right / entry.count:.0%}"
    return [
        name,
        kind.matrix,
        str(entry.count),
        least,
        str(entry.accepted),
        str(entry.accepted if entry.silent is None else entry.silent),
        str(entry.harmful),
        right,
        count_codes(entry.codes),
    ]


def _find_worst_kinds(counted: Mapping[str, Tally], kinds: Mapping[str, faults.Kind]) -> str:
    """Name the kinds with the lowest rate of correct names."""
    shares = {name: counted[name].right / counted[name].count for name in kinds if counted[name].count}
    least = sorted((name for name, share in shares.items() if share < NAMED), key=shares.__getitem__)
    reported = [f"{name} ({shares[name]:.0%})" for name in least]
    return f"Named rightly in less than {NAMED:.0%}: {', '.join(reported) or 'no kind'}."


def _format_percent(part: int, whole: int) -> str:
    return f"{part / max(1, whole):.2%}"


def _compute_upper_bound(count: int, total: int) -> str:
    """Return the share that is not exceeded with 95 % certainty (Clopper and Pearson)."""
    if count >= total:
        return "nothing can be told of the share"
    return f"with 95 % certainty less than {float(beta.ppf(0.95, count + 1, total - count)):.2%}"


def count_codes(codes: Counter[str]) -> str:
    """Return codes with their counts, the most frequent first."""
    return ", ".join(f"{count} {code}" for code, count in codes.most_common())
