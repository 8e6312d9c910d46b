"""Replays a rapid through the closed loop from its recorded demand."""

import math
from dataclasses import dataclass, replace

import numpy as np

from fdhil.config import Axis, Regulators
from fdhil.identification.filtering import compute_moving_mean, erode_flags
from fdhil.identification.prepared_motion import detect_motion
from fdhil.identification.rapid_windows import interpolate_gaps
from fdhil.model import (
    CURRENT,
    CURRENT_DEMAND,
    CURRENT_INTEGRAL,
    POSITION_BEFORE,
    POSITION_INTEGRAL,
    SPEED,
    SPEED_FILTERED,
    SPEED_INTEGRAL,
    WAITING,
    State,
    create_zero_state,
    simulate_axis,
)
from fdhil.records import Bool, Float, Parameters, Window, make_read_only_view

LEAST_ROWS = 50
REST_ROWS = 30
LEAD_ROWS = 5
BEGUN = 1e-6  # of the travel
CREEP = 1e-5
EDGE_ROWS = 3  # at either end, where the demand may be cut
NIL_MM = 1e-9
PENALISED = 3  # order of the differences
WEIGHTS = tuple(10.0**k for k in range(6))
LOW_PASS_S = 0.009  # applied twice: about 40 Hz, the bandwidth of the outer loops
ROUNDED = 0.7  # of a step: half a step, and more at a corner where the neighbours are rounded too


@dataclass(frozen=True, slots=True)
class Rapid:
    """One rapid, samples (n,) of its window from ``first`` on: the drive's demand and its response.

    ``known`` marks complete samples; the axis stood at ``standstill_mm``, held by ``standstill_a``, or still moved at
    ``creep_mm_s`` from the move before. ``compute_load_nm`` (n,) is the torque that ``plant`` does not explain.
    """

    dt_s: float
    first: int
    demand_mm: Float
    position_mm: Float
    current_a: Float
    known: Bool
    standstill_mm: float
    standstill_a: float
    creep_mm_s: float
    plant: Parameters
    load_nm: Float

    @property
    def lag_mm(self) -> Float:
        """The following error, demand less position."""
        return np.asarray(self.demand_mm - self.position_mm)

    @property
    def resolution_mm(self) -> float:
        """The step of the recorded position."""
        steps = np.abs(np.diff(self.position_mm))
        return float(steps[steps > NIL_MM].min(initial=np.inf)) if (steps > NIL_MM).any() else 0.0


def extract_rapid(window: Window, plant: Parameters, sync_period_s: float | None = None) -> Rapid | None:
    """Return the rapid of a window, moved by ``plant``; None without demand, position or current.

    Set-points come every ``sync_period_s`` (default: every sample); samples between set-points are left out.
    """
    window = _select_setpoint_samples(window, sync_period_s)
    known = np.isfinite(window.demand_mm) & np.isfinite(window.position_mm) & np.isfinite(window.current_a)
    known[:EDGE_ROWS] = known[-EDGE_ROWS:] = False
    if np.count_nonzero(known) < LEAST_ROWS:
        return None
    demand, position = interpolate_gaps(window.demand_mm), interpolate_gaps(window.position_mm)
    way = np.ptp(position)
    if way <= 0.0 or np.ptp(demand) < 0.5 * way or np.array_equal(demand, position):
        return None  # the demand was not recorded
    offset = 0.0 if window.offset_mm is None else np.nan_to_num(window.offset_mm)
    demand = smooth_demand(demand) + offset
    begun = int(np.argmax(np.abs(demand - demand[0]) > BEGUN * way))
    first = max(0, begun - LEAD_ROWS)
    cut = slice(first, None)
    still = slice(max(0, first - REST_ROWS), first + 1)
    current = interpolate_gaps(window.current_a)
    creep = _estimate_creep_speed(position[still], window.dt_s, CREEP * way)
    return Rapid(
        window.dt_s,
        first,
        make_read_only_view(demand[cut].copy()),
        position[cut],
        current[cut],
        known[cut],
        float(position[cut][0]) if creep else float(position[still].mean()),
        _estimate_holding_current(current[still], first - still.start),
        creep,
        replace(plant, terms=()),
        _estimate_load_torque(position, current, plant, window)[cut],
    )


def _estimate_holding_current(current_a: Float, row: int) -> float:
    """Return the holding current at a sample: an axis held by friction off its target integrates ever more current."""
    rows = np.arange(current_a.size)
    return float(np.polyval(np.polyfit(rows, current_a, 1), row)) if rows.size > LEAD_ROWS else float(current_a.mean())


def _select_setpoint_samples(window: Window, sync_period_s: float | None) -> Window:
    every = 1 if sync_period_s is None else round(sync_period_s / window.dt_s)
    if every <= 1:
        return window
    kept = slice(-window.start_tick % every, None, every)
    return replace(
        window,
        dt_s=window.dt_s * every,
        demand_mm=window.demand_mm[kept],
        position_mm=window.position_mm[kept],
        current_a=window.current_a[kept],
        offset_mm=None if window.offset_mm is None else window.offset_mm[kept],
    )


