"""Finds how a table swings on its screw's spring, from a sensor at the table beside the motor's own signals.

While the table moves one way its friction is constant or follows speed and angle, and two masses on a spring make the
table's place t follow the motor's place a as a linear system, with w and z those of the table, the motor held:

    (s^2 + 2 z w s + w^2) t = (2 z w s + w^2) a - friction / inertia of the table

The answer to the measured a is made at its frequencies. What swings since the table broke loose, offsets of sensors,
the screw's pitch and what friction bends are linear in it and fitted beside it. What the swinging table takes of the
motor's torque tells its share of the inertia, and so the resonance with the motor free, w / sqrt(1 - share).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from fdhil.config import Axis
from fdhil.identification.filtering import gain, quick_size, zero_phase
from fdhil.identification.motion import resolution
from fdhil.identification.windows import bridged, longest, noise_of, smooth
from fdhil.records import INTERVAL_95, Bool, Estimate, Float, Parameters, Reason, Window, frozen

TERMS = ("resonance", "resonance_damping", "resonance_share")
BAND_HZ = (12.0, 350.0)
TRIALS = 60  # frequencies at which it is sought first
HIGHEST = 0.4  # of the rows' rate
MOVING = 0.08  # of the top speed: below it friction changes with speed
LEAST_ROWS = 80
EVIDENCE = 30.0  # by which twice the log likelihood must rise, of rows of their own: by chance once in 10^5 windows
LARGEST_STD = 0.1  # of the frequency: where it is wider none is told
DAMPING = (0.03, 1.2)  # what is expected before it is seen, and the deviation of its logarithm
LATE_STD_S = 2e-3  # of how late the table's sensor may be against the drive's
SHARE = (0.5, 0.15)  # of the inertia that is the table's, before it is seen
CORRELATED_S = 0.02  # over which what is left is taken to be of one piece
STEPS = 25
SAME = 0.03  # of the frequency: what a configured one may be off
SEEN_BY = {"table_mm": 1.0, "table_m_s2": 1e-3}  # sensors, and mm in the unit of each


@dataclass(frozen=True, slots=True)
class Compliance:
    """The spring between motor and table as one window shows it: ``values`` (3,) of ``TERMS``, their covariance.

    ``late_s`` is by how much each sensor at the table is late against the drive's signals.
    """

    values: Float
    covariance: Float
    late_s: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class _Motor:
    """What the motor does, (n,) rows dt apart: its place (mm) with the spectrum of what is beside its line."""

    dt_s: float
    place_mm: Float
    speed_mm_s: Float
    rows: Bool
    turns: Float  # as an angle, rad
    spectrum: npt.NDArray[np.complex128]
    omega: Float
    line: Float
    noise: Float  # of the place, its power in a row (mm2) at the frequencies

    @classmethod
    def of(cls, window: Window) -> _Motor | None:
        """Return it of a window; None where too little of it is heard."""
        dt, mm_per_rad = window.dt_s, window.pitch_mm / (2 * math.pi)
        known = np.isfinite(window.speed_rad_s) & np.isfinite(window.position_mm)
        if np.count_nonzero(known) < LEAST_ROWS or known.mean() < 0.9:
            return None
        speed = bridged(window.speed_rad_s) * mm_per_rad
        size = 2 * quick_size(speed.size)  # even, as the inverse transform takes it
        place, noise = _place(bridged(window.position_mm), speed, dt, size)
        slow = smooth(speed, dt)
        moving = window.direction * slow > MOVING * np.abs(slow).max()
        first, last = longest(moving & known)
        rows = np.zeros(place.size, np.bool_)
        rows[first:last] = True
        n = place.size
        line = place[0] + (place[-1] - place[0]) * np.linspace(0.0, 1.0, n)
        omega = frozen(2 * math.pi * np.fft.rfftfreq(size, dt))
        return cls(dt, place, speed, rows, place / mm_per_rad, np.fft.rfft(place - line, size), omega, line, noise)

    def shown(self, passed: Float) -> Float:
        """Return the motor's way beside its line, in mm, through a gain at its frequencies."""
        through: Float = np.fft.irfft(self.spectrum * passed, 2 * (self.omega.size - 1))[: self.place_mm.size]
        return through


