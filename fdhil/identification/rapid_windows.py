"""Finds rapid moves in a recording: where each begins and ends, and its stages.

A window is a maximal run in which the smoothed speed is at least 2 % of the rapid speed, extended to standstill. A run
whose peak stays below 60 % of the rapid speed is a feed move and is left out.
"""

import math
from dataclasses import dataclass, replace
from itertools import islice, pairwise

import numpy as np

from fdhil.identification.filtering import compute_moving_mean
from fdhil.records import Bool, Float, Int, Recording, SlowVoltage, Stages, Window, make_read_only_view

RUN_SHARE = 0.02
RAPID_SHARE = 0.60
SETTLING_SHARE = 0.2  # of the move's top speed
SETTLING_S = 0.100
PLATEAU_S = 0.100
PLATEAU_BAND = 0.025
SMOOTHING_S = 0.015
EXTENSION_S = 0.040
MARGIN_S = 0.100


@dataclass(frozen=True, slots=True)
class MoveInterval:
    """Half-open sample range of one move: where the smoothed speed exceeds 2 %, and that extended to standstill."""

    start: int
    end: int
    rest_start: int
    rest_end: int
    direction: int


def smooth_samples(values: Float, dt_s: float, seconds: float = SMOOTHING_S) -> Float:
    """Return ``values`` (n,) averaged over ``seconds`` about each sample; a lost one (NaN) repeats the last."""
    width = 2 * round(seconds / dt_s / 2) + 1
    return compute_moving_mean(fill_forward(values), width)


def fill_forward(values: Float) -> Float:
    """Return ``values`` with each non-finite sample replaced by the last finite one before it (0 without any)."""
    finite = np.isfinite(values)
    if finite.all():
        return values
    last = np.maximum.accumulate(np.where(finite, np.arange(values.size), -1))
    return np.where(last < 0, 0.0, values[np.maximum(last, 0)])


def interpolate_gaps(values: Float) -> Float:
    """Return ``values`` with gaps of non-finite samples interpolated linearly; some sample must be finite."""
    known = np.isfinite(values)
    return values if known.all() else np.interp(np.arange(values.size), np.flatnonzero(known), values[known])


def estimate_noise_std(values: Float) -> float:
    """Return the standard deviation of white noise on a smooth signal, from its third differences (robust)."""
    if values.size < 4:
        return 0.0
    with np.errstate(invalid="ignore"):  # inf - inf; non-finite values are left out
        d = np.abs(values[3:] - values[:-3] - 3.0 * (values[2:-1] - values[1:-2]))
    d = d[np.isfinite(d)]
    if not d.size:
        return 0.0
    middle = (d.size - 1) // 2, d.size // 2
    ordered = np.partition(d, middle)  # np.median takes five times longer
    return float(1.4826 * (ordered[middle[0]] + ordered[middle[1]]) / 2 / np.sqrt(20.0))


def find_windows(recording: Recording, rapid_speed_rad_s: float | None = None) -> list[Window]:
    """Return the rapids of a recording, in time order.

    The rapid speed is the recording's own, else ``rapid_speed_rad_s`` (the machine's), else the file's largest.
    """
    speed = smooth_samples(recording.speed_rad_s, recording.dt_s)
    rapid = recording.rapid_speed_rad_s or rapid_speed_rad_s or float(np.max(np.abs(speed), initial=0.0))
    if rapid <= 0 or not np.isfinite(rapid):
        return []
    runs = _find_moves(speed, rapid, recording.dt_s, estimate_noise_std(recording.speed_rad_s))
    windows = []
    for k, run in enumerate(runs):
        if np.abs(speed[run.start : run.end]).max() < RAPID_SHARE * rapid:
            continue
        floor = runs[k - 1].rest_end if k else 0
        # settling is not another move: the window lasts until standstill
        later = (other for other in islice(runs, k + 1, None) if not _is_settling(speed, recording.dt_s, run, other))
        following = next(later, None)
        ceiling = speed.size if following is None else following.rest_start
        windows.append(_cut_window(recording, speed, run, floor, ceiling, rapid))
    return windows


