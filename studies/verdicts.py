"""How often a good rapid is refused, and whether any bad one is accepted (``python -m studies.verdicts``).

Every window is simulated anew with its own seed: plant, distance, speed, acceleration, direction, noise and sampling
are drawn; each bad one gets one fault of sensor, wiring, machine or recording. The table goes to
``docs/studies/verdicts.md``.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from fdhil.config import Identification
from fdhil.identification.windows import find_windows
from fdhil.store.recording_csv import parse_recording
from fdhil.validation import analyse, pool
from studies import bench

Rng = np.random.Generator
Judged = tuple[str, bool, tuple[str, ...]]
COLUMNS = ("voltage_V", "current_A", "speed_rad_per_s", "position_m", "demand_m")


@dataclass(frozen=True)
class Case:
    """A rapid to be recorded: its signals before noise, the noise, and the rows in which it moves at full speed."""

    signals: bench.Signals
    noise: float
    speed_m_s: float
    cruise: tuple[int, int]
    accelerate: tuple[int, int]


def draw(rng: Rng, plant: bench.Plant | None = None, load: Callable[[Rng, int], bench.Array] | None = None) -> Case:
    """Draw a good rapid; ``plant`` and ``load`` put a fault into the machine itself."""
    drawn = bench.Plant(*(value * rng.uniform(0.82, 1.18) for value in bench.Plant().truth().values()))
    if plant is not None:
        drawn = replace(drawn, stribeck=plant.stribeck, stribeck_speed=plant.stribeck_speed)
    speed, acceleration = rng.uniform(0.35, 0.5), rng.uniform(3.0, 6.0)
    dt = float(rng.choice([1e-3, 1e-3, 1e-3, 2.5e-4]))
    demand = bench.shuttle(
        distance=rng.uniform(0.3, 0.5),
        speed=speed,
        acceleration=acceleration,
        smoothing=float(rng.choice([0.01, 0.02, 0.04])),
        first=int(rng.choice([1, -1])),
    )
    torque = load(rng, demand.size) if load is not None else None
    signals = bench.run(drawn, demand, load=torque, dt_s=dt, quantised=bool(rng.integers(2)))
    # the drive may overshoot its plateau
    top = np.flatnonzero(np.abs(signals.speed) > 0.95 * speed / 0.02 * 2 * np.pi)
    moving = np.flatnonzero(np.abs(signals.speed) > 0.05 * np.abs(signals.speed).max())
    noise = float(rng.choice([0.001, 0.002, 0.003, 0.005]))
    return Case(signals, noise, speed, (int(top[0]), int(top[-1])), (int(moving[0]), int(top[0])))


def columns_of(case: Case, rng: Rng) -> dict[str, bench.Array]:
    """Return what the sensors give, noise included, by column name."""
    s, n = case.signals, case.signals.speed.size
    sizes = {"voltage_V": 60.0, "current_A": 50.0, "speed_rad_per_s": 150.0, "position_m": 0.0, "demand_m": 0.0}
    values = (s.voltage, s.current, s.speed, s.position, s.demand)
    return {
        name: np.array(v + case.noise * sizes[name] * rng.standard_normal(n))
        for name, v in zip(COLUMNS, values, strict=True)
    }


Columns = dict[str, bench.Array]
Spoiler = Callable[[Rng, Case, Columns], Columns]


def clipped(rng: Rng, _case: Case, c: Columns) -> Columns:
    """A current or voltage sensor clips at 40 to 80 % of the peak."""
    name = str(rng.choice(["current_A", "voltage_V"]))
    rail = rng.uniform(0.4, 0.8) * np.abs(c[name]).max()
    return c | {name: np.clip(c[name], -rail, rail)}


def gain_step(rng: Rng, case: Case, c: Columns) -> Columns:
    """A sensor's gain changes by 8 to 20 % within the move."""
    name = str(rng.choice(COLUMNS[:3]))
    values = c[name].copy()
    begin, end = case.accelerate[0], case.cruise[1]
    values[int(rng.uniform(begin + 0.2 * (end - begin), end)) :] *= 1 + rng.choice([-1, 1]) * rng.uniform(0.08, 0.2)
    return c | {name: values}


def stuck(rng: Rng, case: Case, c: Columns) -> Columns:
    """A sensor repeats one value for 30 to 100 ms while the axis moves."""
    name = str(rng.choice(COLUMNS[:3]))
    values = c[name].copy()
    length = round(rng.uniform(0.03, 0.1) / case.signals.dt_s)
    start = int(rng.uniform(case.accelerate[0], case.cruise[1] - length))
    values[start : start + length] = values[start]
    return c | {name: values}


