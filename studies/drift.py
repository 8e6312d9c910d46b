"""Drift and load, by Monte Carlo on simulated rapids (``python -m studies.drift``): what the history is able to tell.

Warming shuttles, steps of the load, and pools, all of drives that are drawn at random and go the way that the daemon's
windows go. The page goes to ``docs/studies/drift.md``.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np

from fdhil.config import Identification, MachineConfig, parse_config
from fdhil.identification.rapid_windows import find_windows
from fdhil.identification.trends import find_crossing, find_steps, fit_slope
from fdhil.pipeline import AxisPipeline, analyse_window, pool_windows
from fdhil.records import INTERVAL_95, PARAMETERS, Notice, ParameterSet, Window, WindowOutcome
from fdhil.store.recording_csv import parse_recording
from studies import bench, pages
from studies.pages import wrap_paragraph, write_table

Array = bench.Array
NOISE = 0.005
SHUTTLES = 20
RAPIDS = 4
STEP = 1.13
WITHIN = {"R": 0.3, "L": 0.5, "K": 0.2, "Jt": 0.3, "ft": 3.0, "Cd": 4.0}
# the bench warms from 20 to 22 degC: ft falls from 0.05 to 0.034 N.m.s, Cd from 5 to 4 N.m
FT_PER_KELVIN, CD_PER_KELVIN = -0.16, -0.10
SETTINGS = Identification()
KELVINS = (0.0, 0.2, 1.0, 2.0)  # over the rapids of which sets are published
PUBLISHED = 24
SPEEDS = (0.5, 0.42, 0.36)  # m/s, where they are mixed


def make_machine() -> MachineConfig:
    """Return a machine with one axis, of which only the rapid speed and the maintenance limits matter here."""
    gains = ("position_gain_per_s", "speed_kp", "speed_ki", "current_kp", "current_ki")
    axis = {
        "screw_pitch_mm": 20.0,
        "rapid_speed_mm_s": 500.0,
        "max_acceleration_mm_s2": 4000.0,
        "nominal": bench.Plant().truth(),
        "regulators": dict.fromkeys((*gains, "current_limit_a", "voltage_limit_v"), 1.0),
    }
    return parse_config({"machine": {"name": "study"}, "axis": {"X": axis}}, "study", made_up=True)


def draw_drive(rng: np.random.Generator) -> bench.Plant:
    """Return the bench's drive with each parameter up to 15 % off."""
    share = rng.uniform(0.85, 1.15, len(PARAMETERS))
    return bench.Plant(**{name: v * s for (name, v), s in zip(bench.Plant().truth().items(), share, strict=True)})


def record_rapids(
    plant: bench.Plant, rng: np.random.Generator, moves: int, celsius: float | None = None, **shuttle: float
) -> list[Window]:
    """Return the windows of a noisy ``shuttle`` of ``moves`` rapids."""
    signals = bench.simulate_bench(plant, bench.make_shuttle_demand(moves=moves, **shuttle))
    text = bench.format_as_csv(signals, NOISE, int(rng.integers(2**31)))
    return [replace(w, temperature_c=celsius) for w in find_windows(parse_recording(text))]


def estimate_accepted(outcomes: Sequence[WindowOutcome]) -> tuple[Array, Array]:
    """Return values and standard deviations (n, 6) of the accepted windows."""
    estimates = [o.estimate for o in outcomes if o.verdict.accepted and o.estimate is not None]
    values = np.array([e.values for e in estimates])
    return values, np.array([np.sqrt(np.diag(e.covariance)) for e in estimates])


def measure_warming_slopes(seed: int) -> Array:
    """Return the relative errors of the slopes of ft and Cd, and whether their intervals cover the truth (2, 2)."""
    rng = np.random.default_rng([1, seed])
    plant = draw_drive(rng)
    outcomes = []
    for celsius in np.linspace(20.0, 22.0, SHUTTLES):
        warm = celsius - 20.0
        ft, cd = plant.ft * (1 + FT_PER_KELVIN * warm), plant.Cd * (1 + CD_PER_KELVIN * warm)
        outcomes += [
            analyse_window(w, SETTINGS)
            for w in record_rapids(replace(plant, ft=ft, Cd=cd), rng, RAPIDS, float(celsius))
        ]
    kept = [o for o in outcomes if o.verdict.accepted]
    values, stds = estimate_accepted(kept)
    against = np.array([o.window.temperature_c for o in kept], dtype=np.float64)
    rows = []
    for k, truth in ((4, plant.ft * FT_PER_KELVIN), (5, plant.Cd * CD_PER_KELVIN)):
        line = fit_slope(values[:, k], against, stds[:, k])
        assert line is not None
        low, high = line.compute_interval()
        rows.append([line.value / truth - 1, low <= truth <= high])
    return np.array(rows, dtype=np.float64)


