"""A voltage sensor slower than the drive (``python -m studies.slow_sensor``): intervals, refusals, and their figures.

The first table tells how well the six parameters and the delay are known from one rapid of the bench, and how often
their 95 % intervals hold the truth. The second tells what becomes of good and bad recordings of random drives whose
voltage comes from such a sensor, on a grid and with a delay of its own. Both go to ``docs/studies/slow_sensor.md``.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from fdhil.config import Identification
from fdhil.identification.estimators import maximum_likelihood
from fdhil.identification.windows import find_windows
from fdhil.records import PARAMETERS, Recording, SlowVoltage, VoltageSampling, Window, frozen
from fdhil.store.recording_csv import parse_recording
from fdhil.validation import analyse
from studies import bench, drives, machine_faults, signal_faults
from studies.drives import Array, Rng, log_uniform
from studies.scenes import Rows, Scene, demand_of, draw_scene, measured, recorded

SETTINGS = Identification()
TRUTH = np.array([bench.Plant().truth()[name] for name in PARAMETERS])
PERIODS_S = (0.010, 0.005, 0.002)
NOISES = (0.001, 0.005)
SAMPLINGS: tuple[VoltageSampling, ...] = ("interval_mean", "instant")
GOOD = "good"
Maker = Callable[[Rng], tuple[Recording, float]]
Made = TypeVar("Made")


def sampled(
    fine: Array, step_s: float, begin_s: npt.NDArray[np.floating], period_s: float, sampling: VoltageSampling
) -> Array:
    """Return what a sensor tells of a voltage held over steps of ``step_s``, of samples that begin at ``begin_s``."""
    if sampling == "instant":
        return np.asarray(fine[np.clip((begin_s / step_s + 1e-6).astype(int), 0, fine.size - 1)])
    swept = np.concatenate([[0.0], np.cumsum(fine)]) * step_s
    grid = np.arange(swept.size) * step_s
    return np.asarray((np.interp(begin_s + period_s, grid, swept) - np.interp(begin_s, grid, swept)) / period_s)


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
                made = list(_all(partial(one_fit, case), seeds, processes))
                errors, stds = np.array([m[0] for m in made]), np.array([m[1] for m in made])
                share = np.nanmean(np.where(np.isfinite(errors), np.abs(errors) <= 1.96 * stds, np.nan), axis=0)
                rms = np.sqrt(np.nanmean(errors**2, axis=0)) / np.append(TRUTH / 100, 1e-6)
                cells = [f"{r:.3g} ({100 * s:.0f} %)" for r, s in zip(rms, share, strict=True)]
                head = f"| {sampling.replace('_', ' ')}s | {1 / period:g} Hz | {100 * noise:g} % | "
                tail = f" | {int(np.isnan(errors).sum())} | {1e3 * np.median([m[2] for m in made]):.0f} ms |"
                lines.append(head + " | ".join(cells) + tail)
                print(lines[-1], flush=True)
    return "\n".join(lines)


def _all(one: Callable[[int], Made], seeds: range, processes: int) -> Iterator[Made]:
    if processes < 2:
        yield from map(one, seeds)
        return
    with ProcessPoolExecutor(processes) as executor:
        yield from executor.map(one, seeds, chunksize=8)


@dataclass(frozen=True, slots=True)
class Sensed:
    """What a recording is made of: the rows, and a sensor's samples with the place it gives them and where they are."""

    rows: Rows
    voltage: Array
    begin_s: float
    period_s: float

    def spoilt(self, voltage: Array) -> Sensed:
        """Return it with other samples."""
        return replace(self, voltage=voltage)

    @property
    def moving(self) -> tuple[int, int]:
        """Half-open samples of the true move."""
        a, b = (int(row * self.rows.dt_s / self.period_s) for row in self.rows.moving)
        return a, min(b, self.voltage.size)


def sense(rng: Rng, scene: Scene, load: Array | None = None, late: float | None = None) -> Sensed:
    """Return a run of a scene by a sensor of 100 to 500 Hz; ``late`` in its samples, drawn when left out."""
    demand = demand_of(scene)
    rows = measured(rng, scene, drives.run(scene.drive, demand, scene.dt_s, load))
    fine = drives.run(scene.drive, demand, drives.STEP_S, load).voltage
    period = float(rng.choice(PERIODS_S))
    delay = (rng.uniform(-0.5, 0.5) if late is None else late) * period
    begin = rng.uniform(0.0, period)
    count = int((rows.signals["speed"].size * rows.dt_s - begin) / period)
    told = sampled(fine, drives.STEP_S, begin - delay + np.arange(count) * period, period, scene.sampling)
    peak = float(np.abs(told).max())
    told = told + scene.noise * 0.4 * peak * rng.standard_normal(count)
    return Sensed(rows, np.round(told / (scene.steps[0] * peak)) * scene.steps[0] * peak, begin, period)


def scene_of(rng: Rng) -> Scene:
    """Draw a drive, a rapid and a recorder whose rows are closer than the sensor's samples."""
    scene = draw_scene(rng)
    return replace(scene, dt_s=min(scene.dt_s, 1e-3))