def late(rng: Rng, case: Case, c: Columns) -> Columns:
    """The voltage is 2 to 12 ms late."""
    rows = round(rng.uniform(0.002, 0.012) / case.signals.dt_s)
    return c | {"voltage_V": np.concatenate([np.full(rows, c["voltage_V"][0]), c["voltage_V"][:-rows]])}


def lost(rng: Rng, case: Case, c: Columns) -> Columns:
    """20 to 100 ms of samples are lost and the time column is renumbered."""
    rows = round(rng.uniform(0.02, 0.1) / case.signals.dt_s)
    start = int(rng.uniform(case.accelerate[0], case.cruise[1] - rows))
    keep = np.r_[0:start, start + rows : c["voltage_V"].size]
    return {name: values[keep] for name, values in c.items()}


def speed_offset(rng: Rng, _case: Case, c: Columns) -> Columns:
    """The speed sensor's zero is off by 1 to 3 % of the range."""
    return c | {"speed_rad_per_s": c["speed_rad_per_s"] + rng.choice([-1, 1]) * rng.uniform(1.5, 4.5)}


def current_offset(rng: Rng, _case: Case, c: Columns) -> Columns:
    """The current sensor's zero is off by 2 to 5 A."""
    return c | {"current_A": c["current_A"] + rng.choice([-1, 1]) * rng.uniform(2.0, 5.0)}


def voltage_offset(rng: Rng, _case: Case, c: Columns) -> Columns:
    """The voltage sensor's zero is off by 3 to 8 V."""
    return c | {"voltage_V": c["voltage_V"] + rng.choice([-1, 1]) * rng.uniform(3.0, 8.0)}


def speed_scale(rng: Rng, _case: Case, c: Columns) -> Columns:
    """The speed's scale is off by 3 to 15 %."""
    return c | {"speed_rad_per_s": c["speed_rad_per_s"] * (1 + rng.choice([-1, 1]) * rng.uniform(0.03, 0.15))}


def swapped_sign(rng: Rng, _case: Case, c: Columns) -> Columns:
    """One signal has the wrong sign."""
    name = str(rng.choice(COLUMNS[:3]))
    return c | {name: -c[name]}


def swapped_columns(_rng: Rng, _case: Case, c: Columns) -> Columns:
    """Voltage and current are swapped."""
    return c | {"voltage_V": c["current_A"], "current_A": c["voltage_V"]}


def late_trigger(rng: Rng, case: Case, c: Columns) -> Columns:
    """The recording begins within the acceleration or later."""
    a, b = case.accelerate
    start = int(rng.uniform(a + 0.4 * (b - a), b + 0.3 * (case.cruise[1] - b)))
    return {name: values[start:] for name, values in c.items()}


def ends_early(rng: Rng, case: Case, c: Columns) -> Columns:
    """The recording ends at full speed."""
    end = int(rng.uniform(case.cruise[0] + 0.3 * (case.cruise[1] - case.cruise[0]), case.cruise[1]))
    return {name: values[:end] for name, values in c.items()}


def lagging_sensor(rng: Rng, case: Case, c: Columns) -> Columns:
    """The current sensor has a low-pass of 4 to 10 ms of its own."""
    pole = np.exp(-case.signals.dt_s / rng.uniform(0.004, 0.010))
    values = c["current_A"].copy()
    for k in range(1, values.size):
        values[k] = pole * values[k - 1] + (1 - pole) * values[k]
    return c | {"current_A": values}


SPOILERS: tuple[Spoiler, ...] = (
    clipped, gain_step, stuck, late, lost, speed_offset, current_offset, voltage_offset, speed_scale, swapped_sign,
    swapped_columns, late_trigger, ends_early, lagging_sensor,
)  # fmt: skip


def _cutting(rng: Rng, size: int) -> bench.Array:
    """A load torque of 4 to 12 N.m for 80 to 300 ms within the move."""
    load = np.zeros(size)
    start = int(rng.uniform(200, 600))
    load[start : start + int(rng.uniform(80, 300))] = rng.choice([-1, 1]) * rng.uniform(4, 12)
    return load


