"""A voltage sensor slower than the drive (``python -m studies.slow_sensor``): intervals, refusals, and their figures.

The first table tells how well the six parameters and the delay are known from one rapid of the bench, and how often
their 95 % intervals hold the truth. The second tells what becomes of good and bad recordings of random drives whose
voltage comes from such a sensor, on a grid and with a delay of its own. Both go to ``docs/studies/slow_sensor.md``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import product
from typing import Any

import numpy as np

from fdhil.config import Identification
from fdhil.identification.estimators import maximum_likelihood
from fdhil.identification.rapid_windows import find_windows
from fdhil.records import PARAMETERS, SlowVoltage, VoltageSampling, Window, freeze_array
from fdhil.store.recording_csv import parse_recording
from studies import bench, pages
from studies.drives import Array
from studies.judging import GOOD, Judged, Tally, assess_recording, assess_seeds, count_by_kind, describe_results
from studies.slow_recordings import KINDS, PERIODS_S, TO_AND_FRO, make_study_recording, sample_voltage

SETTINGS = Identification()
TRUTH = np.array([bench.Plant().truth()[name] for name in PARAMETERS])
NOISES = (0.001, 0.005)
SAMPLINGS: tuple[VoltageSampling, ...] = ("interval_mean", "instant")


@lru_cache(maxsize=4)
def _simulate_shuttle(moves: int) -> tuple[bench.Signals, Array]:
    """Return a noise-free shuttle of the bench, and its voltage every 31.25 us."""
    demand = bench.make_shuttle_demand(moves=moves)
    return bench.simulate_bench(bench.Plant(), demand), bench.simulate_bench(
        bench.Plant(), demand, dt_s=bench.STEP_S
    ).voltage


def record_slow_windows(
    period_s: float = 0.005,
    sampling: VoltageSampling = "interval_mean",
    delay_s: float = 0.0,
    noise: float = 0.001,
    seed: int = 1,
    moves: int = 1,
    begin_s: float = 0.0017,
) -> list[Window]:
    """Return the rapids of a shuttle; voltage sample j truly begins at ``begin_s`` + j ``period_s`` - ``delay_s``.

    The true voltage is taken from the bench every 31.25 us, so means and instants are the sensor's own.
    """
    clean, fine = _simulate_shuttle(moves)
    rng = np.random.default_rng(1000 + seed)
    answer = []
    for window in find_windows(parse_recording(bench.format_as_csv(clean, noise, seed))):
        count = int((window.n * window.dt_s - begin_s) / period_s)
        begin = window.start_s + begin_s - delay_s + np.arange(count) * period_s
        reported = sample_voltage(fine, bench.STEP_S, begin, period_s, sampling) + noise * 60 * rng.standard_normal(
            count
        )
        slow = SlowVoltage(begin_s, period_s, 0.0002, freeze_array(reported))
        answer.append(replace(window, voltage_v=None, voltage_sampling=sampling, slow_voltage=slow))
    return answer


@dataclass(frozen=True, slots=True)
class Case:
    """One setting of the first table."""

    sampling: VoltageSampling
    period_s: float
    noise: float


def fit_once(case: Case, seed: int) -> tuple[Array, Array, float]:
    """Return errors (7,) and standard deviations (7,) of the six parameters and the delay, and the fit's seconds."""
    rng = np.random.default_rng([case.noise > 0.002, round(1e3 * case.period_s), seed])
    delay, begin = rng.uniform(-0.6, 0.6) * case.period_s, rng.uniform(0, case.period_s)
    windows = record_slow_windows(case.period_s, case.sampling, delay, case.noise, seed, begin_s=begin)
    started = time.process_time()
    estimate = maximum_likelihood.estimate(windows, SETTINGS)
    spent = time.process_time() - started
    late, late_std = (np.nan if x is None else x for x in (estimate.delay_s, estimate.delay_std_s))
    errors = np.append(estimate.values - TRUTH, late - delay)
    return errors, np.append(np.sqrt(np.diag(estimate.covariance)), late_std), spent


def measure_intervals(seeds: range, processes: int) -> list[dict[str, Any]]:
    """Return for each setting RMS errors (7,), the coverage (7,) of 95 % intervals, and a fit's time."""
    found = []
    for sampling, period, noise in product(SAMPLINGS, PERIODS_S, NOISES):
        made = list(assess_seeds(seeds, partial(fit_once, Case(sampling, period, noise)), processes))
        errors, stds = np.array([m[0] for m in made]), np.array([m[1] for m in made])
        share = np.nanmean(np.where(np.isfinite(errors), np.abs(errors) <= 1.96 * stds, np.nan), axis=0)
        found.append({
            "sampling": sampling, "period_s": period, "noise": noise, "share": share,
            "rms": np.sqrt(np.nanmean(errors**2, axis=0)) / np.append(TRUTH / 100, 1e-6),
            "not_published": int(np.isnan(errors).sum()), "fit_ms": 1e3 * float(np.median([m[2] for m in made])),
        })  # fmt: skip
    return found


def assess_good_recording(seed: int, study: int) -> Judged:
    """Assess one valid recording: one rapid, or every other time two."""
    return assess_recording(GOOD, seed, make_study_recording(seed, study, TO_AND_FRO if seed % 2 else GOOD))


def assess_bad_recording(seed: int, study: int) -> Judged:
    """Assess one recording with the kind of fault that ``seed`` chooses."""
    name = list(KINDS)[seed % len(KINDS)]
    return assess_recording(name, seed, make_study_recording(seed, study, name))