def _estimate_load_torque(position_mm: Float, current_a: Float, plant: Parameters, window: Window) -> Float:
    """Return the low-passed torque (n,) that a plant of six parameters does not explain; held at standstill.

    Unmodelled friction, a load, ripples: the loops respond to them, and they must not bias the gains. All signals pass
    the same low-pass, so that second differences of the position are exact.
    """
    width = max(1, round(LOW_PASS_S / window.dt_s)) | 1
    rad_per_mm = 2 * math.pi / window.pitch_mm
    angle = compute_moving_mean(compute_moving_mean(position_mm * rad_per_mm, width), width)
    speed = np.gradient(angle, window.dt_s)
    moving = detect_motion(window.speed_rad_s, window.rapid_speed_rad_s)
    friction = plant.Cd * np.sign(speed) + plant.ft * speed
    torque = plant.K * compute_moving_mean(compute_moving_mean(current_a, width), width)
    acceleration = np.diff(angle, 2, prepend=angle[0], append=angle[-1]) / window.dt_s**2
    rows = np.flatnonzero(erode_flags(moving, 2 * width + 1, beyond=False))
    if not rows.size or width == 1:  # in such long samples instants of the current are not its mean
        return np.zeros(window.n)
    unexplained = torque - friction - plant.Jt * acceleration
    return np.asarray(np.interp(np.arange(window.n), rows, unexplained[rows]))


def _estimate_creep_speed(position_mm: Float, dt_s: float, least_mm: float) -> float:
    rows = position_mm.size
    if rows < 3 or abs(position_mm[-1] - position_mm[0]) < least_mm:
        return 0.0
    return float(np.polyfit(np.arange(rows) * dt_s, position_mm, 1)[0])


def smooth_demand(demand_mm: Float) -> Float:
    """Return the smoothest signal (n,) that rounds to a recorded demand: NCs plan more finely than they record.

    Rounded to 1 um at 1 kHz a demand has speed jumps of 1 mm/s that the drive never received. Squared third differences
    are penalised (Whittaker 1923) as far as rounding allows.
    """
    steps = np.abs(np.diff(demand_mm))
    steps = steps[steps > NIL_MM]
    course = demand_mm
    if demand_mm.size < 2 * PENALISED or not steps.size:
        return course
    for weight in WEIGHTS:
        trial = _smooth_whittaker(demand_mm, weight)
        if np.abs(trial - demand_mm).max() > ROUNDED * steps.min():
            break
        course = trial
    return course


def _smooth_whittaker(values: Float, weight: float) -> Float:
    """Return the signal (n,) of least squared distance to ``values`` + ``weight`` x squared third differences."""
    from scipy.linalg import solveh_banded  # imported late: it is slow, and loops are rarely identified

    n, third = values.size, np.array([-1.0, 3.0, -3.0, 1.0])
    bands = np.zeros((PENALISED + 1, n))
    for a in range(PENALISED + 1):
        for b in range(a, PENALISED + 1):
            bands[PENALISED - (b - a), b : n - PENALISED + b] += weight * third[a] * third[b]
    bands[PENALISED] += 1.0
    return np.asarray(solveh_banded(bands, values))


def replay_rapid(rapid: Rapid, axis: Axis, delay_cycles: float) -> Float:
    """Return the closed loop's position in mm and current in A (2, n) along a rapid's demand.

    ``delay_cycles`` replaces the regulators' own delay and may be fractional.
    """
    whole = math.floor(delay_cycles)
    part = delay_cycles - whole
    answer = _simulate_loops(rapid, axis, whole)
    if part > 0.0:
        answer = (1.0 - part) * answer + part * _simulate_loops(rapid, axis, whole + 1)
    return answer


def _simulate_loops(rapid: Rapid, axis: Axis, delay_cycles: int) -> Float:
    drive = replace_regulators(axis, current_delay_cycles=delay_cycles)
    # a load is a torque offset of the opposite sign, except in the current, which includes it
    offset = -rapid.load_nm * (axis.nominal.K / rapid.plant.K)
    start = compute_standstill_state(rapid, drive)
    answer = simulate_axis(rapid.plant, drive, rapid.dt_s, rapid.demand_mm, torque_offset_nm=offset, state=start)
    return np.stack((answer.position_mm, answer.current_a + rapid.load_nm / rapid.plant.K))


def compute_standstill_state(rapid: Rapid, axis: Axis) -> State:
    """Return the state of an axis at standstill, whose integrators supply the holding current."""
    g, rad_per_mm = axis.regulators, 2 * math.pi / axis.screw_pitch_mm
    speed = rapid.creep_mm_s * rad_per_mm
    lag = (rapid.demand_mm[0] - rapid.standstill_mm) * rad_per_mm
    current = rapid.standstill_a - rapid.load_nm[0] / rapid.plant.K
    held = rapid.standstill_a - g.speed_kp * (g.position_gain_per_s * lag - speed)
    state = create_zero_state(rapid.standstill_mm)
    state[[CURRENT, CURRENT_DEMAND]] = current
    state[[SPEED, SPEED_FILTERED]] = speed
    if g.structure == "pid":
        state[POSITION_INTEGRAL] = held / g.speed_kp
        state[POSITION_BEFORE] -= rapid.creep_mm_s * g.speed_period_s
    else:
        state[SPEED_INTEGRAL] = held
    voltage = rapid.plant.R * current + rapid.plant.K * speed
    state[CURRENT_INTEGRAL] = voltage
    state[WAITING : WAITING + g.current_delay_cycles] = voltage
    return state


def replace_regulators(axis: Axis, **values: float | str) -> Axis:
    """Return an axis with other regulators, without validation."""
    return axis.model_copy(update={"regulators": axis.regulators.model_copy(update=values)})


def adjust_loop_periods(regulators: Regulators, dt_s: float) -> dict[str, float]:
    """Return the configured periods of speed and current loop, adjusted to divide a sample."""
    speed = dt_s / max(1, round(dt_s / regulators.speed_period_s))
    current = speed / max(1, round(speed / regulators.current_period_s))
    return {"speed_period_s": speed, "current_period_s": current}