def _stiff(rng: Rng, size: int) -> bench.Array:
    """A torque that grows along the travel: a bent screw, a hose that pulls."""
    ramp: bench.Array = rng.choice([-1, 1]) * rng.uniform(6, 15) * np.clip((np.arange(size) - 55) / 900, 0, 1)
    return ramp


def good(seed: int) -> Judged:
    """Analyse one good rapid."""
    rng = np.random.default_rng([1, seed])
    case = draw(rng)
    return ("good", *judged(case, columns_of(case, rng)))


def bad(seed: int) -> Judged:
    """Analyse one rapid with the fault that ``seed`` chooses."""
    rng = np.random.default_rng([2, seed])
    kinds = len(SPOILERS) + 4
    kind = seed % kinds
    if kind < len(SPOILERS):
        case = draw(rng)
        spoiler = SPOILERS[kind]
        return (spoiler.__name__, *judged(case, spoiler(rng, case, columns_of(case, rng))))
    if kind == len(SPOILERS):
        case = draw(rng, load=_cutting)
        return ("cutting", *judged(case, columns_of(case, rng)))
    if kind == len(SPOILERS) + 1:
        case = draw(rng, load=_stiff)
        return ("stiff_travel", *judged(case, columns_of(case, rng)))
    if kind == len(SPOILERS) + 2:
        plant = bench.Plant(stribeck=rng.uniform(9, 15), stribeck_speed=rng.uniform(8, 30))
        case = draw(rng, plant=plant)
        return ("stribeck", *judged(case, columns_of(case, rng)))
    signals = bench.run(bench.Plant(), bench.shuttle(distance=rng.uniform(0.03, 0.08), acceleration=5.0))
    case = Case(signals, 0.003, 0.5, (0, 1), (0, 1))
    return ("no_plateau", *judged(case, columns_of(case, rng)))


def judged(case: Case, columns: Columns) -> tuple[bool, tuple[str, ...]]:
    """Return whether the recording's pool is accepted, and the codes of all reasons."""
    text = bench.table_text(case.signals.dt_s, columns, rapid_speed_m_per_s=f"{case.speed_m_s:.3f}")
    settings = Identification()
    outcomes = [analyse(window, settings) for window in find_windows(parse_recording(text))]
    _, verdict = pool(outcomes, settings)
    codes = {reason.code for outcome in outcomes for reason in outcome.verdict.reasons}
    codes |= {reason.code for reason in verdict.reasons}
    return verdict.accepted, tuple(sorted(codes))


def survey(count: int, analyse_one: Callable[[int], Judged], processes: int) -> Iterator[tuple[int, Judged]]:
    """Yield seed, kind, acceptance and codes of ``count`` windows."""
    if processes < 2:
        yield from ((seed, analyse_one(seed)) for seed in range(count))
        return
    with ProcessPoolExecutor(processes) as executor:
        yield from enumerate(executor.map(analyse_one, range(count), chunksize=16))


def table(good_count: int, bad_count: int, processes: int) -> tuple[str, Mapping[str, list[int]]]:
    """Return the study's page and, by kind, the seeds that were judged wrongly."""
    kinds: dict[str, Counter[str]] = {}
    wrong: dict[str, list[int]] = {}
    for expected, run in ((True, partial(survey, good_count, good)), (False, partial(survey, bad_count, bad))):
        for seed, (kind, accepted, codes) in run(processes):
            counter = kinds.setdefault(kind, Counter())
            counter["windows"] += 1
            counter["accepted"] += accepted
            counter.update(codes)
            if accepted != expected:
                wrong.setdefault(kind, []).append(seed)
    lines = ["| kind | recordings | accepted | named as |", "|---|---|---|---|"]
    for kind, counter in kinds.items():
        named = ", ".join(f"{c} {k}" for c, k in counter.most_common() if c not in ("windows", "accepted"))
        lines.append(f"| {kind} | {counter['windows']} | {counter['accepted']} | {named} |")
    return "\n".join(lines) + "\n", wrong


def main() -> None:
    """Run the study and write its page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--good", type=int, default=2000)
    parser.add_argument("--bad", type=int, default=3000)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("docs/studies/verdicts.md"))
    options = parser.parse_args()
    page, wrong = table(options.good, options.bad, options.processes)
    head = "# Good windows refused, bad windows accepted\n\nWritten by `python -m studies.verdicts`.\n\n"
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(head + page)
    print(page)
    print("judged wrongly, by seed:", dict(wrong))


if __name__ == "__main__":
    main()