def count_verdicts(seeds_of_good: range, seeds_of_bad: range, study: int, processes: int) -> dict[str, Any]:
    """Return the results of the recordings, by kind, and print those with a wrong verdict."""
    results = list(assess_seeds(seeds_of_good, partial(assess_good_recording, study=study), processes))
    results += assess_seeds(seeds_of_bad, partial(assess_bad_recording, study=study), processes)
    for one in results:
        if one.refused if one.kind == GOOD else one.accepted:
            print(f"judged wrongly: {one.kind}, seed {one.seed}, {one.severity:.3g}", *one.texts, flush=True)
    return {name: vars(entry) for name, entry in count_by_kind(results, KINDS).items()}


def page(run: pages.Run, figures: Mapping[str, Any]) -> str:
    """Return the study's page."""
    lines = pages.write_head("A voltage sensor slower than the drive", "slow_sensor", run)
    lines += pages.wrap_paragraph(
        """The sensor samples on a grid of its own, later or earlier than it says by up to 0.6 of its samples, which the
        fit finds as a seventh parameter."""
    )
    lines += ["## How well the parameters are known", ""]
    lines += pages.wrap_paragraph(
        f"{figures['runs']} runs a row: one rapid of the bench, rows at 1 kHz. "
        f"{_describe_sampling(figures['intervals'])}"
    )
    lines += pages.wrap_paragraph(
        """RMS error in % of the truth (the delay's in us); in brackets the share of 95 % intervals that hold the truth.
        A parameter that is not published in a run is left out of its figures, and counted."""
    )
    columns = ["voltage", "sensor", "noise", *PARAMETERS, "delay", "not published", "a fit"]
    lines += [*pages.write_table(columns, [_format_row(told) for told in figures["intervals"]]), ""]
    lines += ["## Good windows refused, bad windows accepted", ""]
    lines += pages.wrap_paragraph(
        """Random drives and rapids as in [the verdicts](verdicts.md), rows 0.25 to 1 ms apart, seeds of their own:
        every kind of fault that is drawn there, and the slow sensor's own. Every other good recording holds a rapid to
        and one fro. R and L are told by the voltage's course alone: where so slow a sensor leaves them open, they are
        null with the reason, and the window is accepted all the same. So the parameter that moves between two rapids is
        Jt or K; and a current or speed that sticks does so for three samples of the voltage at least, which alone may
        tell."""
    )
    return "\n".join([*lines, *describe_results({k: Tally.parse(v) for k, v in figures["verdicts"].items()}, KINDS)])


def _describe_sampling(found: Sequence[Mapping[str, Any]]) -> str:
    """Describe the parameters' errors by each way of sampling, and the lowest coverage of their intervals."""
    words = []
    for sampling in dict.fromkeys(told["sampling"] for told in found):
        rms = np.array([told["rms"] for told in found if told["sampling"] == sampling], dtype=np.float64)
        most = [f"{name} {worst:.2g}" for name, worst in zip(PARAMETERS, rms.max(axis=0), strict=False)]
        words.append(f"{sampling.replace('_', ' ')}s at most {', '.join(most)} %")
    shares = [(share, name, told) for told in found for share, name in _compute_shares(told)]
    share, name, reported = min(shares, key=lambda one: one[0])
    sampling, rate_hz = reported["sampling"].replace("_", " "), 1 / reported["period_s"]
    place = f"{sampling}s at {rate_hz:g} Hz and {100 * reported['noise']:g} % noise"
    return f"""RMS errors: {"; ".join(words)}. Of all 95 % intervals that of {name} holds the truth least often:
        {100 * share:.0f} % ({place})."""


def _compute_shares(told: Mapping[str, Any]) -> list[tuple[float, str]]:
    named = zip(told["share"], (*PARAMETERS, "the delay"), strict=True)
    return [(share, name) for share, name in named if share is not None]


def _format_row(told: Mapping[str, Any]) -> list[str]:
    figures = np.array([told["rms"], told["share"]], dtype=np.float64).T
    cells = [f"{rms:.3g} ({100 * share:.0f} %)" for rms, share in figures]
    first = [f"{told['sampling'].replace('_', ' ')}s", f"{1 / told['period_s']:g} Hz", f"{100 * told['noise']:g} %"]
    return [*first, *cells, str(told["not_published"]), f"{told['fit_ms']:.0f} ms"]


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100, help="rapids for each row of the first table")
    parser.add_argument("--good", type=int, default=800, help="good recordings of the second table")
    parser.add_argument("--bad", type=int, default=1140, help="bad recordings of the second table")
    parser.add_argument("--first", type=int, default=1000, help="the first seed")
    parser.add_argument("--study", type=int, default=7, help="seed of the drives of the second table")

    def seeds(options: argparse.Namespace) -> str:
        last = [options.first + count - 1 for count in (options.runs, options.good, options.bad)]
        reported = [f"{what} {options.first} to {k}" for what, k in zip(("rapids", "good", "bad"), last, strict=True)]
        return f"study {options.study}; {', '.join(reported)}"

    def measured(options: argparse.Namespace) -> dict[str, Any]:
        runs, good, bad = (range(options.first, options.first + n) for n in (options.runs, options.good, options.bad))
        return {
            "runs": options.runs,
            "intervals": measure_intervals(runs, options.processes),
            "verdicts": count_verdicts(good, bad, options.study, options.processes),
        }

    pages.run_study("slow_sensor", parser, seeds, measured)


if __name__ == "__main__":
    main()