def _place(position_mm: Float, speed_mm_s: Float, dt: float, size: int) -> tuple[Float, Float]:
    """Return the motor's place (n,), slow parts from the encoder's place and quick ones from the speed, and its noise.

    Between two rows the speed is taken as a cubic. Summed up it drifts, so the encoder's place rules below the corner
    where the noise of both is alike. The noise is its power in a row at the frequencies of ``size`` rows.
    """
    w = np.concatenate([speed_mm_s[:1], speed_mm_s, speed_mm_s[-1:]])
    steps = dt / 24 * (13 * (w[1:-2] + w[2:-1]) - w[:-3] - w[3:])
    summed = np.concatenate([[0.0], np.cumsum(steps)])
    fine = max(noise_of(position_mm), resolution(position_mm) / math.sqrt(12.0), 1e-9)
    rough = max(dt * noise_of(speed_mm_s), 0.1 * fine)
    if rough > 2.0 * fine:
        return position_mm, np.full(size // 2 + 1, fine**2)
    corner = math.asin(0.5 * rough / fine) / (math.pi * dt)
    share = gain(size, corner, dt)
    swing = np.maximum(2 * np.sin(math.pi * np.fft.rfftfreq(size)), 1e-9)
    power = (share * fine) ** 2 + ((1.0 - share) * rough / swing) ** 2
    return summed + zero_phase(position_mm - summed, corner, dt), power


def answer(omega: Float, w: float, z: float) -> Float:
    """Return the complex gain from the motor's place to the table's at angular frequencies (n,), the motor leading."""
    s = 1j * omega
    pulled = 2 * z * w * s + w * w
    passed: Float = pulled / (s * s + pulled)
    return passed


@dataclass(frozen=True, slots=True)
class _Eye:
    """One sensor at the table beside the motor: ``seen`` (m,) mm or mm/s2 at the ``rows`` that it has."""

    motor: _Motor
    name: str
    seen: Float
    rows: Bool
    noise: float  # of its own, a row

    @property
    def inertial(self) -> bool:
        """Whether it sees acceleration."""
        return self.name == "table_m_s2"

    def stiff(self) -> Float:
        """Return the columns (m, q) of what a screw that does not give would show."""
        motor, rows = self.motor, self.rows
        turns, speed = motor.turns[rows], motor.speed_mm_s[rows]
        waves = np.column_stack([np.sin(turns), np.cos(turns)])
        one = np.ones(turns.size)
        if self.inertial:
            return np.column_stack([one, waves * (speed**2)[:, None]])
        return np.column_stack([one, motor.place_mm[rows], speed, waves])

    def swings(self, w: float, z: float) -> Float:
        """Return the columns (m, 2) of a table that swings since it broke loose."""
        t = self.motor.dt_s * np.arange(self.motor.rows.size)[self.rows]
        t, turning = t - t[0], w * math.sqrt(max(1.0 - z * z, 1e-6))
        fades = np.exp(-z * w * t)
        return np.column_stack([fades * np.cos(turning * t), fades * np.sin(turning * t)])

    def follows(self, w: float | None, z: float, late_s: float) -> Float:
        """Return (m,) what the table does that follows the motor by a spring; None: by a stiff screw."""
        omega = self.motor.omega
        passed = np.exp(-1j * omega * late_s) * (1.0 if w is None else answer(omega, w, z))
        if self.inertial:
            return -self.motor.shown(passed * omega**2)[self.rows]
        return (self.motor.shown(passed) + self.motor.line)[self.rows]

    def left(self, w: float | None, z: float, late_s: float) -> Float:
        """Return (m,) what could not be foretold of the signal when all that is linear is fitted."""
        columns, follows = self.columns(w, z), self.follows(w, z, late_s)
        if self.inertial:  # its gain is not known as well as that of a scale
            columns = np.column_stack([columns, follows, self.seen])
        else:
            columns = np.column_stack([columns, self.seen - follows])
        columns = self._unforetold(columns, w, z)
        seen, columns = columns[:, -1], columns[:, :-1]
        q, _ = np.linalg.qr(columns / np.linalg.norm(columns, axis=0))
        out: Float = seen - q @ (q.T @ seen)
        return out

    def columns(self, w: float | None, z: float) -> Float:
        """Return all columns (m, q) that are fitted beside the answer."""
        return self.stiff() if w is None else np.column_stack([self.stiff(), self.swings(w, z)])

    def _unforetold(self, columns: Float, w: float | None, z: float) -> Float:
        """Return what of columns (m, q) earlier rows do not foretell, by the noise that the sensors have.

        The motor's own noise swings in the answer as the table does. So the noise' power is known up to its size, and
        its minimum-phase factor, made by its cepstrum [OPP 13.5], is undone: what is left of it is white.
        """
        motor = self.motor
        passed = np.ones(motor.omega.size) if w is None else np.abs(answer(motor.omega, w, z)) ** 2
        passed = passed * motor.omega**4 if self.inertial else passed
        power = passed * motor.noise + self.noise**2
        size = 2 * (motor.omega.size - 1)
        cepstrum = np.fft.irfft(np.log(power), size)[: size // 2]
        cepstrum[0] = 0.0
        undone = np.exp(-np.fft.rfft(cepstrum, size))
        white: Float = np.fft.irfft(np.fft.rfft(columns, size, axis=0) * undone[:, None], size, axis=0)
        return white[: columns.shape[0]]

    def swinging(self, w: float, z: float, late_s: float) -> Float:
        """Return (m,) the speed in mm/s at which the table swings since it broke loose."""
        columns, follows = self.columns(w, z), self.follows(w, z, late_s)
        wanted = self.seen if self.inertial else self.seen - follows
        columns = np.column_stack([follows, columns]) if self.inertial else columns
        known = self._unforetold(np.column_stack([columns, wanted]), w, z)
        scale = np.linalg.norm(known[:, :-1], axis=0)
        found = np.linalg.lstsq(known[:, :-1] / scale, known[:, -1], rcond=None)[0] / scale
        root = complex(-z * w, w * math.sqrt(max(1.0 - z * z, 1e-6)))
        size = complex(found[-2], -found[-1]) * np.exp(root * late_s)
        t = self.motor.dt_s * np.arange(columns.shape[0])
        speed: Float = (size * (1 / root if self.inertial else root) * np.exp(root * t)).real
        return speed


def _eyes(window: Window, motor: _Motor) -> list[_Eye]:
    found = []
    for name, unit in SEEN_BY.items():
        values = getattr(window, name)
        if values is None:
            continue
        rows = motor.rows & np.isfinite(values)
        if np.count_nonzero(rows) >= max(LEAST_ROWS, 0.8 * np.count_nonzero(motor.rows)):
            seen, step = values[rows] / unit, resolution(values[np.isfinite(values)]) / unit
            own = max(noise_of(seen), step / math.sqrt(12.0), 1e-9)
            found.append(_Eye(motor, name, seen, rows, own))
    return found


def compliance(window: Window, parameters: Parameters) -> Compliance | None:
    """Return the spring that a window's sensors at the table show; None without any, or where none is surely seen.

    ``parameters`` are the drive's, for the torque: NaN where one is not known. The window's speed must be at its rows.
    """
    motor = _Motor.of(window)
    eyes = _eyes(window, motor) if motor is not None else []
    if motor is None or not eyes:
        return None
    start = _sought(eyes)
    if start is None:
        return None
    fit = _fitted(eyes, start)
    if fit is None:
        return None
    values, spread = fit
    w, z = math.exp(values[0]), math.exp(values[1])
    late_s = [float(late) for late in values[2:]]
    surest = min(range(len(eyes)), key=lambda k: eyes[k].inertial)
    swinging = eyes[surest].swinging(w, z, late_s[surest])
    share, share_std = _share(window, motor, parameters, eyes[surest].rows, swinging, w, z)
    late = {eye.name: late_s[k] for k, eye in enumerate(eyes)}
    return Compliance(*_told(w, z, share, spread[:2, :2], share_std), late)


def _sought(eyes: list[_Eye]) -> tuple[Float, Float] | None:
    """Return log w, log z and the delays about which the fit begins, and each eye's noise; None without evidence."""
    highest = min(BAND_HZ[1], HIGHEST / eyes[0].motor.dt_s)
    trials = np.geomspace(BAND_HZ[0], highest, TRIALS)
    late = [_late(eye) for eye in eyes]
    stiff = [eye.left(None, 0.0, at) for eye, at in zip(eyes, late, strict=True)]
    best: tuple[float, float, list[Float]] | None = None
    for hertz in trials:
        left = [eye.left(2 * math.pi * hertz, DAMPING[0], at) for eye, at in zip(eyes, late, strict=True)]
        cost = sum(e.size * math.log(float(e @ e)) for e in left)
        if best is None or cost < best[0]:
            best = cost, hertz, left
    assert best is not None
    rise = sum(_own(e) * math.log(float(s @ s) / float(e @ e)) for s, e in zip(stiff, best[2], strict=True))
    if rise < EVIDENCE:
        return None
    noise = np.array([math.sqrt(float(e @ e) / e.size) for e in best[2]])
    return np.array([math.log(2 * math.pi * best[1]), math.log(DAMPING[0]), *late]), noise


def _late(eye: _Eye) -> float:
    """Return by how much an eye is late, as a stiff screw would show it, s."""
    tried = np.linspace(-2.0, 4.0, 13) * 1e-3 if eye.inertial else np.zeros(1)
    powers = [float(np.square(eye.left(None, 0.0, at)).sum()) for at in tried]
    return float(tried[int(np.argmin(powers))])


def _own(left: Float) -> float:
    """Return how many rows of their own (m,) rows are worth that are alike from one to the next."""
    power = float(left @ left)
    alike = max(0.0, float(left[1:] @ left[:-1]) / power) if power else 0.0
    return left.size * (1.0 - alike) / (1.0 + alike)


def _fitted(eyes: list[_Eye], start: tuple[Float, Float]) -> tuple[Float, Float] | None:
    """Return log w, log z and the delays by least squares (Levenberg-Marquardt), with their covariance."""
    values, noise = start
    expected = np.array([values[0], math.log(DAMPING[0]), *values[2:]])
    weak = np.array([0.0, 1.0 / DAMPING[1], *([1.0 / LATE_STD_S] * len(eyes))])

    def left(x: Float) -> Float:
        w, z = math.exp(x[0]), min(math.exp(x[1]), 0.9)
        parts = [eye.left(w, z, x[2 + k]) / noise[k] for k, eye in enumerate(eyes)]
        return np.concatenate([*parts, (x - expected) * weak])

    rest, damped = left(values), 1e-3
    steps = np.array([1e-4, 1e-2, *([1e-5] * len(eyes))])
    slopes = _slopes(left, values, steps)
    for _ in range(STEPS):
        normal = slopes.T @ slopes
        move = -np.linalg.solve(normal + damped * np.diag(np.diag(normal)), slopes.T @ rest)
        trial = left(values + move)
        if trial @ trial < rest @ rest:
            values, rest, damped = values + move, trial, damped / 5
            slopes = _slopes(left, values, steps)
            if np.all(np.abs(move) < 0.01 * steps * 10):
                break
        else:
            damped *= 8
            if damped > 1e6:
                break
    sizes = [eye.seen.size for eye in eyes]
    spread = _spread(slopes, rest, sizes, round(CORRELATED_S / eyes[0].motor.dt_s))
    low, high = math.log(2 * math.pi * BAND_HZ[0]), math.log(2 * math.pi * BAND_HZ[1])
    if not (np.isfinite(spread).all() and low < values[0] < high and spread[0, 0] < LARGEST_STD**2):
        return None
    return values, spread


def _slopes(left: Callable[[Float], Float], x: Float, steps: Float) -> Float:
    """Return the derivatives (m, k) of ``left`` by differences."""
    columns = []
    for k, step in enumerate(steps):
        up, down = x.copy(), x.copy()
        up[k], down[k] = x[k] + step, x[k] - step
        columns.append((left(up) - left(down)) / (2 * step))
    return np.column_stack(columns)


def _spread(slopes: Float, rest: Float, sizes: list[int], reach: int) -> Float:
    """Return the covariance of least squares whose residuals are alike over ``reach`` rows (Newey and West 1987)."""
    bread = np.linalg.inv(slopes.T @ slopes)
    scores = slopes * rest[:, None]
    meat, at = np.zeros_like(bread), 0
    for size in sizes:
        part = scores[at : at + size]
        at += size
        meat += part.T @ part
        for lag in range(1, min(reach, size - 1)):
            both = part[lag:].T @ part[:-lag]
            meat += (1.0 - lag / reach) * (both + both.T)
    own = slopes[at:]  # what was expected counts with its own deviation
    return np.asarray(bread @ (meat + own.T @ own) @ bread)


def _share(
    window: Window, motor: _Motor, parameters: Parameters, rows: Bool, swinging: Float, w: float, z: float
) -> tuple[float, float]:
    """Return which share of the inertia swings with the table, and its standard deviation.

    The motor's momentum K int i is that of both masses, less what the table lags, less friction that is constant or
    goes with speed and angle: all smoothed to what the spring passes, and fitted while the table moves one way.
    ``swinging`` (m,) is the table's speed (mm/s) that is no answer to the motor, at its ``rows``.
    """
    dt, mm_per_rad, omega = motor.dt_s, window.pitch_mm / (2 * math.pi), motor.omega
    torque = (parameters.K if math.isfinite(parameters.K) else 1.0) * bridged(window.current_a)
    momentum = dt * (np.cumsum(torque) - 0.5 * (torque + torque[0]))
    rates = np.stack([1j * omega * (1.0 - answer(omega, w, z)), 1j * omega])
    lagging, speed = (motor.shown(rate)[rows] for rate in rates)
    speed = speed + (motor.line[-1] - motor.line[0]) / (motor.line.size - 1) / dt
    turns, t = motor.turns[rows], dt * np.arange(swinging.size)
    lagging, speed = (lagging - swinging) / mm_per_rad, speed / mm_per_rad
    raw = [momentum[rows], lagging, speed, turns, t, np.sin(turns), np.cos(turns)]
    corner = min(w / math.pi, 0.3 / dt)
    told = zero_phase(np.stack(raw), corner, dt)
    phi = np.column_stack([*told[1:], np.ones(t.size)])
    # the motor's own noise in the first two, which would make them look of less effect
    size = 2 * (omega.size - 1)
    passed = rates * gain(size, corner, dt) * np.sqrt(motor.noise) / mm_per_rad
    own = np.zeros((phi.shape[1], phi.shape[1]))
    own[:2, :2] = 2.0 * t.size / size * (passed @ passed.conj().T).real
    return _of_momentum(told[0], phi, own, round(CORRELATED_S / dt))


def _of_momentum(momentum: Float, phi: Float, own: Float, reach: int) -> tuple[float, float]:
    """Return the share by the columns of speed that lags and of speed, ``own`` (q, q) being what is their noise."""
    scale = np.linalg.norm(phi, axis=0)
    phi, own = phi / scale, own / np.outer(scale, scale)
    normal = phi.T @ phi
    own = own * min(1.0, 0.5 * normal[0, 0] / max(own[0, 0], 1e-12))
    found = np.linalg.solve(normal - own, phi.T @ momentum)
    spread = _spread(phi, phi @ found - momentum, [momentum.size], reach)
    values, spread = found / scale, spread / np.outer(scale, scale)
    share, std = -values[0] / values[1], math.sqrt(spread[0, 0]) / abs(values[1])
    weight, expected = 1.0 / std**2, 1.0 / SHARE[1] ** 2
    mean = (weight * share + expected * SHARE[0]) / (weight + expected)
    return min(max(mean, 0.05), 0.95), 1.0 / math.sqrt(weight + expected)


def _told(w: float, z: float, share: float, spread: Float, share_std: float) -> tuple[Float, Float]:
    """Return resonance, damping and share with the covariance (3, 3)."""
    free = 1.0 / math.sqrt(1.0 - share)
    hertz, damping = w * free / (2 * math.pi), z * free
    lever = np.diag([hertz, damping, 1.0])
    lever[:2, 2] = np.array([hertz, damping]) * 0.5 / (1.0 - share)
    whole = np.zeros((3, 3))
    whole[:2, :2], whole[2, 2] = spread, share_std**2
    return frozen([hertz, damping, share]), frozen(lever @ whole @ lever.T)


def joined(estimate: Estimate, found: Compliance) -> Estimate:
    """Return the estimate with the resonance that the table's sensors show; it replaces one from the motor's side."""
    kept = [k for k, name in enumerate(estimate.names) if name not in TERMS]
    size = len(kept)
    covariance = np.zeros((size + len(TERMS), size + len(TERMS)))
    covariance[:size, :size] = estimate.covariance[np.ix_(kept, kept)]
    covariance[size:, size:] = found.covariance
    systematic = estimate.systematic
    if systematic is not None:
        systematic = frozen(systematic[[k for k in kept if k < len(systematic)]])
    return replace(
        estimate,
        names=(*(estimate.names[k] for k in kept), *TERMS),
        values=frozen([*estimate.values[kept], *found.values]),
        covariance=frozen(covariance),
        systematic=systematic,
    )


def beside_the_config(found: Compliance, axis: Axis | None) -> list[Reason]:
    """Return the warning of a table that surely swings at another frequency than the configured one."""
    if axis is None or axis.resonance_hz is None:
        return []
    hertz, half = float(found.values[0]), INTERVAL_95 * math.sqrt(found.covariance[0, 0])
    if abs(hertz - axis.resonance_hz) <= max(half, SAME * hertz):
        return []
    text = f"the table swings at {hertz:.1f} ± {half:.1f} Hz, and the configuration says {axis.resonance_hz:g} Hz"
    return [Reason("ResonanceDiffers", text, "set resonance_hz of the axis to what its table does")]
