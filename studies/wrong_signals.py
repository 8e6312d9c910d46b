"""Puts wrong signals into good rapids, alone and two at once (``python -m studies.wrong_signals``), and counts.

Each signal of three plants is dead, stuck, held, scaled, swapped, copied, of another move, or shifted by samples. Such
a recording must be refused by the name of the signal, or do no harm. The page: ``docs/studies/wrong_signals.md``.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import combinations
from typing import Any

import numpy as np

from fdhil.config import Axis, Identification
from fdhil.identification.rapid_windows import find_windows
from fdhil.model import closed_loop
from fdhil.pipeline import analyse_window, pool_windows
from fdhil.records import PARAMETERS, Estimate, Parameters, Recording, Window, compute_rms, freeze_array
from fdhil.validation.data_sheet import detect_gain_error
from fdhil.validation.signal_consistency import explain_missing_move
from studies import pages
from studies.bench import Array, make_shuttle_demand
from studies.judging import assess_seeds
from studies.pages import wrap_paragraph, write_table
from studies.real_plant import SLOW, SLOW_LOOPS, Loops, Mechanics, Run, Sensors, make_recording, simulate_axis
from studies.reality import Machine, make_config

FIELDS: Mapping[str, str] = {
    "voltage": "voltage_v",
    "current": "current_a",
    "speed": "speed_rad_s",
    "position": "position_mm",
    "demand": "demand_mm",
}
GAINS = ("voltage", "current")  # whose scale no recording tells: only a data sheet does
NAMED, OTHER, HARMLESS, SILENT, UNKNOWN = (
    "named",
    "refused otherwise",
    "harmless",
    "WRONG IN SILENCE",
    "scale unknown",
)
RESULTS = (NAMED, OTHER, HARMLESS, UNKNOWN, SILENT)
SURE, SHARE = 4.0, 0.03  # deviations, and share of a parameter, beyond which it is wrong
LEAST_UM = 0.5  # of an error at the table, that matters
RAPID_SHARES = (1.0, 0.3)
SCALES: Mapping[str, float] = {
    "2 times": 2.0, "half": 0.5, "10 times": 10.0, "a tenth": 0.1, "reversed": -1.0, "1000 times": 1e3,
    "a thousandth": 1e-3, "sqrt 2 times": 2**0.5, "over sqrt 2": 0.5**0.5, "1/min for rad/s": 30 / np.pi,
    "rad/s for 1/min": np.pi / 30, "degrees for rad": 180 / np.pi, "rad for degrees": np.pi / 180,
}  # fmt: skip
SHIFTS = (-50, -10, -4, -2, -1, 1, 2, 4, 10, 50)
HELD = (2, 5, 20, 100)
SCREW_TORQUE = 0.01 / (2 * np.pi)
# a ball screw in a P-P cascade without feed-forward, with a load and friction that builds up
SCREW = Mechanics(
    R=0.5, L=0.002, K=0.3, Jt=95.1 * SCREW_TORQUE**2, ft=203.5 * SCREW_TORQUE**2, Cd=20.4 * SCREW_TORQUE,
    pitch_m=0.01, static=-0.2, static_speed_rad_s=12.0, load_nm=-3.2 * SCREW_TORQUE, screw_ripple=0.02,
)  # fmt: skip
SCREW_LOOPS = Loops(
    position_gain_per_s=160.0, speed_feedforward=0.0, speed_kp=2 * np.pi * 25 * SCREW.Jt / SCREW.K, speed_ki=0.0,
    current_kp=2 * np.pi * 400 * SCREW.L, current_ki=2 * np.pi * 400 * SCREW.R,
)  # fmt: skip


@dataclass(frozen=True)
class Plant:
    """A machine with two moves of its axis: the rapid that is recorded, and another whose signals may be mixed in."""

    machine: Machine
    axis: Axis
    rapid_m_s: float
    move: Run
    other: Run

    def make_recording(self, *, voltage: bool = True) -> Recording:
        """Return the rapid as recorded."""
        return self._record_move(self.move, 1, voltage=voltage)

    def _record_move(self, moved: Run, seed: int, *, voltage: bool = True) -> Recording:
        m = self.machine.mechanics
        reported = make_recording(moved, m, self.machine.sensors, self.rapid_m_s, seed, voltage=voltage)
        return reported if voltage else replace(reported, torque_constant_nm_per_a=m.K)

    def read_other_move(self, name: str) -> Array:
        """Return a signal of the other move, as long as the first."""
        values, n = np.array(getattr(self._record_move(self.other, 2), FIELDS[name])), self.move.speed.size
        return np.pad(values, (0, max(0, n - values.size)), mode="edge")[:n]


def _make_plant(name: str, parts: tuple[Mechanics, Loops, Sensors], rapid: tuple[float, float], first: int) -> Plant:
    (m, g, s), (speed, acceleration) = parts, rapid
    machine = Machine(name, "bench", m, g, s, g)
    bench = make_config(machine).axis["X"]
    own = {
        "screw_pitch_mm": 1e3 * m.pitch_m,
        "rapid_speed_mm_s": 1e3 * speed,
        "nominal": type(bench.nominal)(**m.truth()),
    }
    distances = (0.8, 0.5) if speed > 0.3 else (1.6 * speed, speed)
    moves = (
        simulate_axis(m, make_shuttle_demand(distances[0] / 2, speed, acceleration, first=first), g),
        simulate_axis(
            m, make_shuttle_demand(distances[1] / 2, 0.6 * speed, 0.5 * acceleration, lead=0.12, first=first), g
        ),
    )
    return Plant(machine, bench.model_copy(update=own), speed, *moves)


PLANTS: Mapping[str, Callable[[], Plant]] = {
    "bench": cache(partial(_make_plant, "bench", (Mechanics(), Loops(), Sensors()), (0.5, 4.0), 1)),
    "slow": cache(partial(_make_plant, "slow", (SLOW, SLOW_LOOPS, Sensors()), (0.207, 2.0), -1)),
    "screw": cache(
        partial(
            _make_plant, "screw", (SCREW, SCREW_LOOPS, Sensors(1e-4, speed="middle", encoder_bits=20)), (0.15, 1.0), 1
        )
    ),
}


@dataclass(frozen=True)
class Fault:
    """A fault of ``signals``, and their ``values`` (n,) by name."""

    signals: tuple[str, ...]
    way: str
    values: Mapping[str, Array]

    def __and__(self, other: Fault) -> Fault:
        """Return both faults at once; if they concern one signal, the other's."""
        names = tuple(dict.fromkeys((*self.signals, *other.signals)))
        return Fault(names, f"{self.way} + {other.way}", {**self.values, **other.values})

    @property
    def is_gain(self) -> bool:
        """Whether the scale of voltage or current is wrong, which only a data sheet reveals."""
        return any(way in SCALES for way in self.way.split(" + ")) and any(name in GAINS for name in self.signals)


