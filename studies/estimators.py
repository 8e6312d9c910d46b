"""The product's estimators, as it publishes them, on one rapid of the bench (``python -m studies.estimators``).

The table gives each method's RMS error over its bound: the standard deviation that the information in the same noisy
rows allows. It goes to ``docs/studies/estimators.md`` with a plot beside it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fdhil import tables
from fdhil.config import Identification
from fdhil.identification.estimators.maximum_likelihood import jacobian, pose, typical
from fdhil.identification.motion import Noise, prepare
from fdhil.identification.windows import find_windows
from fdhil.records import PARAMETERS, Estimate, Recording, Window
from fdhil.store.recording_csv import parse_recording
from studies import bench

Array = npt.NDArray[np.float64]
Method = Callable[[list[Window]], Estimate]
TRUTH = np.array([bench.Plant().truth()[name] for name in PARAMETERS])
SIZES = np.array([60.0, 50.0, 150.0])


def clean() -> Recording:
    """Return the noise-free recording of one rapid."""
    return parse_recording(bench.as_csv(bench.run(bench.Plant(), bench.shuttle()), 0.0))


def noisy(recording: Recording, noise: float, seed: int) -> list[Window]:
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


def bound(recording: Recording, noise: float) -> Array:
    """Return the standard deviations (6,) that the rows in which the drive surely moves allow."""
    motion = prepare(find_windows(recording)[0])
    problem = pose([motion], np.append(TRUTH, 0.0), [Noise(*(noise * SIZES))])
    residuals = problem.residuals(np.append(TRUTH, 0.0))
    slope = jacobian(problem, np.append(TRUTH, 0.0), residuals, range(6), typical(np.append(TRUTH, 0.0), [motion]))
    deviations: Array = np.sqrt(np.diag(np.linalg.inv(slope.T @ slope)))
    return deviations


def methods() -> dict[str, Method]:
    """Return the listed estimators by name, each with the product's settings."""
    settings = Identification()
    return {
        name.replace("_", " "): partial(tables.load(tables.ESTIMATORS, name), settings=settings)
        for name in tables.ESTIMATORS
    }


def monte_carlo(method: Method, recording: Recording, noise: float, runs: int) -> tuple[Array, Array, Array]:
    """Return bias (6,), RMS error (6,) relative to the truth, and the share (6,) of 95 % intervals that hold it."""
    errors, inside = [], []
    for seed in range(runs):
        estimate = method(noisy(recording, noise, seed))
        errors.append(estimate.values / TRUTH - 1)
        inside.append(np.abs(estimate.values - TRUTH) <= 1.96 * np.sqrt(np.diag(estimate.covariance)))
    told = np.array(errors)
    return told.mean(axis=0), np.sqrt((told**2).mean(axis=0)), np.mean(inside, axis=0)


def page(runs: int) -> tuple[str, dict[str, Array]]:
    """Return the study's page and, for the plot, each method's RMS error over the bound at 0.5 % noise."""
    recording = clean()
    lines = ["# Estimators on one rapid of the bench", "", "Written by `python -m studies.estimators`.", ""]
    drawn: dict[str, Array] = {}
    for noise in (0.005, 0.001):
        limit = bound(recording, noise) / TRUTH
        lines += [f"## {100 * noise:g} % noise, {runs} runs", ""]
        lines += ["RMS error over the bound (bias in % of the truth; share of 95 % intervals that hold the truth)", ""]
        lines += ["| method | " + " | ".join(PARAMETERS) + " |", "|---" * 7 + "|"]
        lines.append("| bound, % | " + " | ".join(f"{100 * x:.3f}" for x in limit) + " |")
        for name, method in methods().items():
            bias, rms, share = monte_carlo(method, recording, noise, runs)
            told = zip(rms / limit, bias, share, strict=True)
            cells = [_cell(*figures) for figures in told]
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
            if noise == 0.005:
                drawn[name] = rms / limit
        lines.append("")
    return "\n".join(lines), drawn


def _cell(ratio: float, bias: float, share: float) -> str:
    if not np.isfinite(ratio):
        return "not published: unphysical or without an interval"
    return f"{ratio:.2f} ({100 * bias:+.2f}; {100 * share:.0f} %)"


def plot(drawn: dict[str, Array], path: Path) -> None:
    """Draw each method's RMS error over the bound."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(9, 4.5), layout="constrained")
    for k, (name, ratio) in enumerate(drawn.items()):
        axes.plot(range(6), ratio, marker="o", label=name, zorder=2 + k)
    axes.axhline(1.0, color="black", linewidth=0.8)
    axes.set_yscale("log")
    axes.set_xticks(range(6), PARAMETERS)
    axes.set_ylabel("RMS error / bound")
    axes.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    figure.savefig(path)


def main() -> None:
    """Run the study and write its page and plot."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--out", type=Path, default=Path("docs/studies"))
    options = parser.parse_args()
    text, drawn = page(options.runs)
    options.out.mkdir(parents=True, exist_ok=True)
    plot(drawn, options.out / "estimators.svg")
    (options.out / "estimators.md").write_text(text + "\n![RMS error over the bound](estimators.svg)\n")
    print(text)


if __name__ == "__main__":
    main()
