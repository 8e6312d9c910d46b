"""A voltage sensor slower than the drive (``python -m studies.slow_sensor``): intervals, refusals, and their figures.

The first table tells how well the six parameters and the delay are known from one rapid of the bench, and how often
their 95 % intervals hold the truth. The second tells what becomes of good and bad recordings of random drives whose
voltage comes from such a sensor, on a grid and with a delay of its own. Both go to ``docs/studies/slow_sensor.md``.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from fdhil.config import Identification
from fdhil.identification.estimators import maximum_likelihood
from fdhil.identification.windows import find_windows
from fdhil.records import PARAMETERS, SlowVoltage, VoltageSampling, Window, frozen
from fdhil.store.recording_csv import parse_recording
from studies import bench
from studies.drives import Array
from studies.judging import GOOD, Judged, judge, survey, tables, tally
from studies.slow_recordings import KINDS, PERIODS_S, TO_AND_FRO, recording_of, sampled

SETTINGS = Identification()
TRUTH = np.array([bench.Plant().truth()[name] for name in PARAMETERS])
NOISES = (0.001, 0.005)
SAMPLINGS: tuple[VoltageSampling, ...] = ("interval_mean", "instant")


@lru_cache(maxsize=4)
def _shuttle(moves: int) -> tuple[bench.Signals, Array]:
    """Return a noise-free shuttle of the bench, and its voltage every 31.25 us."""
    demand = bench.shuttle(moves=moves)
    return bench.run(bench.Plant(), demand), bench.run(bench.Plant(), demand, dt_s=bench.STEP_S).voltage


def slow_windows(
    period_s: float = 0.005,
    sampling: VoltageSampling = "interval_mean",
    delay_s: float = 0.0,
    noise: float = 0.001,
    seed: int = 1,
    moves: int = 1,
    begin_s: float = 0.0017,
) -> list[Window]:
    """Return the rapids of a shuttle; sample j of the voltage truly covers ``begin_s`` + j ``period_s`` - ``delay_s``.

    The true voltage is taken from the bench every 31.25 us, so means and instants are the sensor's own.
    """
    clean, fine = _shuttle(moves)
    rng = np.random.default_rng(1000 + seed)
    answer = []
    for window in find_windows(parse_recording(bench.as_csv(clean, noise, seed))):
        count = int((window.n * window.dt_s - begin_s) / period_s)
        begin = window.start_s + begin_s - delay_s + np.arange(count) * period_s
        told = sampled(fine, bench.STEP_S, begin, period_s, sampling) + noise * 60 * rng.standard_normal(count)
        slow = SlowVoltage(begin_s, period_s, 0.0002, frozen(told))
        answer.append(replace(window, voltage_v=None, voltage_sampling=sampling, slow_voltage=slow))
    return answer


@dataclass(frozen=True, slots=True)
class Case:
    """One setting of the first table."""

    sampling: VoltageSampling
    period_s: float
    noise: float


def one_fit(case: Case, seed: int) -> tuple[Array, Array, float]:
    """Return errors (7,) and standard deviations (7,) of the six parameters and the delay, and the fit's seconds."""
    rng = np.random.default_rng([case.noise > 0.002, round(1e3 * case.period_s), seed])
    delay, begin = rng.uniform(-0.6, 0.6) * case.period_s, rng.uniform(0, case.period_s)
    windows = slow_windows(case.period_s, case.sampling, delay, case.noise, seed, begin_s=begin)
    started = time.process_time()
    estimate = maximum_likelihood.estimate(windows, SETTINGS)
    spent = time.process_time() - started
    late, late_std = (np.nan if x is None else x for x in (estimate.delay_s, estimate.delay_std_s))
    errors = np.append(estimate.values - TRUTH, late - delay)
    return errors, np.append(np.sqrt(np.diag(estimate.covariance)), late_std), spent


