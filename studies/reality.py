"""Machines as they are, by Monte Carlo (``python -m studies.reality``): what is believed of them, what it is worth.

Each effect alone, all together, and machines that are drawn at random, each with rapids at two speeds in both
directions; an independent plant (:mod:`studies.real_plant`) moves, reports, and cuts the bench path. The page goes to
``docs/studies/reality.md``.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from fdhil.config import Axis, MachineConfig, parse_config
from fdhil.correction.correction_planner import plan_correction
from fdhil.correction.learned_offsets import LearnedOffset, learn_from_pass
from fdhil.correction.plan_limits import fit_all_axes
from fdhil.identification.drive_loops.loop_identification import apply_loops
from fdhil.identification.rapid_windows import find_windows
from fdhil.model.model_terms import add_resonance
from fdhil.pipeline import analyse_window, pool_windows
from fdhil.pipeline.identified_loops import adopt_loops, reanalyse_with_loops
from fdhil.prediction.contour_error import compute_contour_error_um
from fdhil.prediction.path_prediction import compute_table_deflection_mm
from fdhil.program.program_loading import load_trajectory
from fdhil.records import PARAMETERS, Estimate, LoopEstimate, Parameters, Trajectory, WindowOutcome, compute_rms
from studies import pages
from studies.bench import Array, make_shuttle_demand
from studies.comparison import SURE_95
from studies.pages import wrap_paragraph, write_table
from studies.real_plant import (
    GOOD_LOOPS,
    GOOD_MECHANICS,
    GOOD_SENSORS,
    ORDINARY_LOOPS,
    ORDINARY_MECHANICS,
    ORDINARY_SENSORS,
    RATED_NM,
    SLOW,
    SLOW_LOOPS,
    Loops,
    Mechanics,
    Sensors,
    compute_rest_state,
    draw_machine,
    make_recording,
    simulate_axis,
)

SHARES = (1.0, 0.7)  # of the rapid speed
RAPIDS = 4
RESONANCE_OFF = 0.05  # by which the one that is told is off at most
LEAST_HELD = 0.88  # of 95 % intervals
PASSES = 3  # in which the machine learns


@dataclass(frozen=True, slots=True)
class Machine:
    """One machine of the study, and its configured (``told``) regulators and resonance.

    ``told_resonance_hz`` is 0 where nobody has measured it.
    """

    name: str
    base: str
    mechanics: Mechanics
    loops: Loops
    sensors: Sensors
    told: Loops
    told_resonance_hz: float = 0.0

    def truth(self, direction: int = 0) -> Array:
        """Return the six (6,) as seen by the machine's own current sensor: its gain is in no recording.

        Moves in one ``direction`` alone see a constant load, and the friction of that direction, as dry friction.
        """
        m, gain = self.mechanics, 1.0 + self.sensors.current_gain
        own = direction * (m.asymmetry * m.Cd + m.load_nm)
        true = np.array([m.R, m.L, m.K, m.Jt, m.ft, m.Cd + own])
        return true * np.array([1 / gain, 1 / gain, 1.0, gain, gain, gain])


@dataclass(frozen=True, slots=True)
class Found:
    """The results of one machine: accepted windows, errors of the pool in per cent and in its deviations, the cut."""

    name: str
    base: str
    windows: int
    believed: int
    pooled: bool
    errors: Array
    deviations: Array
    window_errors: Array
    window_deviations: Array
    unexplained_um: float | None
    following_um: float
    before_um: float
    after_um: float
    worse_um: float
    passes_um: tuple[float, ...]
    reasons: dict[str, int]


BASES = {
    "bench": (Mechanics(), Loops(), 0.5, 4.0, 10.0),  # rapid m/s, acceleration m/s2, feed m/min
    "slow": (SLOW, SLOW_LOOPS, 65 * 0.02 / (2 * np.pi), 2.0, 5.0),
}


def list_machines(base: str) -> list[Machine]:
    """Return the machines with one effect each, and with all together."""
    m, g, *_ = BASES[base]
    s = Sensors()
    rated = RATED_NM[base == "bench"]
    scaled = {"motor_ripple_nm": rated * 0.01, "screw_ripple": 0.05}
    rows: list[tuple[str, Mechanics, Loops, Sensors]] = [
        ("none: the model's own plant", m, g, s),
        ("static friction 1.1 Cd below 10 rad/s", replace(m, static=0.1), g, s),
        ("static friction 1.3 Cd below 10 rad/s", replace(m, static=0.3), g, s),
        ("friction builds up by 25 % of Cd over 20 rad/s", replace(m, static=-0.25, static_speed_rad_s=20.0), g, s),
        ("dry friction +-10 % by direction", replace(m, asymmetry=0.1), g, s),
        ("gravity 0.5 Cd", replace(m, load_nm=0.5 * m.Cd), g, s),
        ("gravity 1.0 Cd", replace(m, load_nm=m.Cd), g, s),
        ("friction ripple 10 % once per turn", replace(m, screw_ripple=0.1), g, s),
        ("motor ripple 2 % of rated, order 24", replace(m, motor_ripple_nm=0.02 * rated), g, s),
        ("resonance 150 Hz, motor encoder", replace(m, resonance_hz=150.0), g, s),
        ("resonance 80 Hz, motor encoder", replace(m, resonance_hz=80.0), g, s),
        ("resonance 80 Hz, told", replace(m, resonance_hz=80.0), g, s),
        ("speed: difference of a 20-bit encoder", m, g, replace(s, speed="difference")),
        ("speed: difference of a 13-bit encoder", m, g, replace(s, speed="difference", encoder_bits=13)),
        ("speed: difference, 2 ms filter", m, g, replace(s, speed="difference", filter_s=0.002)),
        ("speed: at mid-interval", m, g, replace(s, speed="middle")),
        ("dead time 2 V, command recorded", m, replace(g, dead_time_v=2.0), replace(s, command=True)),
        ("bus sag 5 %, command recorded", m, replace(g, bus_sag=0.05), replace(s, command=True)),
        ("winding warms by 5 %", replace(m, warming=0.05), g, s),
        ("current sensor +1 %", m, g, replace(s, current_gain=0.01)),
        (
            "a good new machine",
            _scale_effects(GOOD_MECHANICS, m, scaled),
            replace(g, **_scale_inverter(GOOD_LOOPS)),
            GOOD_SENSORS,
        ),
        (
            "an ordinary machine",
            _scale_effects(ORDINARY_MECHANICS, m, scaled),
            replace(g, **_scale_inverter(ORDINARY_LOOPS)),
            ORDINARY_SENSORS,
        ),
    ]
    alone = ("resonance 150 Hz, motor encoder", "resonance 80 Hz, motor encoder")
    made = [
        Machine(name, base, *parts, told=g, told_resonance_hz=0.0 if name in alone else parts[0].resonance_hz)
        for name, *parts in rows
    ]
    drives = {
        "drive: Kv 2 % higher": {"position_gain_per_s": 1.02 * g.position_gain_per_s},
        "drive: speed loop 10 % slower": {"speed_kp": 0.9 * g.speed_kp, "speed_ki": 0.81 * g.speed_ki},
        "drive: 0.25 ms computing delay": {"delay_s": 0.00025},
        "drive: speed filter 0.5 ms": {"speed_filter_s": 0.0005},
        "drive: speed filter 2 ms": {"speed_filter_s": 0.002},
    }
    return made + [Machine(name, base, m, replace(g, **values), s, g) for name, values in drives.items()]


def _scale_effects(real: Mechanics, base: Mechanics, scaled: Mapping[str, float]) -> Mechanics:
    """Return the effects of ``real``, given as shares, on another base."""
    same = {"R": base.R, "L": base.L, "K": base.K, "Jt": base.Jt, "ft": base.ft, "Cd": base.Cd}
    ripple = scaled["motor_ripple_nm"] * real.motor_ripple_nm / 0.4
    return replace(real, **same, load_nm=real.load_nm / 5.0 * base.Cd, motor_ripple_nm=ripple)


def _scale_inverter(loops: Loops) -> dict[str, float]:
    return {"dead_time_v": loops.dead_time_v, "bus_sag": loops.bus_sag}


def draw_machines(count: int, seed: int) -> list[Machine]:
    """Return machines with every effect at a random level, half of them on each base."""
    made = []
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        base = list(BASES)[k % len(BASES)]
        m, g, *_ = BASES[base]
        parts = draw_machine(rng, m)
        told_hz = parts[0].resonance_hz * rng.uniform(1 - RESONANCE_OFF, 1 + RESONANCE_OFF)
        made.append(Machine("drawn at random", base, *parts, told=g, told_resonance_hz=told_hz))
    return made


def make_config(machine: Machine) -> MachineConfig:
    """Return the machine's configuration: the base's nominal values and the configured regulators."""
    m, _, rapid_m_s, acceleration_m_s2, _ = BASES[machine.base]
    gains = ("position_gain_per_s", "speed_feedforward", "speed_kp", "speed_ki", "current_kp", "current_ki")
    reported = {k: v for k, v in asdict(machine.told).items() if k in (*gains, "current_limit_a", "voltage_limit_v")}
    axis = {
        "screw_pitch_mm": m.pitch_m * 1e3,
        "rapid_speed_mm_s": rapid_m_s * 1e3,
        "max_acceleration_mm_s2": acceleration_m_s2 * 1e3,
        "nominal": m.truth(),
        "regulators": reported,
        "correction": {"max_offset_um": 250.0, "max_speed_mm_s": 20.0, "max_acceleration_mm_s2": 2000.0},
    }
    if machine.told_resonance_hz:
        axis |= {"resonance_hz": machine.told_resonance_hz}
    return parse_config({"machine": {"name": "study"}, "axis": {"X": axis, "Y": axis}}, "study", made_up=True)


@lru_cache(maxsize=4)
def make_path(base: str) -> Trajectory:
    """Return the bench path at the base's feed."""
    feed = BASES[base][4]
    program = pages.ROOT / "configs" / "programs" / "bench_10m.ngc"
    text = program.read_text("utf-8").replace("F10000", f"F{1000 * feed:.0f}")
    written = pages.ROOT / "out" / f"bench_{feed:g}m.ngc"
    written.parent.mkdir(exist_ok=True)
    written.write_text(text, "utf-8")
    return load_trajectory(written, make_config(list_machines(base)[0]))


