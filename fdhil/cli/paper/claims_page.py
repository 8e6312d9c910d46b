"""HTML page and JSON document of the claims."""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fdhil.cli.paper.claims import Claim, Trial, Verdict
from fdhil.cli.paper.scenarios import SCENARIOS
from fdhil.report import Page, Section, Table
from fdhil.store import open_output

SCHEMA = "fdhil-paper-1"
CITATION = (
    'X. Desforges, A. Habbadi, G. Dessein, "Trajectory shortcoming prediction from physical parameter estimation"'
)
SHOWN, NOT_SHOWN = "✓", "✗"
_SECTION = re.compile(r"[Ss]ections? (\d)")
SUMMARY_HEAD = ("claim", "verdict", "shown by", "place in the paper")


def count_verdicts(claims: Sequence[Claim]) -> dict[str, int]:
    """Return the number of claims per verdict."""
    found = Counter(claim.verdict for claim in claims)
    return {verdict.value: found[verdict] for verdict in Verdict}


def list_summary_rows(claims: Sequence[Claim]) -> list[list[str]]:
    """Return one row per claim, with the columns of ``SUMMARY_HEAD``."""
    shown = [sum(map(claim.is_shown_by, claim.scenarios)) for claim in claims]
    return [
        [claim.title, claim.verdict.value, f"{count} of {len(claim.scenarios)} scenarios", claim.source]
        for claim, count in zip(claims, shown, strict=True)
    ]


def build_claims_page(claims: Sequence[Claim]) -> Page:
    """Return the page: verdicts, claims by section of the paper, scenarios."""
    return Page(
        title="The paper, claim by claim",
        subtitle=f"{CITATION}: every equation, figure and claim tested on simulated machines.",
        headline=[(verdict, str(number)) for verdict, number in count_verdicts(claims).items()],
        sections=[
            _build_verdict_section(claims),
            *map(_build_claim_section, sorted(claims, key=_find_chapter)),
            _build_scenario_section(claims),
        ],
    )


def _find_chapter(claim: Claim) -> str:
    found = _SECTION.search(claim.source)
    return f"Section {found[1]} of the paper" if found else "The paper's conclusion"


def _build_verdict_section(claims: Sequence[Claim]) -> Section:
    return Section(
        "Verdicts",
        "A trial is a number that must lie within bounds in a scenario. A claim holds if all its scenarios show it, "
        "holds with a condition if some do, and is not reproduced if none does. Only this rule decides. "
        "The safety limit of offsets does not apply, because no machine moves. Figures 1 and 2 are schemes "
        "and Figure 3 is a photograph; the paper has no tables.",
        tables=[Table(SUMMARY_HEAD, list_summary_rows(claims))],
    )


def _build_claim_section(claim: Claim) -> Section:
    condition = f": {claim.condition}" if claim.condition else ""
    parts = [
        f"{claim.source}: {claim.says}",
        f"The paper's value: {claim.paper}.",
        f"Rule: {claim.rule}.",
        f"Verdict: {claim.verdict.value}{condition}.",
        claim.note,
    ]
    return Section(
        f"{claim.title[0].upper()}{claim.title[1:]}: {claim.verdict.value}",
        " ".join(part for part in parts if part),
        tables=[_build_trial_table(claim), *claim.tables],
        figures=[(picture.caption, picture.svg) for picture in claim.pictures],
        chapter=_find_chapter(claim),
    )


def _build_trial_table(claim: Claim) -> Table:
    columns = list(dict.fromkeys((trial.what, trial.unit, trial.bounds) for trial in claim.trials))
    cells = {(trial.scenario, trial.what): format_trial(trial) for trial in claim.trials}
    head = ["scenario", *(f"{what}{f', {unit}' * bool(unit)} ({bounds})" for what, unit, bounds in columns)]
    rows = [[scenario, *(cells.get((scenario, what), "") for what, _, _ in columns)] for scenario in claim.scenarios]
    if len(columns) > 4 or (len(columns) > 1 and len(claim.scenarios) < 7):  # heads are longer than scenarios
        head = ["measured", *claim.scenarios]
        rows = [
            [f"{what}{f', {unit}' * bool(unit)} ({bounds})", *(cells.get((s, what), "") for s in claim.scenarios)]
            for what, unit, bounds in columns
        ]
    return Table(head, rows, f"{SHOWN} within its bounds, {NOT_SHOWN} outside")


def format_trial(trial: Trial) -> str:
    """Return the value of a trial with its mark."""
    return f"{trial.value:.4g} {SHOWN if trial.holds else NOT_SHOWN}"


def _build_scenario_section(claims: Sequence[Claim]) -> Section:
    used = {scenario for claim in claims for scenario in claim.scenarios}
    rows = [
        [
            name,
            scenario.title,
            ", ".join(f"{key} = {value}" for key, value in _merge_axis_keys(scenario.changes).items()),
        ]
        for name, scenario in SCENARIOS.items()
        if name in used
    ]
    return Section(
        "Scenarios",
        "All are configs/paper.toml with the listed keys changed, the same for each axis.",
        tables=[Table(("scenario", "what it is", "changed keys"), rows)],
    )


def _merge_axis_keys(changes: Mapping[str, Any]) -> dict[str, Any]:
    return {key.replace("axis.X.", "axis.*."): value for key, value in changes.items() if not key.startswith("axis.Y.")}


def build_claims_document(
    claims: Sequence[Claim], runs: int, version: str, files: Mapping[str, Sequence[str]]
) -> dict[str, Any]:
    """Return the content of ``paper.json``; ``files`` has the picture names of each claim."""
    return {
        "schema": SCHEMA,
        "fdhil": version,
        "paper": CITATION,
        "runs": runs,
        "counts": count_verdicts(claims),
        "scenarios": {
            name: {"title": scenario.title, "changes": dict(scenario.changes), "programmed": scenario.programmed}
            for name, scenario in SCENARIOS.items()
        },
        "claims": [_describe_claim(claim, files[claim.key]) for claim in claims],
    }


def _describe_claim(claim: Claim, files: Sequence[str]) -> dict[str, Any]:
    return {
        "key": claim.key,
        "title": claim.title,
        "kind": claim.kind,
        "source": claim.source,
        "says": claim.says,
        "paper": claim.paper,
        "rule": claim.rule,
        "verdict": claim.verdict.value,
        "condition": claim.condition or None,
        "note": claim.note or None,
        "trials": [_describe_trial(trial) for trial in claim.trials],
        "tables": [
            {"caption": t.caption, "head": list(t.head), "rows": [list(row) for row in t.rows]} for t in claim.tables
        ],
        "pictures": [
            {"file": file, "caption": picture.caption} for file, picture in zip(files, claim.pictures, strict=True)
        ],
    }


def _describe_trial(trial: Trial) -> dict[str, Any]:
    # JSON has no infinite numbers
    numbers = {"value": trial.value, "least": trial.least, "most": trial.most}
    finite = {name: value if math.isfinite(value) else None for name, value in numbers.items()}
    return {"scenario": trial.scenario, "what": trial.what, "unit": trial.unit, **finite, "holds": trial.holds}


def write_pictures(claims: Sequence[Claim], folder: Path) -> dict[str, list[str]]:
    """Write each picture below ``folder`` as SVG; return the relative file names per claim."""
    names: dict[str, list[str]] = {}
    for claim in claims:
        names[claim.key] = [f"pictures/{claim.key}-{k}.svg" for k in range(1, len(claim.pictures) + 1)]
        for name, picture in zip(names[claim.key], claim.pictures, strict=True):
            with open_output(folder / name) as file:
                file.write(picture.svg.encode())
    return names
