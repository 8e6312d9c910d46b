"""Tests whether the model has the drive's structure, by scores of the fitted model's innovations.

Each alternative (a load torque for a while, a sensor gain that steps, friction that rises at low speed, an offset, a
delay) moves the innovations in its own direction. What of that direction the six parameters cannot imitate is compared
with the innovations: a statistic in standard deviations, and the alternative's amplitude in its own unit. Only what is
both beyond chance and large enough to matter refuses a window. Whiteness over lags catches what has no name.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from fdhil.identification.covariance import aliasing
from fdhil.identification.estimators.maximum_likelihood import Fit
from fdhil.identification.filtering import moving_mean
from fdhil.identification.innovations import CURRENT, LOAD, SPEED, VOLTAGE, answers, innovations
from fdhil.identification.motion import UNKNOWN, Motion
from fdhil.identification.normal import inverse_of
from fdhil.identification.slow_voltage import innovations_of
from fdhil.identification.windows import carried
from fdhil.records import Float, Reason
from fdhil.validation.significance import BUDGET

EDGES = 20  # instants at which a load may begin or end, or a gain may step
LEAST_TORQUE = 0.01  # of the peak torque
LEAST_GAIN = 0.01  # what pooled windows may differ in K
LEAST_OFFSET = 0.01  # of the signal's peak
IMITATED = 1e-6  # share of a direction below which only rounding is left of it
LAGS = 25
SLOPE_S = 0.005  # over which the acceleration is taken
_KINDS = {"current": CURRENT, "speed": SPEED}
STRIBECK_SPEEDS = (0.01, 0.03, 0.06, 0.12, 0.25)  # of the rapid speed
DEAD_TIME, OFFSET_CURRENT, FRICTION, WARMING = "dead_time", "current offset", "friction", "warming"
QUICKEST_PER_S = 0.035  # of the resistance: copper under 40 A/mm2 that gives no heat away, 8.8 K/s
CHANCE = 3.0  # standard deviations
SATURATED = 0.02  # of the peak current, at which an inverter's dead time has its whole effect


@dataclass(frozen=True, slots=True)
class Finding:
    """What one alternative shows: its class, how it reads, its statistic (standard deviations) and amplitude.

    ``least`` is the smallest amplitude that matters, in the amplitude's own unit. ``direction`` (m,) is how it moves
    the innovations, a unit of it, and ``load_nm`` (n,) the unit's torque, where it is one.
    """

    code: str
    text: str
    advice: str
    least: float
    statistic: float
    amplitude: float
    direction: Float
    load_nm: Float | None = None
    name: str = ""

    @property
    def sure(self) -> bool:
        """Return whether the finding is beyond chance."""
        return abs(self.statistic) > BUDGET["structure"].deviations

    @property
    def matters(self) -> bool:
        """Return whether the finding is beyond chance and large enough to matter."""
        return self.sure and abs(self.amplitude) > self.least

    def reason(self) -> Reason:
        """Return the finding as a reason."""
        told = self.text.format(self.amplitude)
        return Reason(self.code, f"{told} ({abs(self.statistic):.0f} standard deviations)", self.advice)


@dataclass(frozen=True, slots=True)
class Bench:
    """One fitted window on which alternatives are tried: how innovations answer, and what the parameters imitate."""

    fit: Fit
    inverse: Float
    basis: Float
    imitated: Float
    coloured: float = 1.0

    @classmethod
    def of(cls, fit: Fit) -> Bench:
        """Return the bench for a window's fit: ``basis`` (m, k + 1 + c) is jacobian, innovations and courses.

        ``imitated`` (k, 1 + c) is what the parameters make of the last two.
        """
        inverse = inverse_of(fit.information)[0]
        others = np.column_stack([fit.residuals, courses(fit)])
        coloured = 1.0 + 2.0 * max(0.0, expected_correlation(fit)[0])
        imitated = inverse @ (fit.jacobian.T @ others)
        return cls(fit, inverse, np.column_stack([fit.jacobian, others]), imitated, coloured)

    @property
    def motion(self) -> Motion:
        """The window."""
        return self.fit.problem.motions[0]

    @property
    def peak_torque(self) -> float:
        """Largest K |i| of the window, N.m."""
        return float(abs(self.fit.theta[2]) * np.abs(self.motion.current).max())

    def load_answers(self, loads: Float) -> Float:
        """Return minus the change (m, q) of the innovations under each of ``loads`` (q, n), N.m."""
        return self._answers(LOAD, loads, None)

    def gain_answers(self, name: str, courses: Float) -> Float:
        """Return minus the change (m, q) of innovations when the gain of ``name`` grows by ``courses`` (q, n)."""
        motion = self._foretold()
        if name == "voltage":
            at = np.array([motion.at_voltage(c) for c in courses])
            answers = self._answers(VOLTAGE, motion.voltage_mean * at, motion.voltage_rise * at)
        else:
            answers = self._answers(_KINDS[name], getattr(motion, name) * courses, None)
        # a drive that creeps to rest is no random walk, for which its speed is taken there: its innovations lean
        answers[: 2 * motion.n][np.repeat(motion.mode == UNKNOWN, 2)] = 0.0
        return answers

    def _foretold(self) -> Motion:
        """Return the motion with each reading as those before it foretell it: a gain acts on what is measured.

        A reading holds its own innovation. Of a gain that the parameters imitate, that alone would be left.
        """
        motion, fit = self.motion, self.fit
        if motion.slow is None:
            white, whiteners = fit.residuals.reshape(-1, 2), fit.problem.filters[0].whiteners
            safe = np.where(motion.observed[:, None], whiteners, 1.0)
            current = white[:, 0] / safe[:, 0]
            speed = (white[:, 1] - safe[:, 1] * current) / safe[:, 2]
            return replace(motion, current=motion.current - current, speed=motion.speed - speed)
        made = innovations_of(motion, fit.theta, fit.problem.noises[0].vector() ** 2, float(fit.theta[6])).values
        rows = made[: 2 * motion.n].reshape(-1, 2)
        return replace(
            motion,
            current=motion.current - rows[:, 0],
            speed=motion.speed - rows[:, 1],
            voltage_mean=motion.voltage_mean - made[2 * motion.n :],
        )

    def offset_answers(self, name: str, courses: Float) -> Float:
        """Return minus the change (m, q) of the innovations when ``courses`` (q, n) are added to signal ``name``."""
        motion = self.motion
        if name != "voltage":
            return self._answers(_KINDS[name], courses, None)
        at_samples = np.array([motion.at_voltage(c) for c in courses])
        return self._answers(VOLTAGE, at_samples, np.zeros_like(at_samples))

    def _answers(self, kind: int, courses: Float, rises: Float | None) -> Float:
        motion, theta, gains = self.motion, self.fit.theta, self.fit.problem.filters[0]
        if motion.slow is not None:
            return np.column_stack([self._slow_answer(kind, course) for course in courses])
        if rises is not None and theta[6] != 0.0:
            both = zip(courses, rises, strict=True)
            courses = np.array([replace(motion, voltage_mean=c, voltage_rise=r).delayed(theta[6]) for c, r in both])
        answered: Float = -answers(motion, theta, gains, kind, courses, rises)
        return answered

    def _slow_answer(self, kind: int, course: Float) -> Float:
        """Return minus the change (m,) of the innovations, a slow voltage's among them."""
        motion, theta, gains = self.motion, self.fit.theta, self.fit.problem.filters[0]
        if kind == VOLTAGE:
            motion = replace(motion, voltage_mean=motion.voltage_mean + course)
        elif kind == CURRENT:
            motion = replace(motion, current=motion.current + course)
        elif kind == SPEED:
            motion = replace(motion, speed=motion.speed + course)
        load = course if kind == LOAD else None
        change: Float = self.fit.residuals - innovations(motion, theta, gains, load)
        return change

    def scores(self, directions: Float) -> tuple[Float, Float, Float]:
        """Return score (q,) and course scores (q, c) of ``directions`` (m, q), and (k, q) their share in the jacobian.

        Scores are those beyond what the parameters imitate; the course's are what the voltage's unknown course within
        its samples may give.
        """
        seen = self.basis.T @ directions
        shared, beyond = np.split(seen, [len(self.inverse)])
        beyond = beyond - self.imitated.T @ shared
        return beyond[0], beyond[1:].T, shared

    def best(self, matrix: Float) -> tuple[int, float, float, Float]:
        """Return index, statistic, amplitude and (m,) of the column of ``matrix`` (m, q) with the largest statistic."""
        score, course, shared = self.scores(matrix)
        whole = np.einsum("mq,mq->q", matrix, matrix)
        weight = whole - np.einsum("kq,kq->q", shared, self.inverse @ shared)
        statistic, amplitude = self.tested(score, weight, whole, course)
        k = int(np.argmax(np.abs(statistic)))
        return k, float(statistic[k]), float(amplitude[k]), matrix[:, k]

    def tested(self, score: Float, weight: Float, whole: Float, course: Float) -> tuple[Float, Float]:
        """Return statistics and amplitudes; 0 where the parameters imitate all but rounding of ``whole``.

        The variance of a score is its ``weight``, more where innovations hang together, and the squares of what one
        standard deviation of each of the voltage's ``course`` (..., c) within the samples gives.
        """
        seen = weight > IMITATED * whole
        safe = np.where(seen, weight, 1.0)
        variance = self.coloured * safe + (course**2).sum(axis=-1)
        return np.where(seen, score / np.sqrt(variance), 0.0), np.where(seen, score / safe, 0.0)