def detect_step(seed: int) -> tuple[tuple[str, ...], int, bool]:
    """Return the notices at the first rapid after a step of Jt, the rapids to its publication, what history says.

    3 to 8 rapids go before the step, 5 after it. The last is whether the history finds that step of Jt and no other.
    """
    rng = np.random.default_rng([2, seed])
    plant = draw_drive(rng)
    before = int(rng.integers(3, 9))
    loaded = replace(plant, Jt=plant.Jt * STEP)
    pipeline = AxisPipeline("X", make_machine(), with_skill=False)
    windows = [*record_rapids(plant, rng, before), *record_rapids(loaded, rng, 5)]
    codes: list[tuple[str, ...]] = []
    published, outcomes = 0, []
    for k, window in enumerate(windows):
        results = pipeline.process_record(replace(window, start_tick=10_000 * k))
        outcomes += [r for r in results if isinstance(r, WindowOutcome)]
        codes.append(tuple(r.code for r in results if isinstance(r, Notice)))
        sets = [r for r in results if isinstance(r, ParameterSet)]
        if k >= before and not published and any(abs(s.parameters.Jt / loaded.Jt - 1) < 0.02 for s in sets):
            published = k - before + 1
    found = find_steps(*estimate_accepted(outcomes))
    return codes[before], published, [(s.name, s.row) for s in found] == [("Jt", before)]


def count_false_alarms(seed: int) -> tuple[int, Counter[str], int]:
    """Return windows, notices and steps found among 20 rapids without a step, while ft and Cd fall as they warm up."""
    rng = np.random.default_rng([3, seed])
    plant = draw_drive(rng)
    pipeline = AxisPipeline("X", make_machine(), with_skill=False)
    notices: Counter[str] = Counter()
    outcomes = []
    for k in range(SHUTTLES):
        warm = 2.0 * k / SHUTTLES
        ft, cd = plant.ft * (1 + FT_PER_KELVIN * warm), plant.Cd * (1 + CD_PER_KELVIN * warm)
        for window in record_rapids(replace(plant, ft=ft, Cd=cd), rng, 1, 20.0 + warm):
            results = pipeline.process_record(replace(window, start_tick=10_000 * k))
            notices.update(r.code for r in results if isinstance(r, Notice))
            outcomes += [r for r in results if isinstance(r, WindowOutcome)]
    return SHUTTLES, notices, len(find_steps(*estimate_accepted(outcomes)))


def compare_published_sets(seed: int) -> Array:
    """Return how many standard deviations each published parameter is off: (kelvin, speeds, set, 6), NaN for no set.

    24 rapids to and fro while the slide-way warms, at one speed or at three; a set is compared with the drive as it is
    at its newest rapid. The daemon has no temperature.
    """
    rng = np.random.default_rng([6, seed])
    plant = draw_drive(rng)
    off = np.full((len(KELVINS), 2, PUBLISHED, len(PARAMETERS)), np.nan)
    for (k, mixed), at in zip(np.ndindex(off.shape[:2]), off.reshape(-1, PUBLISHED, len(PARAMETERS)), strict=True):
        pipeline = AxisPipeline("X", make_machine(), with_skill=False)
        for rapid in range(PUBLISHED):
            warm = KELVINS[k] * rapid / (PUBLISHED - 1)
            ft, cd = plant.ft * (1 + FT_PER_KELVIN * warm), plant.Cd * (1 + CD_PER_KELVIN * warm)
            now = replace(plant, ft=ft, Cd=cd)
            speed = float(rng.choice(SPEEDS)) if mixed else SPEEDS[0]
            for window in record_rapids(now, rng, 1, speed=speed, first=1 - 2 * (rapid % 2)):
                for told_ in pipeline.process_record(replace(window, start_tick=10_000 * rapid)):
                    if isinstance(told_, ParameterSet):
                        errors = np.subtract(list(told_.parameters.as_dict().values()), list(now.truth().values()))
                        at[rapid] = errors / np.sqrt(np.diag(told_.covariance)[: len(PARAMETERS)])
    return off