def analyse_machine(machine: Machine, seed: int) -> tuple[list[WindowOutcome], float, LoopEstimate | None]:
    """Return the outcomes of the machine's rapids, the RMS following error in um, and loops other than configured."""
    _, _, rapid_m_s, acceleration_m_s2, _ = BASES[machine.base]
    config = make_config(machine)
    outcomes: list[WindowOutcome] = []
    following = []
    for k, share in enumerate(SHARES):
        demand = make_shuttle_demand(0.4, share * rapid_m_s, acceleration_m_s2, RAPIDS)
        moved = simulate_axis(machine.mechanics, demand, machine.loops)
        reported = make_recording(moved, machine.mechanics, machine.sensors, rapid_m_s, 1000 * seed + k)
        outcomes += [
            analyse_window(w, config.identification, config.axis["X"], config.machine.sync_period_s)
            for w in find_windows(reported)
        ]
        following.append(compute_rms((moved.motor_m - moved.demand) * 1e6))
    settings, axis, period_s = config.identification, config.axis["X"], config.machine.sync_period_s
    windows = [o.window for o in outcomes]

    def again(own: Axis) -> list[WindowOutcome]:
        return [analyse_window(window, settings, own, period_s) for window in windows]

    found, loops = reanalyse_with_loops(outcomes, axis, settings, period_s, again)
    return list(found), float(np.mean(following)), loops if adopt_loops(axis, loops) is not None else None


