"""The product's estimators, as it publishes them, on one rapid of the bench (``python -m studies.estimators``).

The table gives each method's RMS error over its bound: the standard deviation that the information in the same noisy
rows allows. It goes to ``docs/studies/estimators.md`` with a plot beside it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

from fdhil import tables
from fdhil.config import Identification
from fdhil.identification.estimators import maximum_likelihood
from fdhil.identification.estimators.maximum_likelihood import build_problem, compute_jacobian, estimate_typical_sizes
from fdhil.identification.prepared_motion import NoiseLevels, prepare_window
from fdhil.identification.rapid_windows import find_windows
from fdhil.records import PARAMETERS, Estimate, Recording, Window
from fdhil.store.recording_csv import parse_recording
from studies import bench, instrumental_variables, pages

Array = npt.NDArray[np.float64]
Method = Callable[[list[Window]], Estimate]
TRUTH = np.array([bench.Plant().truth()[name] for name in PARAMETERS])
SIZES = np.array([60.0, 50.0, 150.0])
NOISES = (0.005, 0.001)
LASTING_ROWS = (1.0, 2.0, 5.0, 10.0, 20.0)
QUIET = 1e-5
PERIODS_S = (1e-3, 0.5e-3)


def record_clean_rapid() -> Recording:
    """Return the noise-free recording of one rapid."""
    return parse_recording(bench.format_as_csv(bench.simulate_bench(bench.Plant(), bench.make_shuttle_demand()), 0.0))


def add_white_noise(recording: Recording, noise: float, seed: int) -> list[Window]:
    """Return the rapids of the recording with white noise of ``noise`` on 60 V, 50 A and 150 rad/s."""
    scatter = noise * SIZES[:, None] * np.random.default_rng(seed).standard_normal((3, recording.speed_rad_s.size))
    return find_windows(
        replace(
            recording,
            voltage_v=recording.voltage_v + scatter[0],
            current_a=recording.current_a + scatter[1],
            speed_rad_s=recording.speed_rad_s + scatter[2],
        )
    )


def compute_bound(recording: Recording, noise: float) -> Array:
    """Return the standard deviations (6,) that the rows in which the drive surely moves allow."""
    motion = prepare_window(find_windows(recording)[0])
    problem = build_problem([motion], np.append(TRUTH, 0.0), [NoiseLevels(*(noise * SIZES))])
    residuals = problem.compute_residuals(np.append(TRUTH, 0.0))
    slope = compute_jacobian(
        problem, np.append(TRUTH, 0.0), residuals, range(6), estimate_typical_sizes(np.append(TRUTH, 0.0), [motion])
    )
    deviations: Array = np.sqrt(np.diag(np.linalg.inv(slope.T @ slope)))
    return deviations


def add_correlated_noise(recording: Recording, rows: float, seed: int) -> list[Window]:
    """Return the rapids with 0.5 % noise whose correlation falls to 1/e within ``rows``."""
    pole = np.exp(-1 / rows)
    white = np.random.default_rng(seed).standard_normal((3, 200 + recording.speed_rad_s.size))
    scatter = NOISES[0] * SIZES[:, None] * np.sqrt(1 - pole**2) * lfilter([1.0], [1.0, -pole], white, axis=1)[:, 200:]
    return find_windows(
        replace(
            recording,
            voltage_v=recording.voltage_v + scatter[0],
            current_a=recording.current_a + scatter[1],
            speed_rad_s=recording.speed_rad_s + scatter[2],
        )
    )


def compute_coverage(recording: Recording, rows: float, runs: int) -> Array:
    """Return the share (6,) of the likelihood's 95 % intervals that cover the truth with noise over ``rows``."""
    inside = []
    for seed in range(runs):
        estimate = maximum_likelihood.estimate(add_correlated_noise(recording, rows, seed), Identification())
        inside.append(np.abs(estimate.values - TRUTH) <= 1.96 * np.sqrt(np.diag(estimate.covariance)))
    share: Array = np.mean(inside, axis=0)
    return share


def compute_unfiltered_errors(period_s: float) -> Array:
    """Return the likelihood's relative errors (6,) where there is hardly any noise."""
    signals = bench.simulate_bench(bench.Plant(), bench.make_shuttle_demand(), dt_s=period_s)
    windows = add_white_noise(parse_recording(bench.format_as_csv(signals, 0.0)), QUIET, 0)
    return maximum_likelihood.estimate(windows, Identification()).values / TRUTH - 1


def list_methods() -> dict[str, Method]:
    """Return the listed estimators by name, each with the product's settings, and instrumental variables."""
    listed = {name: tables.load_entry(tables.ESTIMATORS, name) for name in tables.ESTIMATORS}
    found = listed | {instrumental_variables.NAME: instrumental_variables.estimate}
    return {name.replace("_", " "): partial(estimate, settings=Identification()) for name, estimate in found.items()}


def run_monte_carlo(method: Method, recording: Recording, noise: float, runs: int) -> tuple[Array, Array, Array]:
    """Return bias (6,), RMS error (6,) relative to the truth, and the share (6,) of 95 % intervals that hold it."""
    errors, inside = [], []
    for seed in range(runs):
        estimate = method(add_white_noise(recording, noise, seed))
        errors.append(estimate.values / TRUTH - 1)
        inside.append(np.abs(estimate.values - TRUTH) <= 1.96 * np.sqrt(np.diag(estimate.covariance)))
    reported = np.array(errors)
    return reported.mean(axis=0), np.sqrt((reported**2).mean(axis=0)), np.mean(inside, axis=0)