def compute_pool_errors(seed: int) -> Array:
    """Return the relative errors (6,) of four pooled rapids."""
    rng = np.random.default_rng([4, seed])
    plant = draw_drive(rng)
    estimate, verdict = pool_windows([analyse_window(w, SETTINGS) for w in record_rapids(plant, rng, RAPIDS)], SETTINGS)
    if estimate is None or not verdict.accepted:
        return np.full(len(PARAMETERS), np.nan)
    errors: Array = estimate.values / np.array([plant.truth()[name] for name in PARAMETERS]) - 1
    return errors


def predict_limit_date(seed: int) -> tuple[bool, bool, float]:
    """Return whether the date of a limit was predicted, whether its interval covered it, and its error (days).

    Cd wears by 0.5 % a day; 30 daily rapids; the limit is 50 % more, 100 days from the first.
    """
    rng = np.random.default_rng([5, seed])
    plant = draw_drive(rng)
    days = np.arange(30.0)
    outcomes = [
        analyse_window(record_rapids(replace(plant, Cd=plant.Cd * (1 + 0.005 * d)), rng, 1)[0], SETTINGS) for d in days
    ]
    values, stds = estimate_accepted(outcomes)
    kept = np.array([o.verdict.accepted for o in outcomes])
    line = fit_slope(values[:, 5], days[kept], stds[:, 5])
    reached = find_crossing(line, 1.5 * plant.Cd) if line else None
    if reached is None:
        return False, False, np.nan
    return True, reached.low <= 100.0 <= reached.high, reached.at - 100.0


def measure(run: Callable[[Callable[[int], Any], int], list[Any]], counts: Mapping[str, int]) -> dict[str, list[Any]]:
    """Return what came of every repetition of every part; ``run`` maps a function over seeds."""
    parts = {
        "warming": measure_warming_slopes,
        "steps": detect_step,
        "quiet": count_false_alarms,
        "sets": compare_published_sets,
        "pools": compute_pool_errors,
        "due": predict_limit_date,
    }
    return {name: run(part, counts[name]) for name, part in parts.items()}


def page(run: pages.Run, figures: Mapping[str, Any]) -> str:
    """Return the study's page."""
    lines = pages.write_head("Drift, load and pools", "drift", run)
    lines += wrap_paragraph(
        f"""Simulated rapids of 0.4 m at 0.5 m/s with {100 * NOISE:g} % noise, of drives whose parameters are each
        drawn up to 15 % off the bench's. Every window goes the daemon's way: found, identified, validated,
        tracked."""
    )
    lines += _describe_warming(np.array(figures["warming"], dtype=np.float64))
    lines += _describe_steps(figures["steps"], figures["quiet"])
    if "sets" in figures:
        lines += _describe_sets(np.array(figures["sets"], dtype=np.float64))
    lines += _describe_pools(100 * np.array(figures["pools"], dtype=np.float64))
    lines += _describe_limit_dates(figures["due"])
    return "\n".join(lines)


def _describe_warming(found: Array) -> list[str]:
    rows = []
    for k, name in enumerate(("ft", "Cd")):
        errors, held = 100 * found[:, k, 0], found[:, k, 1]
        within = 100 * np.mean(np.abs(errors) <= 10)
        rows.append([
            name, f"{within:.0f} %", f"{np.median(np.abs(errors)):.1f} %", f"{np.abs(errors).max():.1f} %",
            f"{errors.mean():+.1f} %", f"{100 * held.mean():.0f} %",
        ])  # fmt: skip
    head = ["slope of", "within 10 %", "median error", "largest error", "bias", "95 % intervals that hold it"]
    lines = ["## Slopes from warming shuttles", ""]
    lines += wrap_paragraph(
        f"""{SHUTTLES} shuttles of {RAPIDS} rapids each while the slide-way warms from 20 to 22 degC: ft falls by {
            -100 * FT_PER_KELVIN:.0f} % per kelvin, Cd by {-100 * CD_PER_KELVIN:.0f} %. {found.shape[0]} repetitions."""
    )
    return [*lines, *write_table(head, rows), ""]