def simulate_cut(
    machine: Machine, reference: Trajectory, offset_um: Mapping[str, Array] | None = None
) -> tuple[Array, Array]:
    """Return the table's path (n, d) and that of the motors' encoders, in mm."""
    tables, motors = [], []
    step_mm = machine.mechanics.pitch_m * 1e3 / 65536
    for axis in reference.axes:
        wanted = np.asarray(reference.position_mm[axis])
        commanded = wanted if offset_um is None else wanted + offset_um[axis] * 1e-3
        begin = compute_rest_state(machine.mechanics, machine.loops, float(wanted[0]) * 1e-3)
        moved = simulate_axis(machine.mechanics, commanded * 1e-3, machine.loops, start=begin)
        tables.append(moved.table_m * 1e3)
        motors.append(np.round(moved.motor_m * 1e3 / step_mm) * step_mm)
    return np.column_stack(tables), np.column_stack(motors)


def measure_contour_error(
    machine: Machine, model: Parameters, loops: LoopEstimate | None
) -> tuple[float, float, float, tuple[float, ...]]:
    """Return RMS um at the table without and with the correction, the largest degradation, and the passes' residuals.

    In these the machine learns from what its motors' encoders measure.
    """
    reference, config = make_path(machine.base), make_config(machine)
    if loops is not None:
        axes = {name: apply_loops(axis, loops) for name, axis in config.axis.items()}
        config = config.model_copy(update={"axis": axes})
    models = {axis: add_resonance(model, config.axis[axis]) for axis in reference.axes}
    planned = plan_correction(reference, models, config).offset_um

    def error_um(places: Array) -> Array:
        return compute_contour_error_um(reference.path_mm, places, reference.dt_s)

    before = error_um(simulate_cut(machine, reference)[0])
    learned, wanted, passes = LearnedOffset.make_empty(reference), dict(planned), []
    for _ in range(PASSES + 1):
        table, motor = simulate_cut(machine, reference, wanted)
        passes.append(error_um(table))
        ahead = compute_table_deflection_mm(reference.position_mm, wanted, models, config)
        seen = motor + np.column_stack([ahead.get(axis, np.zeros(len(motor))) for axis in reference.axes])
        own = {axis: (reference.position_mm[axis] - seen[:, k]) * 1e3 for k, axis in enumerate(reference.axes)}
        learned = learn_from_pass(learned, own, compute_rms(error_um(seen)), models, config)
        rough = {axis: planned[axis] + learned.offset_um[axis] for axis in reference.axes}
        wanted = fit_all_axes(rough, config.axis, reference.dt_s)
    after = passes[0]
    return (
        compute_rms(before),
        compute_rms(after),
        float((after - before).max()),
        tuple(compute_rms(one) for one in passes[1:]),
    )