def make_whole_window(recording: Recording) -> Window:
    """Return all of a recording as one window of any move, with its top speed as rapid speed and its net direction."""
    speed = smooth_samples(recording.speed_rad_s, recording.dt_s)
    top, n = float(np.max(np.abs(speed), initial=0.0)), speed.size
    run = MoveInterval(0, n, 0, n, 1 if speed.sum() >= 0.0 else -1)
    window = _cut_window(recording, speed, run, 0, n, max(top, 1e-9))
    return replace(window, stages=Stages((0, n), None, None), is_rapid=False)


def _find_moves(speed: Float, rapid: float, dt: float, noise: float) -> list[MoveInterval]:
    side = np.sign(speed) * (np.abs(speed) >= RUN_SHARE * rapid)
    edges = np.flatnonzero(np.diff(side)) + 1
    bounds = np.concatenate([[0], edges, [side.size]])
    spans = [(int(a), int(b)) for a, b in pairwise(bounds) if b > a and side[a] != 0]
    # largest smoothed noise at standstill
    still = np.abs(speed) <= max(0.002 * rapid, 3 * noise / np.sqrt(max(1.0, SMOOTHING_S / dt)))
    reach = round(EXTENSION_S / dt)
    runs = []
    for k, (a, b) in enumerate(spans):
        low = max(spans[k - 1][1] if k else 0, a - reach)
        high = min(spans[k + 1][0] if k + 1 < len(spans) else side.size, b + reach)
        before, after = np.flatnonzero(still[low:a]), np.flatnonzero(still[b:high])
        start = low + int(before[-1]) + 1 if before.size else low
        end = b + int(after[0]) if after.size else high
        runs.append(MoveInterval(a, b, start, end, int(side[a])))
    return runs


def _is_settling(speed: Float, dt: float, run: MoveInterval, other: MoveInterval) -> bool:
    """Return whether ``other`` is how ``run`` settles, overshooting or creeping: immediate, short and slow."""
    at_once = (other.start - run.end) * dt <= EXTENSION_S and (other.end - other.start) * dt <= SETTLING_S
    slow = np.abs(speed[other.start : other.end]).max() < SETTLING_SHARE * np.abs(speed[run.start : run.end]).max()
    return at_once and bool(slow)


def _cut_window(
    recording: Recording, speed: Float, run: MoveInterval, floor: int, ceiling: int, rapid: float
) -> Window:
    margin = round(MARGIN_S / recording.dt_s)
    # neighbouring moves may shorten the margins, not the move
    a = max(min(floor, run.rest_start), run.rest_start - margin)
    b = min(max(ceiling, run.rest_end), run.rest_end + margin)
    part = slice(a, b)
    gaps = tuple((max(g, a) - a, min(h, b) - a) for g, h in recording.gaps if g < b and h > a)
    voltage, offset = recording.voltage_v, recording.offset_mm
    return Window(
        axis=recording.axis,
        start_tick=recording.start_tick + a,
        start_s=float(recording.time_s[a]),
        dt_s=recording.dt_s,
        demand_mm=make_read_only_view(recording.demand_mm[part]),
        position_mm=make_read_only_view(recording.position_mm[part]),
        speed_rad_s=make_read_only_view(recording.speed_rad_s[part]),
        current_a=make_read_only_view(recording.current_a[part]),
        voltage_v=make_read_only_view(voltage[part])
        if voltage is not None and recording.slow_voltage is None
        else None,
        voltage_sampling=recording.voltage_sampling,
        stages=_find_stages(speed, run, a, recording.dt_s),
        direction=run.direction,
        rapid_speed_rad_s=rapid,
        pitch_mm=recording.pitch_mm,
        gaps=gaps,
        temperature_c=recording.temperature_c,
        voltage_delay_s=recording.voltage_delay_s,
        source=recording.source,
        offset_mm=make_read_only_view(offset[part])
        if offset is not None and np.any(np.abs(offset[part]) > 0)
        else None,
        slow_voltage=_cut_slow_voltage(recording, a, b),
        torque_constant_nm_per_a=recording.torque_constant_nm_per_a,
        table_mm=_slice_optional(recording.table_mm, part),
        table_m_s2=_slice_optional(recording.table_m_s2, part),
    )


