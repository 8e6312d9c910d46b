"""Aligns a late recorded speed to its samples: what drives report as speed is often not a direct reading.

A difference of encoder positions is half a sample late; a filter adds its own lag. The position reveals the lag, which
is removed from the speed itself: a filter by its inverse, a mean by a stencil.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np

from fdhil.identification.filtering import compute_moving_mean
from fdhil.identification.normal_equations import invert_gram
from fdhil.identification.prepared_motion import detect_motion, find_resolution
from fdhil.identification.rapid_windows import estimate_noise_std, interpolate_gaps
from fdhil.identification.robust_covariance import estimate_long_run_variance
from fdhil.records import Bool, Float, Window, make_read_only_view

SpeedSource = Literal["auto", "sensor", "difference", "filtered"]

SURE = 5.0  # standard deviations of a significant lag
LEAST = 0.05  # of a sample: a smaller lag is less than the regulators' effect within a sample
LARGEST_S = 0.020  # no drive reports an older speed
SMOOTHING_S = 0.005  # of the acceleration
EXPLAINED = 2.0  # of the noise: allowed RMS difference between speed and position
FLOOR = 1e-3  # of the top speed, added to it
SURELY_LESS = 0.5  # of the squares by the most usual lag: another one must have fewer
FINER = 0.5  # of the aligned speed's noise: the position's derivative must have less to replace it
LEAST_ROWS = 32
NIL = 1e-6  # of a filter's response: the part that is left out
REACH = 3  # samples about a lost one that cannot be aligned


@dataclass(frozen=True, slots=True)
class SpeedLag:
    """The lag of a speed with its standard deviation, and its cause.

    The speed is a ``mean`` over the sample before, or instants, behind a first-order filter that keeps ``share`` per
    sample; ``moved_s`` is a pure delay.
    """

    late_s: float
    std_s: float
    mean: bool = False
    share: float = 0.0
    moved_s: float = 0.0

    def simulate_reported_speed(self, angle: Float, dt_s: float) -> Float:
        """Return the speed (n,) that a drive with this lag reports for ``angle`` (n,), rad."""
        speed = np.diff(angle, prepend=angle[0]) / dt_s if self.mean else differentiate_position(angle, dt_s)
        if self.moved_s:
            return shift_samples(speed, -self.moved_s / dt_s)
        return apply_first_order_filter(speed, self.share) if self.share else speed

    def invert_lag(self, speed: Float, dt_s: float) -> Float:
        """Return the speed (n,) at the instants of the samples."""
        if self.moved_s:
            return shift_samples(speed, self.moved_s / dt_s)
        if self.share:
            speed = (speed - self.share * np.concatenate([speed[:1], speed[:-1]])) / (1.0 - self.share)
        return convert_means_to_instants(speed) if self.mean else speed


def align_speed_to_samples(window: Window, source: SpeedSource = "auto") -> Window:
    """Return the window with its speed at the instants of its samples; the window itself without a significant lag.

    ``source`` is ``[identification] speed_source``.
    """
    known = np.isfinite(window.speed_rad_s)
    if window.speed_late_s is not None or source == "sensor" or np.count_nonzero(known) < LEAST_ROWS:
        return window
    return _align_speed(window, source)


@lru_cache(maxsize=12)
def _align_speed(window: Window, source: SpeedSource) -> Window:
    with np.errstate(over="ignore", invalid="ignore"):  # implausible signals yield no lag
        found = estimate_speed_lag(window, source)
    if found is None:
        return window
    angle, dt = _compute_angle(window), window.dt_s
    speed = found.invert_lag(interpolate_gaps(window.speed_rad_s), dt)
    direct = differentiate_position(angle, dt)
    if estimate_noise_std(direct) < FINER * estimate_noise_std(speed) and _is_consistent(
        direct, speed, _select_moving(window)
    ):
        speed = direct
    lost = np.convolve(~np.isfinite(window.speed_rad_s), np.ones(2 * REACH + 1), "same") > 0.5
    speed = np.where(lost, np.nan, speed)
    return replace(
        window,
        speed_rad_s=make_read_only_view(speed),
        speed_late_s=found.late_s,
        speed_late_std_s=max(found.std_s, 1e-9),
    )


def estimate_speed_lag(window: Window, source: SpeedSource = "auto") -> SpeedLag | None:
    """Return the lag of a window's speed; None without a significant lag, or where it is undetermined."""
    dt = window.dt_s
    lateness = _estimate_lateness(window)
    if source == "difference":
        std = lateness[1] if lateness is not None else 0.0
        return SpeedLag(0.5 * dt, min(std, 0.1 * dt), mean=True)
    if lateness is None:
        return None
    late, std = lateness
    if source == "auto" and late < max(SURE * std, LEAST * dt):
        return None
    if not 0.0 < late < LARGEST_S:
        return None
    angle, speed, rows = _compute_angle(window), interpolate_gaps(window.speed_rad_s), _select_moving(window)
    possible = _list_possible_lags(late, std, dt)
    left = [_compute_speed_residuals(speed, lag.simulate_reported_speed(angle, dt), rows) for lag in possible]
    # between samples there is the position's own noise, of which a filter passes less
    powers = [float(np.square(compute_moving_mean(e, 2 * round(SMOOTHING_S / dt) + 1)).sum()) for e in left]
    best = int(np.argmin(powers))
    best = best if powers[best] < SURELY_LESS * powers[0] else 0
    return possible[best] if _is_explained_by_noise(left[best], window, rows) else None


