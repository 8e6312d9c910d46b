"""Outliers among sisters, by Monte Carlo (``python -m studies.sisters``): false alarms, and what is found.

Fleets are drawn as halls have them: each axis differs from its sisters, has its own temperature and age, and its own
sets move with both. The page goes to ``docs/studies/sisters.md``.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from fdhil.fleet.outliers import ParameterHistory, assess_peers
from fdhil.records import Float, freeze_array
from studies import pages
from studies.pages import wrap_paragraph, write_table

SIZES = (5, 6, 8, 10, 12, 20, 50)
SPREAD = 0.05  # between axes that are as others
SETS = 5
SETS_OF_THE_BUSY, BUSY = 500, "busy"
PER_K, PER_MONTH = -0.01, 0.005
SHIFTS = (3, 4, 5, 6, 7, 8, 10, 12, 15, 20, 25, 30, 40, 60)  # spreads
FOUND = 0.9
ALARMS = 0.99  # of groups without an outlier that have none
Draw = Callable[[np.random.Generator, int], list[ParameterHistory]]


def make_single_axis(name: str, value: float, std: float = 0.0, axis: str = "X") -> ParameterHistory:
    """Return an axis with one known set, without temperature."""
    return ParameterHistory(name, axis, freeze_array([value]), freeze_array([np.nan]), freeze_array([0.0]), std)


def draw_single_sets(rng: np.random.Generator, count: int) -> list[ParameterHistory]:
    """Return axes with one known set."""
    return [make_single_axis(str(k), 1.0 + SPREAD * z) for k, z in enumerate(rng.normal(size=count))]


def draw_machines(
    rng: np.random.Generator,
    count: int = 12,
    spread: float = SPREAD,
    per_k: float = PER_K,
    per_month: float = PER_MONTH,
) -> list[ParameterHistory]:
    """Return machines whose friction differs by ``spread``, each at a temperature and an age of its own that move."""
    courses = []
    for k in range(count):
        at_c = rng.uniform(15, 35) + np.array([0.0, 3.0, 6.0, 2.0, 8.0])
        age = rng.uniform(0, 24) + np.linspace(0.0, 1.0, SETS)
        own = 0.05 * (1 + spread * rng.normal())
        values = own * (1 + per_k * (at_c - 20.0) + per_month * age) * (1 + 1e-3 * rng.normal(size=SETS))
        courses.append(
            ParameterHistory(f"mill-{k}", "X", freeze_array(values), freeze_array(at_c), freeze_array(age), 1e-4)
        )
    return courses


def draw_steady_halls(rng: np.random.Generator, count: int) -> list[ParameterHistory]:
    """Return machines in halls of constant temperature: their own sets do not show its effect."""
    courses = []
    for course in draw_machines(rng, count):
        at_c = freeze_array(np.full(SETS, course.temperatures_c[0]))
        values = course.values * (1 + PER_K * (at_c - course.temperatures_c))
        courses.append(replace(course, temperatures_c=at_c, values=freeze_array(values)))
    return courses


def remove_thermometers(rng: np.random.Generator, count: int) -> list[ParameterHistory]:
    """Return machines of which every second has no thermometer."""
    unknown = freeze_array(np.full(SETS, np.nan))
    return [replace(c, temperatures_c=unknown) if k % 2 else c for k, c in enumerate(draw_machines(rng, count))]


def add_busy_machine(rng: np.random.Generator, count: int) -> list[ParameterHistory]:
    """Return machines with a peer that has a hundred times the sets and another slope: only that may be reported."""
    courses = draw_machines(rng, count)
    at_c = freeze_array(rng.uniform(15, 35, SETS_OF_THE_BUSY))
    values = freeze_array(np.median(courses[0].values) * (1 - 3 * PER_K * (at_c - np.median(at_c))))
    ages = freeze_array(np.full(SETS_OF_THE_BUSY, courses[0].ages_months[0]))
    return [replace(courses[0], machine=BUSY, values=values, temperatures_c=at_c, ages_months=ages), *courses[1:]]


KINDS: Mapping[str, tuple[str, Draw]] = {
    "by_one_set": ("one set of each, no temperature", draw_single_sets),
    "drawn": ("temperatures and ages of their own", draw_machines),
    "in_steady_halls": ("each hall has one temperature, and keeps it", draw_steady_halls),
    "half_without_thermometer": ("every other has no thermometer", remove_thermometers),
    "with_a_busy_one": ("beside one with a hundred times the sets and another slope", add_busy_machine),
}


def compute_scores(courses: Sequence[ParameterHistory]) -> dict[str, float]:
    """Return by how many of its bounds each axis is off."""
    found = assess_peers(courses)
    assert found is not None
    return {level.machine: abs(level.score) / found.bound for level in found.levels}


def find_largest_score(kind: str, count: int, groups: int, seed: int = 0) -> Float:
    """Return the largest score of each group without an outlier, in bounds."""
    rng = np.random.default_rng([seed, count, list(KINDS).index(kind)])
    found = (compute_scores(KINDS[kind][1](rng, count)) for _ in range(groups))
    return np.array([max(score for name, score in told.items() if name != BUSY) for told in found])


def compute_detected_share(count: int, worn: int, shift: float, groups: int, seed: int = 0) -> float:
    """Return the detected share of worn axes, where ``worn`` of a group are off by ``shift`` spreads."""
    rng = np.random.default_rng([seed, count, worn])
    found = 0
    for _ in range(groups):
        courses = draw_machines(rng, count)
        for k in range(worn):
            courses[k] = replace(courses[k], values=freeze_array(courses[k].values * (1 + shift * SPREAD)))
        reported = compute_scores(courses)
        found += sum(reported[f"mill-{k}"] > 1 for k in range(worn))
    return found / (groups * worn)


def find_detection_limit(worn: Callable[[int], int], groups: int, count: int) -> int | None:
    """Return the deviation from which nine of ten are detected, in spreads; None beyond all tried values."""
    return next((s for s in SHIFTS if compute_detected_share(count, worn(count), s, groups) >= FOUND), None)


def count_one(_count: int) -> int:
    """Return the number of worn axes: one."""
    return 1


def count_quarter(count: int) -> int:
    """Return the number of worn axes: a quarter, and at least one."""
    return max(1, count // 4)


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Return alarms and the correct bound for each size and kind, and the detection rate."""
    os.environ |= dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
    with ProcessPoolExecutor(options.processes) as pool:
        kinds = {kind: pool.map(partial(find_largest_score, kind, groups=options.groups), SIZES) for kind in KINDS}
        few = options.groups // 20
        least = {name: pool.map(partial(find_detection_limit, worn, few), SIZES) for name, worn in
                 (("one", count_one), ("a_quarter", count_quarter))}  # fmt: skip
        tops = {kind: list(found) for kind, found in kinds.items()}
        return {
            "groups": options.groups,
            "groups_of_power": few,
            "sizes": SIZES,
            "alarms": {kind: [float(np.mean(top > 1)) for top in found] for kind, found in tops.items()},
            "right": {kind: [float(np.quantile(top, ALARMS)) for top in found] for kind, found in tops.items()},
            "least_found": {name: list(found) for name, found in least.items()},
        }