def _slice_optional(values: Float | None, part: slice) -> Float | None:
    return None if values is None or not np.isfinite(values[part]).any() else make_read_only_view(values[part])


def _cut_slow_voltage(recording: Recording, a: int, b: int) -> SlowVoltage | None:
    """Return the low-rate samples wholly between samples ``a`` and ``b`` - 1; None without any."""
    slow = recording.slow_voltage
    if slow is None:
        return None
    begin, last = a * recording.dt_s, (b - 1) * recording.dt_s
    first = max(0, math.ceil((begin - slow.begin_s) / slow.period_s - 1e-9))
    end = math.floor((last - slow.begin_s) / slow.period_s + 1e-9)
    moved = slow.begin_s + first * slow.period_s - begin
    if end <= first:
        return None
    late = None if slow.late_s is None else make_read_only_view(slow.late_s[first:end])
    return replace(slow, begin_s=moved, voltage_v=make_read_only_view(slow.voltage_v[first:end]), late_s=late)


def _find_stages(speed: Float, run: MoveInterval, offset: int, dt: float) -> Stages:
    """Return the stages in samples of the window; a recording that begins or ends in the move lacks that stage."""
    moving = np.abs(speed[run.rest_start : run.rest_end])
    top = _find_plateau_speed(moving)
    first, last = find_longest_run(np.abs(moving - top) <= PLATEAU_BAND * top)
    begin, end = run.rest_start - offset, run.rest_end - offset
    whole_start = run.start > 0 and abs(speed[run.start - 1]) < abs(speed[run.start]) and run.rest_start > 0
    whole_end = run.rest_end < speed.size or moving[-1] < RUN_SHARE * top
    long_enough = (last - first) * dt >= PLATEAU_S
    return Stages(
        accelerate=(begin, begin + first) if whole_start and first > 0 else None,
        cruise=(begin + first, begin + last) if long_enough else None,
        brake=(begin + last, end) if whole_end and run.rest_start + last < run.rest_end else None,
    )


def _find_plateau_speed(moving: Float) -> float:
    """Return the speed with most samples about it: the plateau's, also where the drive overshoots it."""
    ordered = np.sort(moving[moving >= 0.5 * moving.max()])
    counts = np.searchsorted(ordered, ordered * (1 + PLATEAU_BAND)) - np.searchsorted(
        ordered, ordered * (1 - PLATEAU_BAND)
    )
    return float(ordered[int(np.argmax(counts))])


def find_runs(flags: Bool) -> Int:
    """Return the half-open ranges (k, 2) of the runs of True, in order."""
    return np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8))).reshape(-1, 2)


def sort_runs_by_length(flags: Bool, least: int = 1) -> list[tuple[int, int]]:
    """Return the half-open ranges of the runs of True of at least ``least`` samples, the longest first."""
    runs = [(int(start), int(end)) for start, end in find_runs(flags) if end - start >= least]
    return sorted(runs, key=lambda run: run[0] - run[1])


def find_longest_run(flags: Bool) -> tuple[int, int]:
    """Return the half-open range of the longest run of True; (0, 0) without any."""
    return next(iter(sort_runs_by_length(flags)), (0, 0))


def find_moving_range(window: Window) -> tuple[int, int]:
    """Return the half-open range of the move itself, without the margins of standstill."""
    stages = [s for s in (window.stages.accelerate, window.stages.cruise, window.stages.brake) if s is not None]
    if not stages:
        return 0, window.n
    return stages[0][0], stages[-1][1]