def _describe_steps(found: Sequence[Any], silent: Sequence[Any]) -> list[str]:
    """``found``: (codes, rapids, alone) of each step; ``silent``: (windows, notices, steps) of each quiet history."""
    runs = len(found)
    first = Counter(", ".join(codes) or "nothing" for codes, _, _ in found)
    later = Counter(published for _, published, _ in found)
    history = sum(alone for _, _, alone in found)
    windows = sum(count for count, _, _ in silent)
    notices: Counter[str] = Counter()
    for _, told_, _ in silent:
        notices.update(told_)
    false = ", ".join(f"{count} {code}" for code, count in notices.most_common()) or "none"
    named = ", ".join(f"{what}: {count} of {runs}" for what, count in first.most_common())
    used = ", ".join(f"at rapid {k}: {count}" if k else f"not within 5: {count}" for k, count in sorted(later.items()))
    lines = ["## A changed load", ""]
    lines += wrap_paragraph(
        f"""Jt steps by {100 * (STEP - 1):.0f} % after 3 to 8 rapids. What is told at the first rapid after it:
        {named}. The new Jt is published (within 2 %) {used}. The history finds that one step, at that rapid, in
        {history} of {runs}."""
    )
    lines += wrap_paragraph(
        f"""Without a step, in {windows} windows of drives that warm up (ft falls by {-200 * FT_PER_KELVIN:.0f} %, Cd
        by {-200 * CD_PER_KELVIN:.0f} % within {SHUTTLES} rapids), the notices are: {false}; steps in the history:
        {sum(count for _, _, count in silent)} in {len(silent)} histories."""
    )
    return lines


def _describe_sets(off: Array) -> list[str]:
    """``off``: (repetition, kelvin, speeds, set, 6) standard deviations."""
    rows = []
    for k, mixed in np.ndindex(off.shape[1:3]):
        held = off[:, k, mixed].reshape(-1, len(PARAMETERS))
        known = held[~np.isnan(held).any(axis=1)]
        share = 100 * np.mean(np.abs(known) < INTERVAL_95, axis=0)
        rows.append([
            f"{KELVINS[k]:g} K", "mixed" if mixed else "one", str(len(known)), *(f"{one:.0f} %" for one in share),
        ])  # fmt: skip
    lines = ["## What is published while the slide-way warms", ""]
    lines += wrap_paragraph(
        f"""{PUBLISHED} rapids to and fro, at {SPEEDS[0]:g} m/s or at {", ".join(f"{v:g}" for v in SPEEDS)} m/s mixed,
        while friction follows the temperature as above, which the daemon does not know. After each rapid a set is
        published; listed is how many of their 95 % intervals hold the drive as it then is. {off.shape[0]}
        repetitions."""
    )
    return [*lines, *write_table(["warming", "speeds", "sets", *PARAMETERS], rows), ""]


def _describe_pools(errors: Array) -> list[str]:
    held = ~np.isnan(errors).any(axis=1)
    rows = []
    for k, name in enumerate(PARAMETERS):
        of_name = errors[held, k]
        share = 100 * np.mean(np.abs(of_name) <= WITHIN[name])
        rows.append([
            name, f"{WITHIN[name]:g} %", f"{share:.0f} %", f"{np.sqrt(np.mean(of_name**2)):.3f} %",
            f"{np.abs(of_name).max():.3f} %",
        ])  # fmt: skip
    head = ["", "wanted", "pools within it", "RMS error", "largest error"]
    lines = ["## Four rapids pooled", ""]
    told_ = f"{errors.shape[0]} pools of {RAPIDS} rapids, {int(held.sum())} of them accepted."
    return [*lines, *wrap_paragraph(told_), *write_table(head, rows), ""]


def _describe_limit_dates(found: Sequence[Any]) -> list[str]:
    dated = [(held, error) for told_, held, error in found if told_]
    lines = ["## The date of a maintenance limit", ""]
    told_ = f"""Cd wears by 0.5 % a day; after 30 daily rapids, 70 days ahead of the limit, a date is told in
        {len(dated)} of {len(found)} histories"""
    if dated:
        told_ += f""", {np.median(np.abs([error for _, error in dated])):.1f} days off in the median; the 95 % interval
        holds the true day in {100 * np.mean([held for held, _ in dated]):.0f} %"""
    return lines + wrap_paragraph(told_ + ".")


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    counts = {"warming": 50, "steps": 100, "quiet": 100, "sets": 50, "pools": 200, "due": 60}
    for name, count in counts.items():
        parser.add_argument(f"--{name}", type=int, default=count)

    def measured(options: argparse.Namespace) -> dict[str, list[Any]]:
        with ProcessPoolExecutor(options.processes) as executor:
            return measure(
                lambda work, count: list(executor.map(work, range(count), chunksize=2)),
                {name: getattr(options, name) for name in counts},
            )

    def seeds(options: argparse.Namespace) -> str:
        return "; ".join(f"{name} 0 to {getattr(options, name) - 1}" for name in counts)

    pages.run_study("drift", parser, seeds, measured)


if __name__ == "__main__":
    main()
