"""Recordings of real axes that are public, and what is made of them (``python -m studies.real FOLDER``).

FOLDER holds ``mitsubishi_mr_j.csv`` (github.com/KonradMnich/friction-identification, input/a3MR.csv: a servo axis on a
ball screw as its vendor's scope program writes it) and ``hsm150_step.csv`` (github.com/malik-robert/HSM150-data: two
coupled motors on a test bench). Neither has a voltage or a demand. The page goes to ``docs/studies/real.md``.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fdhil.config import Identification
from fdhil.identification.rapid_windows import find_windows
from fdhil.pipeline import analyse_window
from fdhil.records import PARAMETERS, Recording, WindowOutcome, freeze_array, get_unit
from studies import pages
from studies.bench import Array
from studies.pages import wrap_paragraph, write_table

RATED_TORQUE_NM = 2.4  # assumed, of a 750 W motor: the recording does not say it
PITCH_MM = 20.0
SHOWN = 2  # every so many rows of a plot
RECORDINGS = ("mitsubishi_mr_j.csv", "hsm150_step.csv")


def read_scope_file(path: Path) -> Recording:
    """Return the scope's file: speed in rev/min, torque in per cent of the rated one, taken as a current of 1 N.m/A."""
    rows = np.genfromtxt(path, delimiter=",", skip_header=5, usecols=(0, 1, 2))
    dt_s = float(np.median(np.diff(rows[:, 0]))) * 1e-3
    return make_recording("Mitsubishi MR-J", dt_s, rows[:, 1] * 2 * np.pi / 60, rows[:, 2] / 100 * RATED_TORQUE_NM)


def read_bench_steps(path: Path) -> Recording:
    """Return the test bench's file: speed in rad/s, current in A."""
    rows = np.genfromtxt(path, delimiter=",", skip_header=1)
    return make_recording("HSM150", float(np.median(np.diff(rows[:, 0]))), rows[:, 1], rows[:, 2])


def make_recording(axis: str, dt_s: float, speed_rad_s: Array, current_a: Array) -> Recording:
    """Return a recording of speed and current alone; the position is the speed's integral."""
    steps = (speed_rad_s[1:] + speed_rad_s[:-1]) / 2 * dt_s
    position = freeze_array(np.concatenate([[0.0], np.cumsum(steps)]) * PITCH_MM / (2 * np.pi))
    return Recording(
        axis=axis,
        dt_s=dt_s,
        time_s=freeze_array(np.arange(speed_rad_s.size) * dt_s),
        voltage_v=None,
        current_a=freeze_array(current_a),
        speed_rad_s=freeze_array(speed_rad_s),
        position_mm=position,
        demand_mm=position,
        voltage_sampling="interval_mean",
        pitch_mm=PITCH_MM,
        rapid_speed_rad_s=None,
        torque_constant_nm_per_a=1.0,
    )


def compute_figures(recording: Recording) -> dict[str, Any]:
    """Return the results of one recording, with the course of its torque and of the model's."""
    outcomes = [analyse_window(window, Identification()) for window in find_windows(recording)]
    return {
        "axis": recording.axis,
        "rate_hz": 1 / recording.dt_s,
        "seconds": recording.time_s.size * recording.dt_s,
        "top_rad_s": float(np.abs(recording.speed_rad_s).max()),
        "windows": [_select_window(outcome) for outcome in outcomes],
    }


def _select_window(outcome: WindowOutcome) -> dict[str, Any]:
    window, estimate, verdict = outcome.window, outcome.estimate, outcome.verdict
    names = () if estimate is None else (*PARAMETERS, *estimate.terms)
    values = {n: (estimate.get_value(n), estimate.get_std(n), get_unit(n)) for n in names if estimate is not None}
    return {
        "start_s": window.start_s,
        "direction": window.direction,
        "values": {n: told for n, told in values.items() if np.isfinite(told[0])},
        "believed": verdict.accepted,
        "reasons": [str(reason) for reason in verdict.reasons],
        "warnings": [str(reason) for reason in verdict.warnings],
        "course": _compute_torque(outcome),
    }