def intervals_page(seeds: range, processes: int) -> str:
    """Return the table of errors and coverage."""
    lines = [
        "RMS error in % of the truth (the delay's in us); in brackets the share of 95 % intervals that hold the truth.",
        "A parameter that is not published in a run is left out of its figures, and counted.",
        "",
        "| voltage | sensor | noise | " + " | ".join(PARAMETERS) + " | delay | not published | a fit |",
        "|---" * 12 + "|",
    ]
    for sampling in SAMPLINGS:
        for period in PERIODS_S:
            for noise in NOISES:
                case = Case(sampling, period, noise)
                made = list(survey(seeds, partial(one_fit, case), processes))
                errors, stds = np.array([m[0] for m in made]), np.array([m[1] for m in made])
                share = np.nanmean(np.where(np.isfinite(errors), np.abs(errors) <= 1.96 * stds, np.nan), axis=0)
                rms = np.sqrt(np.nanmean(errors**2, axis=0)) / np.append(TRUTH / 100, 1e-6)
                cells = [f"{r:.3g} ({100 * s:.0f} %)" for r, s in zip(rms, share, strict=True)]
                head = f"| {sampling.replace('_', ' ')}s | {1 / period:g} Hz | {100 * noise:g} % | "
                tail = f" | {int(np.isnan(errors).sum())} | {1e3 * np.median([m[2] for m in made]):.0f} ms |"
                lines.append(head + " | ".join(cells) + tail)
                print(lines[-1], flush=True)
    return "\n".join(lines)


def good(seed: int, study: int) -> Judged:
    """Judge one good recording: one rapid, or every other time two."""
    return judge(GOOD, seed, recording_of(seed, study, TO_AND_FRO if seed % 2 else GOOD))


def bad(seed: int, study: int) -> Judged:
    """Judge one recording with the kind of fault that ``seed`` chooses."""
    name = list(KINDS)[seed % len(KINDS)]
    return judge(name, seed, recording_of(seed, study, name))


def verdicts_page(seeds_of_good: range, seeds_of_bad: range, study: int, processes: int) -> str:
    """Return the table of verdicts, and print the recordings that were judged wrongly."""
    results = list(survey(seeds_of_good, partial(good, study=study), processes))
    results += survey(seeds_of_bad, partial(bad, study=study), processes)
    for one in results:
        if one.refused if one.kind == GOOD else one.accepted:
            print(f"judged wrongly: {one.kind}, seed {one.seed}, {one.severity:.3g}", *one.texts, flush=True)
    return tables(tally(results, KINDS), KINDS).rstrip()


PAGE = """# A voltage sensor slower than the drive

Written by `python -m studies.slow_sensor`. The sensor samples on a grid of its own, later or earlier than it says by up
to 0.6 of its samples, which the fit finds as a seventh parameter.

## How well the parameters are known

One rapid of the bench, rows at 1 kHz.

{intervals}

## Good windows refused, bad windows accepted

Random drives and rapids as in [the verdicts](verdicts.md), rows 0.25 to 1 ms apart, seeds of their own: every kind of
fault that is drawn there, and the slow sensor's own. Every other good recording holds a rapid to and one fro. R and L
are told by the voltage's course alone: where so slow a sensor leaves them open, they are null with the reason, and the
window is accepted all the same. So the parameter that moves between two rapids is Jt or K; and a current or speed that
sticks does so for three samples of the voltage at least, which alone may tell.

{verdicts}
"""


def parts_of(page: str) -> tuple[str, str]:
    """Return the two tables of a page that this study wrote; empty where there is none."""
    begin, rest = PAGE.split("{intervals}")
    middle, end = rest.split("{verdicts}")
    if not page.startswith(begin) or page.count(middle) != 1:
        return "", ""
    intervals, verdicts = page.removeprefix(begin).split(middle)
    return intervals, verdicts.removesuffix(end)


def main() -> None:
    """Run the study, or a part of it, and write its page; the other part of the page stays as it is."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--part", choices=("intervals", "verdicts"), help="make one table only")
    parser.add_argument("--runs", type=int, default=100, help="rapids for each row of the first table")
    parser.add_argument("--good", type=int, default=800, help="good recordings of the second table")
    parser.add_argument("--bad", type=int, default=1140, help="bad recordings of the second table")
    parser.add_argument("--first", type=int, default=1000, help="the first seed")
    parser.add_argument("--study", type=int, default=7, help="seed of the drives of the second table")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("docs/studies/slow_sensor.md"))
    options = parser.parse_args()
    runs, good, bad = (range(options.first, options.first + n) for n in (options.runs, options.good, options.bad))
    intervals, verdicts = parts_of(options.out.read_text()) if options.part and options.out.exists() else ("", "")
    if options.part != "verdicts":
        intervals = intervals_page(runs, options.processes)
    if options.part != "intervals":
        verdicts = verdicts_page(good, bad, options.study, options.processes)
        print(verdicts)
    options.out.write_text(PAGE.format(intervals=intervals, verdicts=verdicts))


if __name__ == "__main__":
    main()
