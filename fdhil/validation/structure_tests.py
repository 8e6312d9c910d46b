"""Tests whether the model has the drive's structure, by scores of the fitted model's innovations.

Each alternative (a load torque for a while, a sensor gain that steps, friction that rises at low speed, an offset, a
delay) moves the innovations in its own direction. Only findings that are both significant and large enough to matter
count. Whiteness over lags detects what no alternative describes.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fdhil.identification import LikelihoodFit, Motion, fill_forward
from fdhil.records import Float
from fdhil.validation.score_tests import Finding, ScoreTest

EDGES = 20  # instants at which a load may begin or end, or a gain may step
LEAST_TORQUE = 0.01  # of the peak torque
LEAST_GAIN = 0.01  # allowed difference of K between pooled windows
LEAST_OFFSET = 0.01  # of the signal's peak
STRIBECK_SPEEDS = (0.01, 0.03, 0.06, 0.12, 0.25)  # of the rapid speed
DEAD_TIME, OFFSET_CURRENT, FRICTION, WARMING = "dead_time", "current offset", "friction", "warming"
QUICKEST_PER_S = 0.035  # of the resistance: copper under 40 A/mm2 without cooling, 8.8 K/s
CHANCE = 3.0  # standard deviations
SATURATED = 0.02  # of the peak current, at which an inverter's dead time has its whole effect


def run_structure_tests(fit: LikelihoodFit) -> list[Finding]:
    """Return what the innovations of one window show beyond the model, the most significant first."""
    bench = ScoreTest.prepare(fit)
    rows = np.flatnonzero(np.abs(bench.motion.mode) == 1)
    if rows.size < 2 * EDGES:
        return []
    edges = np.unique(np.linspace(rows[0], rows[-1] + 1, EDGES + 1).astype(int))
    drift = np.clip((np.arange(bench.motion.n) - edges[0]) / max(1, edges[-1] - edges[0]), 0.0, 1.0)
    found = [
        _test_load_torque(bench, edges, drift),
        _test_low_speed_friction(bench),
        *_test_voltage_losses(bench, drift),
    ]
    gains, predicted = _build_steps_and_drift(edges[2:-2:2], drift), bench.predict_readings()
    for name, unit in (("voltage", "V"), ("current", "A"), ("speed", "rad/s")):
        tried = bench.find_best_alternative(bench.compute_gain_responses(predicted, name, gains))
        found += [
            _build_gain_finding(bench.motion.dt_s, name, edges[2:-2:2], tried),
            _test_signal_offset(bench, name, unit, drift),
        ]
    return sorted(found, key=lambda f: -abs(f.statistic))


def _build_steps_and_drift(edges: npt.NDArray[np.int_], drift: Float) -> Float:
    """Return courses (q + 1, n) that step from 0 to 1 at each of ``edges`` (q,), and last the ``drift`` (n,)."""
    return np.vstack([np.arange(drift.size) >= edges[:, None], drift])


def _test_load_torque(bench: ScoreTest, edges: npt.NDArray[np.int_], drift: Float) -> Finding:
    motion = bench.motion
    matrix = bench.compute_load_responses(_build_steps_and_drift(edges[:-1], drift))
    score, information = bench.compute_scores(matrix)
    gram = matrix.T @ matrix
    rising = bench.compute_statistics(score[-1:], information[-1:, -1], gram[-1:, -1])
    # a load from edge a to edge b is the step at a less the step at b; none begins at the last
    for part in (score, gram, information):
        part[-1] = 0.0
    gram[:, -1] = information[:, -1] = 0.0
    apart, whole = score[:, None] - score[None, :], _compute_squared_distances(gram)
    statistic, amplitude = bench.compute_statistics(apart, _compute_squared_distances(information), whole)
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
        f"a torque of {{:+.3g}} N.m other than friction {span}",
        "identify from moves without cutting, clamping or collision, or check current and position",
        LEAST_TORQUE * bench.peak_torque,
        *found,
        direction,
        torque,
    )


def _compute_squared_distances(gram: Float) -> Float:
    """Return the squared lengths (q, q) of the differences of vectors with this Gram matrix."""
    own = np.diag(gram)
    distances: Float = own[:, None] + own[None, :] - 2 * gram
    return distances


def _build_gain_finding(
    dt_s: float, name: str, edges: npt.NDArray[np.int_], tried: tuple[int, float, float, Float]
) -> Finding:
    k, statistic, amplitude, direction = tried
    drifts = k == edges.size
    at = "over the move" if drifts else f"at {edges[k] * dt_s:.3f} s of the window"
    text = f"the gain of {name} {'drifts' if drifts else 'changes'} by {{:+.2%}} {at}"
    # the correction of the signal is tried, so the sensor's own change has the opposite sign
    return Finding(
        "CalibrationSuspect",
        text,
        f"check the {name} sensor and its wiring",
        LEAST_GAIN,
        statistic,
        -amplitude,
        direction,
    )


def _test_signal_offset(bench: ScoreTest, name: str, unit: str, drift: Float) -> Finding:
    motion = bench.motion
    peak = float(np.abs(motion.voltage_mean if name == "voltage" else getattr(motion, name)).max())
    k, statistic, amplitude, direction = bench.find_best_alternative(
        bench.compute_offset_responses(name, np.vstack([np.ones(motion.n), drift]))
    )
    text = f"{name} has an offset of {{:+.3g}} {unit}" if k == 0 else f"the zero of {name} drifts by {{:+.3g}} {unit}"
    advice = f"set the zero of the {name} sensor at standstill"
    kind = OFFSET_CURRENT if name == "current" and k == 0 else ""
    return Finding("CalibrationSuspect", text, advice, LEAST_OFFSET * peak, statistic, -amplitude, direction, name=kind)


def _test_voltage_losses(bench: ScoreTest, drift: Float) -> list[Finding]:
    """Test losses between the recorded voltage and the winding: dead time, a bus that sags, a winding that warms.

    Of these voltages only a part reaches the motor, or is needed there: each is tried as what is missing.
    """
    motion = bench.motion
    current, volts = (
        fill_forward(motion.current),
        np.interp(*_locate_voltage_samples(motion), fill_forward(motion.voltage_mean)),
    )
    peak, most = float(np.abs(current).max()), float(np.abs(volts).max())
    power = np.maximum(volts * current, 0.0)
    tried = (
        (
            DEAD_TIME,
            np.clip(current / (SATURATED * peak), -1.0, 1.0),
            ("CalibrationSuspect", "{:+.3g} V are lost before the motor, whatever its current (dead time)"),
            "set voltage_source = 'command' if the recorded voltage is the drive's command",
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
            _, statistic, amplitude, direction = bench.find_best_alternative(
                bench.compute_offset_responses("voltage", course[None])
            )
            finding = Finding(code, text, advice, least, statistic, -amplitude, direction, name=name)
            found += [finding] if name != WARMING or _is_plausible_warming(finding, bench, drift) else []
    return found


def _is_plausible_warming(finding: Finding, bench: ScoreTest, drift: Float) -> bool:
    """Return whether a winding can have changed so: copper under a current warms, at a limited rate."""
    lasted_s = float(np.count_nonzero((drift > 0.0) & (drift < 1.0))) * bench.motion.dt_s
    most = QUICKEST_PER_S * lasted_s * float(bench.fit.theta[0])
    chance = CHANCE * abs(finding.amplitude / finding.statistic) if finding.statistic else 0.0
    return -chance <= finding.amplitude <= most + chance


def _locate_voltage_samples(motion: Motion) -> tuple[Float, Float]:
    rows = np.arange(motion.n, dtype=np.float64)
    return rows, motion.sample_at_voltage(rows) if motion.slow is not None else rows


def _test_low_speed_friction(bench: ScoreTest) -> Finding:
    motion = bench.motion
    top = float(np.abs(motion.speed).max())
    moving = np.where(np.abs(motion.mode) == 1, motion.mode, 0)
    loads = np.exp(-np.square(motion.speed / (top * np.array(STRIBECK_SPEEDS)[:, None]))) * moving
    k, statistic, amplitude, direction = bench.find_best_alternative(bench.compute_load_responses(loads))
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
