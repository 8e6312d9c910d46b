"""The paper's comparison on the same noisy rapids: operators, moments, instruments, likelihood, and the bound.

Every method sees the same rows (``python -m studies.comparison``): three noises, three sampling periods, three
low-passes. Values are taken before anything is withheld, so that what ruins a method can be seen. The page goes to
``docs/studies/comparison.md`` with a plot beside it.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from fdhil.config import Identification
from fdhil.identification.estimators import least_squares, maximum_likelihood, partial_moments
from fdhil.identification.filtering import filter_zero_phase
from fdhil.records import PARAMETERS, Recording, Window, freeze_array
from fdhil.store.recording_csv import parse_recording
from studies import bench, instrumental_variables, pages
from studies.comparison_page import Figures, draw_figure, write_text
from studies.derivative_operators import OPERATORS
from studies.estimators import TRUTH, Array, add_white_noise, compute_bound

NOISES = (0.001, 0.005, 0.01)
PERIODS_S = (0.25e-3, 1e-3, 2e-3)
# the second is what the product uses where nothing else is set
FILTERS_HZ = {"none": 1e5, "40 Hz": Identification().lowpass_hz, "150 Hz": 150.0}
METHODS = (*OPERATORS, "partial_moments", "instrumental_variables", "maximum_likelihood")
CHUNK = 10
SURE_95 = 1.96


@lru_cache(maxsize=4)
def record_clean_rapid(period_s: float) -> Recording:
    """Return the noise-free recording of one rapid, sampled every ``period_s``."""
    demand = bench.make_shuttle_demand()
    demand = demand[: demand.size // 2 * 2]
    signals = bench.simulate_bench(bench.Plant(), demand, dt_s=period_s)
    return parse_recording(bench.format_as_csv(signals, 0.0))


def estimate_by_methods(windows: Sequence[Window], lowpass_hz: float) -> list[Array]:
    """Return what each method but the last makes of the windows: [R, L, K, Jt, ft, Cd] (6,) each."""
    settings = Identification(lowpass_hz=lowpass_hz)
    signals = [least_squares.align_signals(w, settings) for w in windows]
    found = []
    for operator in OPERATORS.values():
        parts = [least_squares.build_regressors(s, w.dt_s, operator) for s, w in zip(signals, windows, strict=True)]
        found.append(estimate_in_two_steps(parts))
    steps = partial_moments.count_horizon_steps(settings, windows[0].dt_s)
    found.append(estimate_in_two_steps([partial_moments.compute_moments(w, steps) for w in windows]))
    paired = instrumental_variables.raw_values(windows, settings)
    found.append(np.full(6, np.nan) if paired is None else paired)
    return found


def estimate_in_two_steps(parts: Sequence[tuple[Array, Array]]) -> Array:
    """Return [R, L, K, Jt, ft, Cd] (6,) of rows (m, 4) of [u, Di, i, w] and of [i, Dw, w, sign w]."""
    electrical, mechanical = (np.vstack([part[k] for part in parts]) for k in (0, 1))
    return least_squares.solve_two_steps(electrical, mechanical)[0][least_squares.PARAMETER_ORDER]


def filter_all_but_voltage(windows: Sequence[Window]) -> Array:
    """Return zero forcing #1 with the low-pass on current and speed alone."""
    hz = Identification().lowpass_hz
    half = [
        replace(
            w,
            current_a=freeze_array(filter_zero_phase(w.current_a, hz, w.dt_s)),
            speed_rad_s=freeze_array(filter_zero_phase(w.speed_rad_s, hz, w.dt_s)),
        )
        for w in windows
    ]
    return estimate_by_methods(half, FILTERS_HZ["none"])[0]


def run_chunk(case: tuple[float, float], first: int) -> tuple[Array, Array]:
    """Return relative errors (runs, filters, methods, 6) of ``CHUNK`` runs, and those with the voltage left raw."""
    period_s, noise = case
    errors, one_sided = [], []
    for seed in range(first, first + CHUNK):
        windows = add_white_noise(record_clean_rapid(period_s), noise, seed)
        likely = maximum_likelihood.estimate(windows, Identification()).values
        errors.append([[*estimate_by_methods(windows, hz), likely] for hz in FILTERS_HZ.values()])
        one_sided.append(filter_all_but_voltage(windows))
    return np.array(errors) / TRUTH - 1, np.array(one_sided) / TRUTH - 1


def summarise_case(case: tuple[float, float], errors: Array, one_sided: Array) -> Figures:
    """Return the figures of a case from its runs' errors."""
    period_s, noise = case
    return Figures(
        noise=noise,
        period_s=period_s,
        rms=100 * np.sqrt((errors**2).mean(axis=0)),
        bias=100 * errors.mean(axis=0),
        rejected=compute_rejection_shares(errors),
        one_sided=100 * np.array([np.sqrt((one_sided**2).mean(axis=0)), one_sided.mean(axis=0)]),
        bound=100 * compute_bound(record_clean_rapid(period_s), noise) / TRUTH,
    )


def compute_rejection_shares(errors: Array) -> Array:
    """Return the share (filters, methods, 6) of runs on which an estimate differs surely from the likelihood's.

    Durbin, Wu and Hausman: the likelihood is consistent and efficient, so without bias the difference of another
    method's estimate from it has mean 0 and the variance that it shows over the runs.
    """
    contrast = errors - errors[:, :, -1:]
    spread = contrast.std(axis=0, ddof=1)
    share: Array = (np.abs(contrast) > SURE_95 * np.where(spread > 0, spread, np.inf)).mean(axis=0)
    return share


def compare(runs: int, processes: int) -> list[Figures]:
    """Return the figures of all cases, noises within periods."""
    cases = list(product(PERIODS_S, NOISES))
    firsts = range(0, runs, CHUNK)
    with ProcessPoolExecutor(processes) as executor:
        reported = {case: list(executor.map(partial(run_chunk, case), firsts)) for case in cases}
    return [
        summarise_case(case, *(np.concatenate([part[k] for part in parts]) for k in (0, 1)))
        for case, parts in reported.items()
    ]


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Return the figures of all cases, and what their axes are."""
    found = [asdict(figures) for figures in compare(options.runs, options.processes)]
    return {"runs": options.runs, "methods": METHODS, "filters": list(FILTERS_HZ), "cases": found}


def page(run: pages.Run, figures: Mapping[str, Any]) -> str:
    """Return the study's page."""
    return write_text(run, list_cases(figures), (figures["methods"], figures["filters"], PARAMETERS), figures["runs"])


def draw(figures: Mapping[str, Any], path: Path) -> None:
    """Draw the plot."""
    from matplotlib import rc_context

    with rc_context({"svg.hashsalt": "fdhil"}):
        drawing = draw_figure(list_cases(figures), (figures["methods"], figures["filters"], PARAMETERS))
        drawing.savefig(path, metadata={"Date": None})


def list_cases(figures: Mapping[str, Any]) -> list[Figures]:
    """Return the cases of a page's figures."""
    numbers = ("rms", "bias", "rejected", "one_sided", "bound")
    return [
        Figures(**{**case, **{k: np.array(case[k], dtype=np.float64) for k in numbers}}) for case in figures["cases"]
    ]


def main() -> None:
    """Run the comparison."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100)
    pages.run_study("comparison", parser, lambda o: f"0 to {o.runs - 1} in each case", measure)


if __name__ == "__main__":
    main()