def _list_possible_lags(late: float, std: float, dt: float) -> list[SpeedLag]:
    unsure = max(SURE * std, LEAST * dt)
    possible = [SpeedLag(late, std, share=late / (dt + late)), SpeedLag(late, std, moved_s=late)]
    rest = late - 0.5 * dt
    if rest > -unsure:
        possible.insert(0, SpeedLag(late, std, mean=True, share=rest / (dt + rest) if rest > unsure else 0.0))
    return possible


def _estimate_lateness(window: Window) -> tuple[float, float] | None:
    """Return the lag (s) of the speed against the position and its standard deviation; None if undetermined.

    The speed is a scale times that of the position, a constant, and minus the acceleration times the lag.
    """
    rows = _select_moving(window)
    if np.count_nonzero(rows) < LEAST_ROWS or not np.isfinite(window.position_mm).any():
        return None
    direct, dt = differentiate_position(_compute_angle(window), window.dt_s), window.dt_s
    width = 2 * round(SMOOTHING_S / dt / 2) + 1
    rate = np.gradient(compute_moving_mean(direct, width), dt)
    columns = np.column_stack([rate, direct, np.ones(window.n)])[rows]
    speed = interpolate_gaps(window.speed_rad_s)[rows]
    if not np.ptp(columns[:, 1]) > 0.0:
        return None
    inverse, condition = invert_gram(columns)
    weights = inverse @ (columns.T @ speed)
    left = speed - columns @ weights
    scores = (columns @ inverse[:, :1]) * left[:, None]
    variance = float(estimate_long_run_variance(scores)[0, 0])  # noise of either may correlate over samples
    if not (math.isfinite(condition) and 0.0 <= variance < np.inf and weights[1] != 0.0):
        return None
    deviation = math.sqrt(variance)
    return -float(weights[0] / weights[1]), deviation / abs(float(weights[1]))


def _select_moving(window: Window) -> Bool:
    known = np.isfinite(window.speed_rad_s) & np.isfinite(window.position_mm)
    whole = np.convolve(known, np.ones(2 * REACH + 1), "same") > 2 * REACH + 0.5
    return whole & detect_motion(window.speed_rad_s, window.rapid_speed_rad_s)


def _compute_angle(window: Window) -> Float:
    return interpolate_gaps(window.position_mm) * (2 * math.pi / window.pitch_mm)


def _compute_speed_residuals(speed: Float, seen: Float, rows: Bool) -> Float:
    columns = np.column_stack([seen, np.ones(seen.size)])[rows]
    inverse, _ = invert_gram(columns)
    return speed[rows] - columns @ (inverse @ (columns.T @ speed[rows]))


def _is_explained_by_noise(left: Float, window: Window, rows: Bool) -> bool:
    """Return whether noise and the position's resolution explain the difference between speed and position."""
    top = float(np.abs(window.speed_rad_s[rows]).max())
    step = find_resolution(_compute_angle(window)) / window.dt_s / math.sqrt(6.0)  # of the difference of two positions
    allowed = EXPLAINED * math.hypot(estimate_noise_std(left), step) + FLOOR * top
    return math.sqrt(float(left @ left) / left.size) <= allowed


def _is_consistent(direct: Float, speed: Float, rows: Bool) -> bool:
    apart = (direct - speed)[rows]
    return math.sqrt(float(apart @ apart) / apart.size) <= EXPLAINED * estimate_noise_std(apart)


def differentiate_position(angle: Float, dt_s: float) -> Float:
    """Return the speed (n,) at the instants of ``angle`` (n,), exact for quartics; plain differences at the ends."""
    speed = np.gradient(angle, dt_s)
    speed[2:-2] = (angle[:-4] - 8.0 * angle[1:-3] + 8.0 * angle[3:-1] - angle[4:]) / (12.0 * dt_s)
    return speed


def convert_means_to_instants(means: Float) -> Float:
    """Return a signal (n,) at the instants of its samples from means over the sample before each, exact for cubics."""
    instants = means.copy()
    instants[1:-2] = (-means[:-3] + 7.0 * means[1:-2] + 7.0 * means[2:-1] - means[3:]) / 12.0
    instants[[0, -2]] = (means[[0, -2]] + means[[1, -1]]) / 2.0
    return instants


def apply_first_order_filter(values: Float, share: float) -> Float:
    """Return ``values`` (n,) through a first-order filter that keeps ``share`` of its output per sample."""
    weights = (1.0 - share) * share ** np.arange(math.ceil(math.log(NIL) / math.log(share)))
    padded = np.concatenate([np.full(weights.size - 1, values[0]), values])
    return np.convolve(padded, weights, "valid")


def shift_samples(values: Float, rows: float) -> Float:
    """Return ``values`` (n,) as they are ``rows`` samples later, by cubic interpolation; the ends are held."""
    whole = math.floor(rows)
    x = rows - whole
    at = np.clip(np.arange(values.size)[:, None] + whole + np.arange(-1, 3), 0, values.size - 1)
    weights = np.array(
        [-x * (x - 1) * (x - 2) / 6, (x * x - 1) * (x - 2) / 2, -x * (x + 1) * (x - 2) / 2, x * (x * x - 1) / 6]
    )
    moved: Float = values[at] @ weights
    return moved