def _compute_torque(outcome: WindowOutcome) -> dict[str, Array]:
    """Return time s, speed rad/s, and torque measured and by the model, N.m, for a plot."""
    window, estimate = outcome.window, outcome.estimate
    if estimate is None or not np.isfinite(estimate.get_value("Jt")):
        return {}
    p, w = estimate.build_parameters(), np.asarray(window.speed_rad_s)
    smooth = np.convolve(np.pad(w, 5, mode="edge"), np.ones(11) / 11, mode="valid")
    slow = p.get_term("stribeck") * np.exp(-((w / p.get_term("stribeck_speed", 1.0)) ** 2))
    model = p.Jt * np.gradient(smooth, window.dt_s) + p.ft * w + np.sign(w) * (p.Cd + slow) + p.get_term("load")
    rows = slice(None, None, SHOWN)
    time = np.arange(w.size) * window.dt_s
    measured = np.asarray(window.current_a) * (p.K if np.isfinite(p.K) else 1.0)
    return {"time_s": time[rows], "speed": w[rows], "measured": measured[rows], "model": model[rows]}


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Return the results of each recording."""
    read = dict(zip(RECORDINGS, (read_scope_file, read_bench_steps), strict=True))
    return {name: compute_figures(read[name](options.folder / name)) for name in RECORDINGS}


def page(run: pages.Run, figures: Mapping[str, Any]) -> str:
    """Return the study's page."""
    lines = pages.write_head("Recordings of real axes", "real", run)
    for name, found in figures.items():
        count = len(found["windows"])
        lines += [f"## {found['axis']}", ""]
        lines += wrap_paragraph(
            f"""`{name}`: {found["seconds"]:.2f} s at {found["rate_hz"]:.0f} Hz, up to {found["top_rad_s"]:.0f} rad/s,
            speed and {"torque" if "mitsubishi" in name else "current"} alone. {
                "It holds no rapid, and nothing is said of its drive."
                if not count
                else f"{count} move{'s' if count > 1 else ''} found."
            }"""
        )
        for window in found["windows"]:
            rows = [[n, f"{v:.4g}", f"{1.96 * s:.2g}", unit] for n, (v, s, unit) in window["values"].items()]
            if rows:
                lines += [*write_table(["", "value", "95 % within", "unit"], rows), ""]
            message = [*window["reasons"], *(f"(warning) {text}" for text in window["warnings"])]
            lines += wrap_paragraph(("Believed. " if window["believed"] else "Not believed. ") + "; ".join(message))
    lines += wrap_paragraph(
        f"""The scope does not say the rated torque; {RATED_TORQUE_NM} N.m of a 750 W motor is assumed, so that inertia
        and friction stand in proportion to it."""
    )
    lines += ["![Torque, measured and by the model](real.svg)"]
    return "\n".join(lines)


def draw(figures: Mapping[str, Any], path: Path) -> None:
    """Draw torque and speed of each move."""
    import matplotlib.pyplot as plt
    from matplotlib import rc_context

    moves = [(f["axis"], w["course"]) for f in figures.values() for w in f["windows"] if w["course"]]
    with rc_context({"svg.hashsalt": "fdhil"}):
        figure, places = plt.subplots(max(1, len(moves)), 1, figsize=(8, 3.2 * max(1, len(moves))), squeeze=False)
        for place, (axis, course) in zip(places[:, 0], moves, strict=False):
            place.plot(course["time_s"], course["measured"], color="0.6", linewidth=0.8, label="measured")
            place.plot(course["time_s"], course["model"], color="tab:blue", linewidth=1.2, label="model")
            place.set(title=axis, xlabel="time, s", ylabel="torque, N.m")
            place.legend(loc="best")
            place.grid(alpha=0.3)
        figure.tight_layout()
        figure.savefig(path, metadata={"Date": None})
        plt.close(figure)


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    pages.run_study("real", parser, lambda _: "none", measure)


if __name__ == "__main__":
    main()