def compute_errors(estimate: Estimate | None, truth: Array) -> tuple[Array, Array]:
    """Return errors in per cent of the truth, and in the estimate's deviations, (6,) each."""
    if estimate is None:
        return np.full(6, np.nan), np.full(6, np.nan)
    values = np.array([estimate.get_value(name) for name in PARAMETERS])
    stds = np.array([estimate.get_std(name) for name in PARAMETERS])
    # where a load balances friction, there is none in that direction
    shares = np.divide(values - truth, truth, out=np.full(6, np.nan), where=truth != 0)
    return 100 * shares, (values - truth) / stds


def examine_machine(machine: Machine, seed: int = 0) -> Found:
    """Return the results of one machine."""
    outcomes, following_um, loops = analyse_machine(machine, seed)
    settings = make_config(machine).identification
    estimate, verdict = pool_windows(outcomes, settings)
    reported = [compute_errors(o.estimate, machine.truth(o.window.direction)) for o in outcomes if o.verdict.accepted]
    candidates = [estimate, *(o.estimate for o in outcomes)]  # a refused model is cut with all the same
    usable = [e.build_parameters() for e in candidates if e is not None and _examine_all(e)]
    nothing = (np.nan, np.nan, np.nan, ())
    before_um, after_um, worse_um, passes_um = measure_contour_error(machine, usable[0], loops) if usable else nothing
    left = [o.verdict.unexplained_um for o in outcomes if o.verdict.unexplained_um is not None]
    reasons = Counter(reason.code for o in outcomes for reason in o.verdict.reasons)
    return Found(
        machine.name,
        machine.base,
        len(outcomes),
        sum(o.verdict.accepted for o in outcomes),
        verdict.accepted,
        *compute_errors(estimate, machine.truth()),
        np.array([e for e, _ in reported]).reshape(-1, 6),
        np.array([d for _, d in reported]).reshape(-1, 6),
        float(np.mean(left)) if left else None,
        following_um,
        before_um,
        after_um,
        worse_um,
        passes_um,
        dict(reasons.most_common(3)),
    )