def told(scene: Scene, sensed: Sensed) -> Recording:
    """Return the recording."""
    slow = SlowVoltage(sensed.begin_s, sensed.period_s, 2e-4, frozen(sensed.voltage))
    return replace(recorded(scene, sensed.rows), slow_voltage=slow)


def _of_voltage(spoil: Callable[[Rng, Sensed], tuple[Sensed, float]]) -> Maker:
    def make(rng: Rng) -> tuple[Recording, float]:
        scene = scene_of(rng)
        spoilt, severity = spoil(rng, sense(rng, scene))
        return told(scene, spoilt), severity

    return make


def _of_rows(fault: signal_faults.SignalFault) -> Maker:
    """Spoil current or speed as the other studies do."""

    def make(rng: Rng) -> tuple[Recording, float]:
        scene = scene_of(rng)
        sensed = sense(rng, scene)
        while True:
            rows, severity = fault(rng, sensed.rows)
            if rows.signals["voltage"] is sensed.rows.signals["voltage"]:
                return told(scene, replace(sensed, rows=rows)), severity

    return make


def _of_machine(change: Callable[[Rng, Scene], tuple[Scene, Array | None, float]]) -> Maker:
    def make(rng: Rng) -> tuple[Recording, float]:
        scene, load, severity = change(rng, scene_of(rng))
        return told(scene, sense(rng, scene, load)), severity

    return make


def _voltage_gain_step(rng: Rng, sensed: Sensed) -> tuple[Sensed, float]:
    amount, (begin, end) = log_uniform(rng, 0.03, 0.2), sensed.moving
    values = sensed.voltage.copy()
    values[int(begin + rng.uniform(0.2, 0.8) * (end - begin)) :] *= 1 + signal_faults.sign(rng) * amount
    return sensed.spoilt(values), amount


def _voltage_gain_drift(rng: Rng, sensed: Sensed) -> tuple[Sensed, float]:
    amount, (begin, end) = log_uniform(rng, 0.04, 0.2), sensed.moving
    course = np.clip((np.arange(sensed.voltage.size) - begin) / (end - begin), 0, 1)
    return sensed.spoilt(sensed.voltage * (1 + signal_faults.sign(rng) * amount * course)), amount


def _voltage_offset(rng: Rng, sensed: Sensed) -> tuple[Sensed, float]:
    amount = log_uniform(rng, 0.015, 0.08)
    peak = float(np.abs(sensed.voltage).max())
    return sensed.spoilt(sensed.voltage + signal_faults.sign(rng) * amount * peak), amount


def _voltage_stuck(rng: Rng, sensed: Sensed) -> tuple[Sensed, float]:
    begin, end = sensed.moving
    length = max(4, round(rng.uniform(0.04, 0.1) / sensed.period_s))
    start = int(rng.uniform(begin, end - length))
    values = sensed.voltage.copy()
    values[start : start + length] = values[start]
    return sensed.spoilt(values), length * sensed.period_s


def _voltage_clipped(rng: Rng, sensed: Sensed) -> tuple[Sensed, float]:
    cut = rng.uniform(0.1, 0.5)
    rail = (1 - cut) * float(np.abs(sensed.voltage).max())
    return sensed.spoilt(np.clip(sensed.voltage, -rail, rail)), cut


def _voltage_turned(_rng: Rng, sensed: Sensed) -> tuple[Sensed, float]:
    return sensed.spoilt(-sensed.voltage), 1.0


def _voltage_late(rng: Rng) -> tuple[Recording, float]:
    scene = scene_of(rng)
    late = signal_faults.sign(rng) * rng.uniform(1.3, 4.0)
    return told(scene, sense(rng, scene, late=late)), abs(late)


def _fine(rng: Rng) -> tuple[Recording, float]:
    scene = scene_of(rng)
    return told(scene, sense(rng, scene)), 0.0


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of recording: how one is made, the codes that name its fault rightly, the severity's unit."""

    make: Maker
    named: frozenset[str]
    unit: str


def _kind(make: Maker, named: str, unit: str) -> Kind:
    return Kind(make, frozenset(named.split()), unit)


KINDS: Mapping[str, Kind] = {
    "voltage gain steps": _kind(_of_voltage(_voltage_gain_step), "CalibrationSuspect", "of the gain"),
    "voltage gain drifts": _kind(_of_voltage(_voltage_gain_drift), "CalibrationSuspect", "of the gain"),
    "voltage offset": _kind(_of_voltage(_voltage_offset), "CalibrationSuspect", "of the peak"),
    "voltage stuck": _kind(_of_voltage(_voltage_stuck), "StuckValue", "s"),
    "voltage clipped": _kind(_of_voltage(_voltage_clipped), "Saturated", "of the peak"),
    "voltage turned": _kind(_of_voltage(_voltage_turned), "Unphysical CalibrationSuspect", ""),
    "voltage late": _kind(_voltage_late, "SampleTiming", "samples"),
    "gain steps": _kind(_of_rows(signal_faults.gain_step), "CalibrationSuspect", "of the gain"),
    "gain drifts": _kind(_of_rows(signal_faults.gain_drift), "CalibrationSuspect", "of the gain"),
    "offset": _kind(_of_rows(signal_faults.offset), "CalibrationSuspect", "of the peak"),
    "stuck": _kind(_of_rows(signal_faults.stuck), "StuckValue", "s"),
    "current late": _kind(_of_rows(signal_faults.current_late), "SampleTiming", "rows"),
    "cutting load": _kind(_of_machine(machine_faults.cutting_load), "LoadDetected", "of the peak torque"),
    "stiff travel": _kind(_of_machine(machine_faults.stiff_travel), "LoadDetected", "of the peak torque"),
    "collision": _kind(_of_machine(machine_faults.collision), "LoadDetected", "of the peak torque"),
    "Stribeck friction": _kind(_of_machine(machine_faults.stribeck), "ValidationFailed", "of the peak torque"),
}