def page(run: pages.Run, figures: Mapping[str, Any]) -> str:
    """Return the study's page."""
    sizes = figures["sizes"]
    head = ["sisters", *map(str, sizes)]
    alarms = [[KINDS[kind][0], *(f"{100 * part:.1f}" for part in figures["alarms"][kind])] for kind in KINDS]
    words = {"one": "one is worn", "a_quarter": "a quarter is worn"}
    power = [[words[name], *("-" if least is None else str(least) for least in figures["least_found"][name])]
             for name in words]  # fmt: skip
    lines = pages.write_head("Outliers among sisters", "sisters", run)
    lines += wrap_paragraph(
        f"""Fleets are drawn at random: axes that differ by {100 * SPREAD:.0f} %, each at a temperature between 15 and
        35 °C and an age of up to two years, {100 * PER_K:+.0f} % per kelvin, {100 * PER_MONTH:+.1f} % per month. They
        are judged as `fdhil fleet outliers` judges machines."""
    )
    lines += ["## False alarms", ""]
    lines += wrap_paragraph(
        f"""Of 100 groups in which nothing but chance differs, so many have an alarm ({figures["groups"]} groups each; 1
        is meant):"""
    )
    lines += [*write_table(head, alarms), "", "## What is found", ""]
    lines += wrap_paragraph(
        f"""The deviation at which nine of ten worn axes are found, in standard deviations of axes that are as others
        ({figures["groups_of_power"]} groups each). Where axes differ by 5 %, 10 of them are 50 %."""
    )
    return "\n".join([*lines, *write_table(head, power)])


def main() -> None:
    """Measure and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--groups", type=int, default=1200)
    pages.run_study("sisters", parser, lambda _: "0", measure)


if __name__ == "__main__":
    main()