def _examine_all(estimate: Estimate) -> bool:
    values = np.array([estimate.get_value(name) for name in PARAMETERS])
    return bool(np.isfinite(values).all() and (values[:4] > 0).all() and (values[4:] >= 0).all())


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Return the results of every machine."""
    alone = [machine for base in BASES for machine in list_machines(base)]
    several = draw_machines(options.machines, options.seed)
    with ProcessPoolExecutor(options.processes) as executor:
        found = list(executor.map(examine_machine, [*alone, *several], range(len(alone) + len(several))))
    return {"alone": [asdict(f) for f in found[: len(alone)]], "random": [asdict(f) for f in found[len(alone) :]]}


def page(told: pages.Run, figures: Mapping[str, Any]) -> str:
    """Return the study's page."""
    several = figures["random"]
    accepted, windows = (sum(f[key] for f in several) for key in ("believed", "windows"))
    gains = np.array([f["before_um"] / f["after_um"] for f in several if f["after_um"]], dtype=np.float64)
    taught = np.array([f["before_um"] / f["passes_um"][-1] for f in several if f["passes_um"]], dtype=np.float64)
    lines = pages.write_head("Machines as they are", "reality", told)
    lines += wrap_paragraph(
        f"""Of {len(several)} machines with every effect at a random level, {accepted} of {windows} rapids are
        believed, and {sum(f["pooled"] for f in several)} pools. The contour error of the bench path at the table falls
        by {np.median(gains):.1f} times in the median, by {np.percentile(gains, 5):.1f} at the fifth percentile; no
        point gets worse by more than {max((f["worse_um"] or 0.0) for f in several):.2f} um. After {PASSES} passes that
        learned from the motors' encoders it is {np.median(taught):.1f} and {np.percentile(taught, 5):.1f} times."""
    )
    lines += ["## What the intervals hold", ""]
    rows = [
        [name, *(_describe_coverage(several, key, k) for key in ("deviations", "window_deviations"))]
        for k, name in enumerate(PARAMETERS)
    ]
    lines += [*write_table(["", "pools: 95 % intervals that hold the truth", "believed rapids"], rows), ""]
    short = [name for k, name in enumerate(PARAMETERS) if _compute_coverage(several, "deviations", k)[0] < LEAST_HELD]
    if short:
        lines += wrap_paragraph(
            f"""The pools' intervals of {pages.join_words(short)} are too narrow: what bends every rapid alike, a screw
            that gives or friction at low speed that none of them surely shows, does not average away."""
        )
    lines += ["## Each effect alone, and all together", ""]
    names = ["base", "machine", "rapids believed", "pool", "errors of R L K Jt ft Cd, %", "left of following error, um"]
    lines += write_table(
        [*names, "contour RMS, um", "gain", "worst, um", "learned, um", "reasons"],
        [_format_row(f) for f in figures["alone"]],
    )
    return "\n".join(lines)


def _describe_coverage(found: Sequence[Mapping[str, Any]], key: str, k: int) -> str:
    share, count = _compute_coverage(found, key, k)
    return f"{100 * share:.0f} % of {count}" if count else "-"


def _compute_coverage(found: Sequence[Mapping[str, Any]], key: str, k: int) -> tuple[float, int]:
    """Return the share of a parameter's 95 % intervals that cover the truth, and their number."""
    values = np.array(
        [row[k] for f in found for row in ([f[key]] if key == "deviations" else f[key]) if row[k] is not None]
    )
    return (float(np.mean(np.abs(values) < SURE_95)) if values.size else 0.0), int(values.size)


def _format_row(f: Mapping[str, Any]) -> list[str]:
    errors = " ".join("-" if e is None else f"{e:+.1f}" for e in f["errors"])
    left = "-" if f["unexplained_um"] is None else f"{f['unexplained_um']:.2f} of {f['following_um']:.0f}"
    reasons = ", ".join(f"{count} {code}" for code, count in f["reasons"].items())
    cut_um = "-" if f["before_um"] is None else f"{f['before_um']:.1f} -> {f['after_um']:.1f}"
    gain = "-" if not f["after_um"] else f"{f['before_um'] / f['after_um']:.1f}"
    worst = "-" if f["worse_um"] is None else f"{f['worse_um']:.1f}"
    learned = f"{f['passes_um'][-1]:.2f}" if f["passes_um"] else "-"
    accepted = f"{f['believed']}/{f['windows']}"
    return [
        f["base"],
        f["name"],
        accepted,
        "yes" if f["pooled"] else "no",
        errors,
        left,
        cut_um,
        gain,
        worst,
        learned,
        reasons,
    ]


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--machines", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    pages.run_study("reality", parser, lambda o: f"{o.seed}", measure)


if __name__ == "__main__":
    main()