@dataclass(frozen=True, slots=True)
class Judged:
    """One recording: its seed, kind, severity, windows listed and refused, and the reasons."""

    seed: int
    kind: str
    severity: float
    windows: int
    refused: int
    texts: tuple[str, ...]

    @property
    def codes(self) -> frozenset[str]:
        """Classes of the reasons."""
        return frozenset(text.split(":")[0] for text in self.texts)


def judge(seed: int, study: int, kind: str | None = None) -> Judged:
    """Return what the validation says of one recording; a bad one's kind goes round with ``seed``."""
    name = kind or list(KINDS)[seed % len(KINDS)]
    make = _fine if name == GOOD else KINDS[name].make
    recording, severity = make(np.random.default_rng([study, 1 if name == GOOD else 2, seed]))
    verdicts = [analyse(window, SETTINGS).verdict for window in find_windows(recording)]
    texts = tuple(dict.fromkeys(str(reason) for verdict in verdicts for reason in verdict.reasons))
    return Judged(seed, name, severity, len(verdicts), sum(not v.accepted for v in verdicts), texts)


@dataclass
class Tally:
    """What became of the recordings of one kind."""

    made: list[Judged] = field(default_factory=list)

    def row(self, name: str) -> str:
        """Return the row of the table."""
        kind, codes = KINDS[name], Counter(code for one in self.made for code in one.codes)
        accepted = sum(one.windows > one.refused for one in self.made)
        right = sum(bool(kind.named & one.codes) for one in self.made) / len(self.made)
        least = f"{min(one.severity for one in self.made):.3g} {kind.unit}" if kind.unit else ""
        given = ", ".join(f"{count} {code}" for code, count in codes.most_common())
        return f"| {name} | {len(self.made)} | {least} | {accepted} | {right:.0%} | {given} |"


def verdicts_page(good: range, bad: range, study: int, processes: int) -> str:
    """Return the table of verdicts."""
    fine = list(_all(partial(judge, study=study, kind=GOOD), good, processes))
    windows, refused = sum(one.windows for one in fine), sum(one.refused for one in fine)
    given = Counter(code for one in fine for code in one.codes)
    for one in fine:
        if one.refused:
            print("refused", one.seed, one.texts, flush=True)
    kinds = {name: Tally() for name in KINDS}
    for one in _all(partial(judge, study=study), bad, processes):
        kinds[one.kind].made.append(one)
        if one.windows > one.refused:
            print("accepted", one.kind, one.seed, f"{one.severity:.3g}", flush=True)
    told_of_good = ", ".join(f"{count} {code}" for code, count in given.most_common()) or "none"
    return "\n".join([
        f"Good: {windows} windows of {len(fine)} recordings, {refused} refused ({refused / max(1, windows):.2%}). "
        f"Reasons: {told_of_good}.",
        "",
        "| fault | recordings | smallest severity | accepted | named rightly | reasons given |",
        "|---|---|---|---|---|---|",
        *(tally.row(name) for name, tally in kinds.items() if tally.made),
    ])  # fmt: skip


INTRODUCTION = """# A voltage sensor slower than the drive

Written by `python -m studies.slow_sensor`. The sensor samples on a grid of its own, later or earlier than it says by up
to 0.6 of its samples, which the fit finds as a seventh parameter.

## How well the parameters are known

One rapid of the bench, rows at 1 kHz.
"""


def main() -> None:
    """Run the study and write its page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100, help="rapids for each row of the first table")
    parser.add_argument("--good", type=int, default=400)
    parser.add_argument("--bad", type=int, default=480)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--study", type=int, default=1, help="seed of the drives of the second table")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("docs/studies/slow_sensor.md"))
    options = parser.parse_args()
    first, second = options.first, options.first
    intervals = intervals_page(range(first, first + options.runs), options.processes)
    verdicts = verdicts_page(
        range(second, second + options.good), range(second, second + options.bad), options.study, options.processes
    )
    print(verdicts)
    heading = "\n\n## Good windows refused, bad windows accepted\n\nRandom drives and rapids as in [the verdicts]"
    options.out.write_text(f"{INTRODUCTION}\n{intervals}{heading}(verdicts.md).\n\n{verdicts}\n")


if __name__ == "__main__":
    main()