def list_faults(plant: Plant) -> list[Fault]:
    """Return every fault of one signal, and of two that are confused."""
    recorded = plant.make_recording()
    signals = {name: np.array(getattr(recorded, field)) for name, field in FIELDS.items()}
    (window,) = find_windows(recorded)
    faults = [
        Fault((name,), way, {name: changed})
        for name, values in signals.items()
        for way, changed in _change_signal(values, window, plant.read_other_move(name))
    ]
    for one, other in combinations(signals, 2):
        faults.append(Fault((one, other), "swapped", {one: signals[other], other: signals[one]}))
        faults += [Fault((one, other), f"{a} copied to {b}", {b: signals[a]}) for a, b in ((one, other), (other, one))]
    return faults


def _change_signal(values: Array, window: Window, other: Array) -> Iterator[tuple[str, Array]]:
    rng, n = np.random.default_rng(5), values.size
    begin, end = (window.start_tick + row for row in _find_motion(window))
    middle, row = (begin + end) // 2, np.arange(n)
    noise = float(np.std(values[: begin // 2])) or 1e-3 * float(np.ptp(values))
    yield "constant", np.full(n, values[middle])
    yield "constant, as at rest", np.full(n, values[0])
    yield "zero", np.zeros(n)
    yield "noise alone", noise * rng.standard_normal(n)
    for way, a, b in (
        ("stuck for 60 ms at speed", middle, middle + 60),
        ("stuck for 60 ms as it accelerates", begin + 30, begin + 90),
        ("stuck from the middle on", middle, n),
        ("stuck as it brakes", end - (end - begin) // 4, end),
        ("stuck until the middle", 0, middle),
    ):
        yield way, np.where((row >= a) & (row < b), values[a], values)
    for rows in HELD:
        yield f"held for {rows} samples", values[row // rows * rows]
    for way, factor in SCALES.items():
        yield way, factor * values
    yield "of another move", other
    for shift in SHIFTS:
        yield f"{abs(shift)} samples {'late' if shift > 0 else 'early'}", values[np.clip(row - shift, 0, n - 1)]


def _find_motion(window: Window) -> tuple[int, int]:
    stages = window.stages
    assert stages.accelerate is not None
    assert stages.brake is not None
    return stages.accelerate[0], stages.brake[1]


def apply_fault(recorded: Recording, fault: Fault) -> Recording:
    """Return the recording with the fault; a voltage that was not recorded stays out."""
    names = [name for name in fault.values if getattr(recorded, FIELDS[name]) is not None]
    changed: Recording = replace(recorded, **{FIELDS[n]: freeze_array(np.array(fault.values[n])) for n in names})  # type: ignore[arg-type]
    return changed


@dataclass(frozen=True)
class Judged:
    """The result of a faulty recording: one of ``RESULTS``, and why."""

    result: str
    text: str


def assess_fault(plant: Plant, recorded: Recording, fault: Fault, *, configured: bool) -> Judged:
    """Return the result of the recording with a fault, with the machine's section or without.

    No loops of the drive's own are sought: where the configured ones do not explain the rapid, it is refused.
    """
    axis = plant.axis if configured else None
    corrupted = apply_fault(recorded, fault)
    period_s = 1e-3 if configured else None
    outcomes = [analyse_window(window, Identification(), axis, period_s) for window in find_windows(corrupted)]
    estimate, verdict = pool_windows(outcomes, Identification())
    reasons = list(verdict.reasons)
    hidden = None if outcomes else explain_missing_move(corrupted)
    reasons += [] if hidden is None else [hidden]
    nominal = Parameters(**plant.axis.nominal.model_dump())
    if configured and estimate is not None and (gain := detect_gain_error(estimate, nominal)) is not None:
        reasons.append(gain)
    if reasons or estimate is None:
        text = "; ".join(f"{reason.text}; {reason.advice}" for reason in reasons)
        return Judged(NAMED if any(name in text for name in fault.signals) else OTHER, text)
    warned = any(outcome.verdict.warnings for outcome in outcomes)
    wrong = [
        *_find_interval_violations(estimate, plant, outcomes[0].window.direction),
        *_measure_path_deviation(estimate, plant),
    ]
    if not wrong or (warned and all(text.startswith("L ") for text in wrong)):
        return Judged(HARMLESS, ", ".join(wrong))
    return Judged(UNKNOWN if fault.is_gain and not configured else SILENT, ", ".join(wrong))


def _find_interval_violations(estimate: Estimate, plant: Plant, direction: int) -> Iterator[str]:
    for name, true in zip(PARAMETERS, plant.machine.truth(direction), strict=True):
        value, std = estimate.get_value(name), estimate.get_std(name)
        if name not in estimate.given and abs(value - true) > max(SURE * std, SHARE * abs(true)):
            yield f"{name} {value / true:.3g} times what it is"


def _measure_path_deviation(estimate: Estimate, plant: Plant) -> Iterator[str]:
    """Yield the deviation of the table from the prediction, beyond that of the valid recording's model."""
    for share in RAPID_SHARES:
        demand_mm = 1e3 * make_shuttle_demand(0.2, share * plant.rapid_m_s, 1.0, 2)
        true = simulate_axis(plant.machine.mechanics, 1e-3 * demand_mm, plant.machine.loops).motor_m * 1e3
        errors = [
            1e3 * compute_rms(true - _predict_path(e, plant, demand_mm))
            for e in (estimate, _identify_good(plant.machine.name))
        ]
        limit = max(LEAST_UM, Identification().compute_tolerance_um(1e3 * compute_rms(true - demand_mm)))
        if errors[0] > errors[1] + limit:
            yield f"{errors[0]:.3g} um beside the path"


def _predict_path(estimate: Estimate, plant: Plant, demand_mm: Array) -> Array:
    values = estimate.build_parameters().as_dict()
    winding = {name: getattr(plant.axis.nominal, name) for name in ("R", "L") if not np.isfinite(values[name])}
    return closed_loop.simulate_axis(
        estimate.build_parameters().replace_values(**winding), plant.axis, 1e-3, demand_mm
    ).position_mm


@cache
def _identify_good(name: str) -> Estimate:
    outcomes = [analyse_window(window, Identification()) for window in find_windows(PLANTS[name]().make_recording())]
    estimate, verdict = pool_windows(outcomes, Identification())
    if estimate is None or not verdict.accepted:
        raise ValueError(f"the good recording of {name} is refused: {verdict.reasons}")
    return estimate


def _draw_faults(name: str, voltage: bool, pairs: int, seed: int) -> Iterator[Fault]:
    """Yield each fault alone, then ``pairs`` of two that concern different signals."""
    faults = [f for f in list_faults(PLANTS[name]()) if voltage or "voltage" not in f.values]
    yield from faults
    rng = np.random.default_rng([seed, voltage, *name.encode()])
    while pairs:
        one, other = (faults[k] for k in rng.choice(len(faults), 2, replace=False))
        if not set(one.signals) & set(other.signals):
            pairs -= 1
            yield one & other


Case = tuple[str, bool, bool]
Counts = tuple[Case, dict[str, dict[str, int]], list[str]]


def count_results(number: int, cases: Sequence[Case], pairs: int, seed: int) -> Counts:
    """Return how often each result occurred for single and double faults, and the undetected ones."""
    name, voltage, configured = case = cases[number]
    plant = PLANTS[name]()
    counts: dict[str, Counter[str]] = {"alone": Counter(), "two at once": Counter()}
    wrong = []
    for fault in _draw_faults(name, voltage, pairs, seed):
        found = assess_fault(plant, plant.make_recording(voltage=voltage), fault, configured=configured)
        counts["two at once" if " + " in fault.way else "alone"][found.result] += 1
        if found.result in (SILENT, OTHER):
            wrong.append(f"{found.result}: {' and '.join(fault.signals)}, {fault.way}: {found.text[:160]}")
    return case, {key: dict(of) for key, of in counts.items()}, wrong


def measure_plants(options: argparse.Namespace) -> dict[str, Any]:
    """Return the counts of every plant, with and without voltage, with and without the machine's section."""
    cases = [
        (name, voltage, configured) for name in PLANTS for voltage in (True, False) for configured in (False, True)
    ]
    work = partial(count_results, cases=cases, pairs=options.pairs, seed=options.seed)
    rows = []
    for (name, voltage, configured), counts, wrong in assess_seeds(range(len(cases)), work, options.processes):
        print(name, voltage, configured, counts, *wrong, sep="\n  ", flush=True)
        rows.append(
            {"plant": name, "voltage": voltage, "configured": configured, "counts": counts, "wrong": list(wrong)}
        )
    return {"rows": rows}


def page(told: pages.Run, figures: Mapping[str, Any]) -> str:
    """Return the study's page."""
    rows = figures["rows"]
    total = {key: sum(_sum_counts(row["counts"].values(), key) for row in rows) for key in RESULTS}
    lines = pages.write_head("Dead, swapped and scaled signals", "wrong_signals", told)
    lines += wrap_paragraph(
        """One rapid of each of three simulated plants: the bench, a slow axis that friction rules, and a ball screw in
        a P-P cascade without feed-forward. Each signal (voltage, current, speed, position, demand) is dead (constant,
        zero, noise alone), stuck for a part, held for some samples, scaled, of another move or shifted by samples; each
        two are swapped, or one is copied to the other; and two such faults at once are drawn at random."""
    )
    lines += wrap_paragraph(
        f"""Of {sum(total.values())} recordings {total[NAMED]} are refused by the name of a signal at fault,
        {total[OTHER]} otherwise, {total[HARMLESS]} are accepted and harmless, and {total[SILENT]} are wrong in silence.
        Harmless: each parameter within {SURE:g} deviations or {SHARE:.0%} of the truth, and the predicted path no
        farther from the true one than the tolerance of a good model. An inductance beyond that, with a warning and
        without effect on the path, counts as harmless. With a configuration the rapid is replayed through its
        regulators; no other loops are sought."""
    )
    lines += wrap_paragraph(
        f"""{total[UNKNOWN]} more are accepted with a wrong scale of voltage or current, all of them without a
        configuration: with another unit of voltage or current the equations hold again, with other parameters. Only
        the nominal values of a configuration tell them, and with these each is refused by its name."""
    )
    names = ["plant", "voltage", "configuration", "faults", *RESULTS]
    lines += [*write_table(names, list(_build_table(rows))), ""]
    wrong = [f"{row['plant']}: {text}" for row in rows for text in row["wrong"]]
    lines += ["## Refused otherwise, or wrong in silence", "", *(f"- {text}" for text in wrong or ["none"]), ""]
    return "\n".join(lines)


def _sum_counts(counts: Iterable[Mapping[str, int]], key: str) -> int:
    return sum(of.get(key, 0) for of in counts)


def _build_table(rows: Sequence[Mapping[str, Any]]) -> Iterator[list[str]]:
    for row in rows:
        for kind, counts in row["counts"].items():
            has = ["yes" if row[key] else "no" for key in ("voltage", "configured")]
            yield [row["plant"], *has, kind, *(str(counts.get(key, 0)) for key in RESULTS)]


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=60, help="draws of two faults at once, for each row of the table")
    parser.add_argument("--seed", type=int, default=1)
    pages.run_study("wrong_signals", parser, lambda o: f"{o.seed}", measure_plants)


if __name__ == "__main__":
    main()