def measure(runs: int) -> dict[str, Any]:
    """Return for each noise the bound, and bias, RMS error and share of intervals of each method."""
    recording = record_clean_rapid()
    found = []
    for noise in NOISES:
        reported = {name: run_monte_carlo(method, recording, noise, runs) for name, method in list_methods().items()}
        rows = {name: dict(zip(("bias", "rms", "share"), figures, strict=True)) for name, figures in reported.items()}
        found.append({"noise": noise, "bound": compute_bound(recording, noise) / TRUTH, "methods": rows})
    return {
        "runs": runs,
        "noises": found,
        "lasting": [{"rows": rows, "share": compute_coverage(recording, rows, runs)} for rows in LASTING_ROWS],
        "quiet": [{"period_s": period, "error": compute_unfiltered_errors(period)} for period in PERIODS_S],
    }


def page(run: pages.Run, figures: Mapping[str, Any]) -> str:
    """Return the study's page."""
    lines = pages.write_head("Estimators on one rapid of the bench", "estimators", run)
    for part in figures["noises"]:
        limit = np.array(part["bound"])
        ratios = {name: _compute_ratios(told, limit) for name, told in part["methods"].items()}
        lines += [
            f"## {100 * part['noise']:g} % noise, {figures['runs']} runs",
            "",
            *pages.wrap_paragraph(_describe_best_method(ratios)),
        ]
        lines += ["RMS error over the bound (bias in % of the truth; share of 95 % intervals that hold the truth)", ""]
        rows = [["bound, %", *(f"{100 * x:.3f}" for x in limit)]]
        for name, reported in part["methods"].items():
            told_ = zip(
                ratios[name], _format_numbers(reported["bias"]), _format_numbers(reported["share"]), strict=True
            )
            rows.append([name, *(_format_cell(*one) for one in told_)])
        lines += [*pages.write_table(["method", *PARAMETERS], rows), ""]
    lines += ["![RMS error over the bound](estimators.svg)", ""]
    return "\n".join(
        [
            *lines,
            *_describe_correlated_noise(figures["lasting"], figures["runs"]),
            *_describe_low_noise(figures["quiet"]),
        ]
    )


def _describe_correlated_noise(found: Sequence[Mapping[str, Any]], runs: int) -> list[str]:
    shares = 100 * np.array([told["share"] for told in found])
    means = pages.join_words([f"{mean:.0f} %" for mean in shares.mean(axis=1)])
    k, j = np.unravel_index(shares.argmin(), shares.shape)
    lines = ["## Noise that lasts", ""]
    lines += pages.wrap_paragraph(
        f"""Maximum likelihood takes noise for white. Where {100 * NOISES[0]:g} % noise lasts (its correlation falls to
        1/e within so many rows), its 95 % intervals hold the truth in {means} of {runs} runs: the mean of the six, in
        the order of the table. The worst is {PARAMETERS[j]} at {found[k]["rows"]:g} rows: {shares[k, j]:.0f} %."""
    )
    rows = [[f"{told['rows']:g}", *(f"{x:.0f} %" for x in share)] for told, share in zip(found, shares, strict=True)]
    return [*lines, *pages.write_table(["rows", *PARAMETERS], rows), ""]


def _describe_low_noise(found: Sequence[Mapping[str, Any]]) -> list[str]:
    lines = ["## What is left without noise", ""]
    lines += pages.wrap_paragraph(
        f"""The voltage's mean over a sample leaves its course within the sample open. So maximum likelihood is off even
        at {100 * QUIET:g} % noise, by so many per cent of the truth; its intervals hold that as a doubt."""
    )
    rows = [[f"{1e3 * told['period_s']:g}", *(f"{100 * x:+.4f}" for x in told["error"])] for told in found]
    return [*lines, *pages.write_table(["period ms", *PARAMETERS], rows), ""]


def _describe_best_method(ratios: Mapping[str, Array]) -> str:
    """Say which method has the smallest error, and how near to the bound the best come."""
    table = np.array(list(ratios.values()))
    table = np.where(np.isfinite(table), table, np.inf)
    first = [list(ratios)[k] for k in table.argmin(axis=0)]
    wins = [f"{name} of {pages.join_words([p for p, n in zip(PARAMETERS, first, strict=True) if n == name])}"
            for name in dict.fromkeys(first)]  # fmt: skip
    least = table.min(axis=0)
    reach = f"{least.min():.2f} to {least.max():.2f}"
    return f"Smallest error: {'; '.join(wins)}. The best of each parameter is {reach} times its bound off."


def _compute_ratios(told: Mapping[str, Any], limit: Array) -> Array:
    ratios: Array = _format_numbers(told["rms"]) / limit
    return ratios


def _format_numbers(values: Any) -> Array:
    return np.array(values, dtype=np.float64)


def _format_cell(ratio: float, bias: float, share: float) -> str:
    if not np.isfinite(ratio):
        return "not published: unphysical or without an interval"
    return f"{ratio:.2f} ({100 * bias:+.2f}; {100 * share:.0f} %)"


def draw(figures: Mapping[str, Any], path: Path) -> None:
    """Draw each method's RMS error over the bound at the larger noise."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    part = figures["noises"][0]
    drawing = Figure(figsize=(9, 4.5), layout="constrained")
    axes = drawing.subplots()
    for k, (name, reported) in enumerate(part["methods"].items()):
        axes.plot(range(6), _compute_ratios(reported, np.array(part["bound"])), marker="o", label=name, zorder=2 + k)
    axes.axhline(1.0, color="black", linewidth=0.8)
    axes.set_yscale("log")
    axes.set_xticks(range(6), PARAMETERS)
    axes.set_ylabel("RMS error / bound")
    axes.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    with rc_context({"svg.hashsalt": "fdhil"}):
        drawing.savefig(path, metadata={"Date": None})


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    pages.run_study("estimators", parser, lambda o: f"0 to {o.runs - 1}", lambda o: measure(o.runs))


if __name__ == "__main__":
    main()