def courses(fit: Fit) -> Float:
    """Return how the innovations (m, c) answer one standard deviation of what is not known between voltage samples.

    Interval means leave the course within a sample open. Instants, taken in step with a regulator that answers a rising
    back-EMF, are off in proportion to the acceleration too; what they are off in proportion to current and its slope,
    R and L imitate.
    """
    shape = fit.problem.course_effects(fit.theta)
    motion, theta = fit.problem.motions[0], fit.theta
    doubt = aliasing(motion.voltage_sampling, motion.voltage_period_s)[0]
    if doubt == 0.0:
        return shape
    rate = np.gradient(moving_mean(motion.speed, 2 * round(SLOPE_S / 2 / motion.dt_s) + 1), motion.dt_s)
    missed = doubt * theta[0] * theta[3] / theta[2] * rate
    if motion.slow is not None:
        moved = replace(motion, voltage_mean=motion.voltage_mean + motion.at_voltage(missed))
        return np.column_stack([shape, innovations(moved, theta, fit.problem.filters[0]) - fit.residuals])
    answer = answers(motion, theta, fit.problem.filters[0], VOLTAGE, missed[None], np.zeros((1, motion.n)))
    return np.column_stack([shape, answer])


def expected_correlation(fit: Fit) -> Float:
    """Return the autocorrelation (LAGS,) of the current's innovations that instants of a noisy voltage give.

    Two neighbouring intervals share the noise of the instant between them, which a filter for white noise does not
    know: with h the answer to one volt over one interval, noise of variance q gives q/2 (h h at one lag less and more).
    """
    motion, gains = fit.problem.motions[0], fit.problem.filters[0]
    known = np.flatnonzero(np.abs(motion.mode) == 1)
    if motion.voltage_sampling != "instant" or motion.slow is not None or known.size <= 3 * LAGS:
        return np.zeros(LAGS)
    row = int(known[known.size // 2])
    pulse = np.zeros(motion.n)
    # what the fit needs beyond the sensor's noise is the regulators' doing, and is not shared in that way
    pulse[row] = min(fit.problem.noises[0].voltage_v, motion.noise.voltage_v)
    answer = answers(motion, fit.theta, gains, VOLTAGE, pulse[None], np.zeros((1, motion.n)))
    h = np.zeros(3 * LAGS)
    part = answer.reshape(-1, 2)[row : row + h.size, 0]
    h[: part.size] = part
    powers = np.array([float(h[lag:] @ h[: h.size - lag]) for lag in range(LAGS + 2)])
    expected: Float = 0.5 * (powers[:-2] + powers[2:]) / (1.0 + powers[1])
    return expected


def findings(fit: Fit) -> list[Finding]:
    """Return what the fit of one window shows beyond the model, the most significant first."""
    bench = Bench.of(fit)
    rows = np.flatnonzero(np.abs(bench.motion.mode) == 1)
    if rows.size < 2 * EDGES:
        return []
    edges = np.unique(np.linspace(rows[0], rows[-1] + 1, EDGES + 1).astype(int))
    drift = np.clip((np.arange(bench.motion.n) - edges[0]) / max(1, edges[-1] - edges[0]), 0.0, 1.0)
    found = [_load(bench, edges, drift), _low_speed_friction(bench), *_of_the_voltage(bench, drift)]
    for name, unit in (("voltage", "V"), ("current", "A"), ("speed", "rad/s")):
        found += [_gain(bench, name, edges[2:-2:2], drift), _offset(bench, name, unit, drift)]
    return sorted(found, key=lambda f: -abs(f.statistic))


def _steps_and_drift(edges: npt.NDArray[np.int_], drift: Float) -> Float:
    """Return courses (q + 1, n) that step from 0 to 1 at each of ``edges`` (q,), and last the ``drift`` (n,)."""
    return np.vstack([np.arange(drift.size) >= edges[:, None], drift])


def _load(bench: Bench, edges: npt.NDArray[np.int_], drift: Float) -> Finding:
    """Try a constant torque between every two edges, and one that rises over the move."""
    motion = bench.motion
    matrix = bench.load_answers(_steps_and_drift(edges[:-1], drift))
    score, course, shared = bench.scores(matrix)
    gram = matrix.T @ matrix
    information = gram - shared.T @ bench.inverse @ shared
    rising = bench.tested(score[-1:], information[-1:, -1], gram[-1:, -1], course[-1:])
    # a load from edge a to edge b is the step at a less the step at b; none begins at the last
    for part in (score, course, gram, information):
        part[-1] = 0.0
    gram[:, -1] = information[:, -1] = 0.0
    apart, whole = score[:, None] - score[None, :], _apart(gram)
    statistic, amplitude = bench.tested(apart, _apart(information), whole, course[:, None] - course[None, :])
    a, b = np.unravel_index(int(np.argmax(np.abs(np.triu(statistic, 1)))), statistic.shape)
    span = f"acts from {edges[a] * motion.dt_s:.3f} to {edges[b] * motion.dt_s:.3f} s of the window"
    found = (float(statistic[a, b]), float(amplitude[a, b]))
    rows, direction = np.arange(motion.n), matrix[:, a] - (matrix[:, b] if b < edges.size - 1 else 0.0)
    torque = ((rows >= edges[a]) & (rows < edges[b])).astype(np.float64)
    if abs(rising[0][0]) > abs(found[0]):
        span, found = "rises over the move", (float(rising[0][0]), float(rising[1][0]))
        torque, direction = drift, matrix[:, -1]
    return Finding(
        "LoadDetected",
        f"a torque of {{:+.3g}} N.m that is no friction {span}",
        "identify from moves without cutting, clamping or collision",
        LEAST_TORQUE * bench.peak_torque,
        *found,
        direction,
        torque,
    )


def _apart(gram: Float) -> Float:
    """Return the squared lengths (q, q) of the differences of vectors with this Gram matrix."""
    own = np.diag(gram)
    distances: Float = own[:, None] + own[None, :] - 2 * gram
    return distances


def _gain(bench: Bench, name: str, edges: npt.NDArray[np.int_], drift: Float) -> Finding:
    """Try a gain that steps at one of ``edges`` and stays, and one that drifts."""
    k, statistic, amplitude, direction = bench.best(bench.gain_answers(name, _steps_and_drift(edges, drift)))
    drifts = k == edges.size
    at = "over the move" if drifts else f"at {edges[k] * bench.motion.dt_s:.3f} s of the window"
    text = f"the gain of {name} {'drifts' if drifts else 'changes'} by {{:+.2%}} {at}"
    # what is tried is the correction of the signal, so the sensor's own change has the other sign
    return Finding(
        "CalibrationSuspect",
        text,
        f"check the {name} sensor and its wiring",
        LEAST_GAIN,
        statistic,
        -amplitude,
        direction,
    )


def _offset(bench: Bench, name: str, unit: str, drift: Float) -> Finding:
    """Try an offset that is there throughout, and one that drifts from nothing on over the move."""
    motion = bench.motion
    peak = float(np.abs(motion.voltage_mean if name == "voltage" else getattr(motion, name)).max())
    k, statistic, amplitude, direction = bench.best(bench.offset_answers(name, np.vstack([np.ones(motion.n), drift])))
    text = f"{name} has an offset of {{:+.3g}} {unit}" if k == 0 else f"the zero of {name} drifts by {{:+.3g}} {unit}"
    advice = f"set the zero of the {name} sensor at standstill"
    kind = OFFSET_CURRENT if name == "current" and k == 0 else ""
    return Finding("CalibrationSuspect", text, advice, LEAST_OFFSET * peak, statistic, -amplitude, direction, name=kind)


def _of_the_voltage(bench: Bench, drift: Float) -> list[Finding]:
    """Try what else is between the recorded voltage and the winding: dead time, a bus that sags, a winding that warms.

    Of these voltages only a part reaches the motor, or is needed there: each is tried as what is missing.
    """
    motion = bench.motion
    current, volts = carried(motion.current), np.interp(*_places(motion), carried(motion.voltage_mean))
    peak, most = float(np.abs(current).max()), float(np.abs(volts).max())
    power = np.maximum(volts * current, 0.0)
    tried = (
        (
            DEAD_TIME,
            np.clip(current / (SATURATED * peak), -1.0, 1.0),
            ("CalibrationSuspect", "{:+.3g} V are lost before the motor, whatever its current (dead time)"),
            "set voltage_source = 'command' where the voltage is what the drive asks for",
            LEAST_OFFSET * most,
        ),
        (
            "bus_sag",
            volts * power / float(power.max()),
            ("CalibrationSuspect", "{:+.2%} of the voltage are lost at the largest power (the bus sags)"),
            "record the voltage at the motor, or map the bus voltage",
            LEAST_GAIN,
        ),
        (
            WARMING,
            drift * current,
            ("ParameterJump", "the resistance changes by {:+.3g} ohm over the move (the winding warms)"),
            "let the motor reach its temperature before identifying",
            LEAST_GAIN * float(bench.fit.theta[0]),
        ),
    )
    joined = {course.name for course in motion.courses}
    found = []
    for name, course, (code, text), advice, least in tried:
        if name not in joined:
            _, statistic, amplitude, direction = bench.best(bench.offset_answers("voltage", course[None]))
            finding = Finding(code, text, advice, least, statistic, -amplitude, direction, name=name)
            found += [finding] if name != WARMING or _warms(finding, bench, drift) else []
    return found


def _warms(finding: Finding, bench: Bench, drift: Float) -> bool:
    """Return whether a winding can have changed so: copper under a current warms, and no faster than it can."""
    lasted_s = float(np.count_nonzero((drift > 0.0) & (drift < 1.0))) * bench.motion.dt_s
    most = QUICKEST_PER_S * lasted_s * float(bench.fit.theta[0])
    chance = CHANCE * abs(finding.amplitude / finding.statistic) if finding.statistic else 0.0
    return -chance <= finding.amplitude <= most + chance


def _places(motion: Motion) -> tuple[Float, Float]:
    """Return the rows (n,), and those at which the samples (m,) of the voltage lie."""
    rows = np.arange(motion.n, dtype=np.float64)
    return rows, motion.at_voltage(rows) if motion.slow is not None else rows


def _low_speed_friction(bench: Bench) -> Finding:
    """Try friction that rises towards standstill, over several ranges of speed."""
    motion = bench.motion
    top = float(np.abs(motion.speed).max())
    moving = np.where(np.abs(motion.mode) == 1, motion.mode, 0)
    loads = np.exp(-np.square(motion.speed / (top * np.array(STRIBECK_SPEEDS)[:, None]))) * moving
    k, statistic, amplitude, direction = bench.best(bench.load_answers(loads))
    return Finding(
        "ValidationFailed",
        f"friction is {{:+.3g}} N.m higher below {STRIBECK_SPEEDS[k] * top:.3g} rad/s than above (Stribeck)",
        "lubricate the slide-way, or identify faster moves only",
        LEAST_TORQUE * bench.peak_torque,
        statistic,
        amplitude,
        direction,
        loads[k],
        FRICTION,
    )
