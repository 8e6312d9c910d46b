"""Identifies a drive's own loops from its rapids: gains, feed-forward, filters, computing delay, structure.

The four gains every cascade has are fitted first. What else a drive may have joins one key at a time, the one that a
score test finds likeliest, as long as the test is sure and the key explains a tenth of the tolerance at the table. The
other structures of the table are tried against the cascade by the same measure. With full feed-forward and no filter, a
cascade answers the same when position_gain_per_s and speed_ki / speed_kp change places: of the two the one nearer to
where the fit began is told.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fdhil.config import Axis, Identification, Nominal, Regulators
from fdhil.identification import loop_fit
from fdhil.identification.loop_fit import DELAY, KEYS, Fit, Problem
from fdhil.identification.loop_replay import Rapid, fitting_periods, rapid_of, with_regulators
from fdhil.records import INTERVAL_95, PARAMETERS, Float, LoopEstimate, Parameters, Reason, Verdict, Window, frozen, rms

EXPLAINED_SHARE = 0.05  # of the following error, where the config has no tolerance
WORTH = 0.1  # of the tolerance: what a key must explain to join
SURE = 10.83  # chi square of one degree: one key in a thousand joins by chance
MOST_WINDOWS = 6
LOOSE = 0.25  # relative standard deviation above which a gain is not known
CASCADE = ("position_gain_per_s", "speed_feedforward", "speed_kp", "speed_ki")
PID = ("position_gain_per_s", "speed_feedforward", "speed_kp", "position_ki_per_s2")
OPTIONS = ("speed_filter_s", "setpoint_filter_s", DELAY, "torque_feedforward", "position_ki_per_s2")
# where the search begins without a configuration: corner of the speed loop, and by how much the outer loops are slower
CORNERS_HZ = (8.0, 16.0, 32.0, 64.0, 128.0)
SLOWER = (2.5, 5.0, 10.0)
CURRENT_CORNER_HZ = 400.0
NO_LIMIT = 1e5


@dataclass(frozen=True, slots=True)
class Difference:
    """One key of the regulators as configured and as found; ``apart`` where chance does not explain the difference."""

    key: str
    configured: float
    found: float
    std: float

    @property
    def apart(self) -> bool:
        """Whether the configured value lies outside the 95 % interval of what was found."""
        return abs(self.found - self.configured) > INTERVAL_95 * self.std


def identify_loops(
    windows: Sequence[Window], mechanics: Sequence[Parameters], axis: Axis | None, settings: Identification
) -> LoopEstimate | None:
    """Return the loops of the drive whose rapids these are; None where no window tells demand, position and current.

    ``mechanics`` are what each window's estimate says of the motor and what it moves, ``axis`` the machine's section:
    without it the search begins from the demand alone.
    """
    pairs = [(rapid, own) for w, own in zip(windows, mechanics, strict=True) if (rapid := rapid_of(w)) is not None]
    pairs = [(rapid, own) for rapid, own in pairs if all(np.isfinite(list(own.as_dict().values())))][-MOST_WINDOWS:]
    if not pairs:
        return None
    rapids, plants = tuple(r for r, _ in pairs), tuple(p for _, p in pairs)
    following = rms(np.concatenate([one.lag_mm[one.known] for one in rapids])) * 1e3
    tolerance = settings.tolerance_um or EXPLAINED_SHARE * following
    name = windows[0].axis
    found = _best(_problem(rapids, plants, axis, windows[0]), tolerance, axis is not None)
    return _told(name, _whole_delay(found), tolerance, following)


def _problem(rapids: tuple[Rapid, ...], plants: tuple[Parameters, ...], axis: Axis | None, window: Window) -> Problem:
    """Return where the search begins: at the configured regulators, or at what the demand alone says."""
    if axis is None:
        return _from_nothing(rapids, plants, window)
    axis = with_regulators(axis, **fitting_periods(axis.regulators, window.dt_s))
    return Problem(rapids, plants, axis, _names(axis.regulators))


def _names(regulators: Regulators) -> tuple[str, ...]:
    """Return the keys that a structure has, and the options that are configured."""
    base = PID if regulators.structure == "pid" else CASCADE
    if base == CASCADE and regulators.speed_ki == 0.0:
        base = CASCADE[:3]
    return (*base, *(n for n in OPTIONS if n not in base and getattr(regulators, n) > 0))


def _from_nothing(rapids: tuple[Rapid, ...], plants: tuple[Parameters, ...], window: Window) -> Problem:
    """Return the best of a coarse grid of cascades, judged by the longest rapid."""
    longest = int(np.argmax([np.ptp(one.demand_mm) for one in rapids]))
    best, least = None, math.inf
    for corner in CORNERS_HZ:
        for inner in SLOWER:
            for outer in SLOWER:
                trial = made_up_axis(window, plants[longest], corner, inner, outer, rapids[longest])
                problem = Problem((rapids[longest],), (plants[longest],), trial, CASCADE)
                left, _ = loop_fit.left_of(problem, problem.start())
                cost = float(np.log(loop_fit.scale_of(problem, left)).sum())
                if best is None or cost < least:
                    best, least = trial, cost
    assert best is not None
    return Problem(rapids, plants, best, CASCADE)


def made_up_axis(
    window: Window, plant: Parameters, corner_hz: float, inner: float, outer: float, rapid: Rapid
) -> Axis:
    """Return an axis as a drive of this kind has it: its loops from the corner of the speed loop, no limits."""
    corner = 2 * math.pi * corner_hz
    gain = corner / outer
    current = 2 * math.pi * CURRENT_CORNER_HZ
    kp = corner * plant.Jt / plant.K
    regulators = Regulators(
        position_gain_per_s=gain,
        speed_feedforward=_feedforward(rapid, gain),
        speed_kp=kp,
        speed_ki=kp * corner / inner,
        current_limit_a=NO_LIMIT,
        current_kp=current * plant.L,
        current_ki=current * plant.R,
        voltage_limit_v=NO_LIMIT,
    )
    speed_mm_s = window.rapid_speed_rad_s * window.pitch_mm / (2 * math.pi)
    nominal = Nominal(**{name: max(value, 0.0) for name, value in plant.as_dict().items()})
    axis = Axis(
        screw_pitch_mm=window.pitch_mm,
        rapid_speed_mm_s=speed_mm_s,
        max_acceleration_mm_s2=max(1.0, float(np.abs(np.diff(rapid.demand_mm, 2)).max()) / window.dt_s**2),
        nominal=nominal,
        regulators=regulators,
    )
    return with_regulators(axis, **fitting_periods(regulators, window.dt_s))


def _feedforward(rapid: Rapid, gain: float) -> float:
    """Return the share that is fed forward: at constant speed v the lag is v (1 - share) / Kv."""
    speed = np.gradient(rapid.demand_mm, rapid.dt_s)
    steady = np.abs(speed) > 0.95 * np.abs(speed).max()
    share = 1.0 - gain * float(np.median(rapid.lag_mm[steady] / speed[steady]))
    return float(np.clip(share, 0.0, 1.5))


def _best(problem: Problem, tolerance_um: float, configured: bool) -> Fit:
    """Return the best fit of all structures; another structure than that of the start must be worth it."""
    best = _grown(loop_fit.fit(problem), tolerance_um)
    if configured and best.unexplained_um > tolerance_um:  # the configuration may have led astray
        window_free = _grown(loop_fit.fit(_elsewhere(problem)), tolerance_um)
        best = min(best, window_free, key=lambda f: f.unexplained_um)
    if best.unexplained_um < WORTH * tolerance_um:
        return best
    other = _other_structure(best)
    if other is not None:
        rival = _grown(loop_fit.fit(other), tolerance_um)
        if best.unexplained_um - rival.unexplained_um > WORTH * tolerance_um:
            return rival
    return best


def _elsewhere(problem: Problem) -> Problem:
    """Return the problem begun from a grid about the demand, with what is configured of limits and cycles."""
    longest = int(np.argmax([np.ptp(one.demand_mm) for one in problem.rapids]))
    plant, rapid = problem.mechanics[longest], problem.rapids[longest]
    best, least = problem, math.inf
    for corner_hz in CORNERS_HZ:
        for inner in SLOWER:
            for outer in SLOWER:
                corner = 2 * math.pi * corner_hz
                kp = corner * plant.Jt / plant.K
                start = with_regulators(
                    problem.axis,
                    structure="p_pi_pi",
                    position_gain_per_s=corner / outer,
                    speed_feedforward=_feedforward(rapid, corner / outer),
                    speed_kp=kp,
                    speed_ki=kp * corner / inner,
                    position_ki_per_s2=0.0,
                )
                trial = replace(problem, axis=start, names=CASCADE)
                left, _ = loop_fit.left_of(trial, trial.start())
                cost = float(np.log(loop_fit.scale_of(trial, left)).sum())
                if cost < least:
                    best, least = trial, cost
    return best


def _grown(made: Fit, tolerance_um: float) -> Fit:
    """Let keys join as long as one is sure and worth it."""
    while True:
        name = _likeliest(made)
        if name is None:
            return made
        problem = made.problem
        wider = replace(problem, names=(*problem.names, name))
        k = problem.k
        start = np.concatenate([made.coordinates[:k], [KEYS[name].step], made.coordinates[k:]])
        grown = loop_fit.fit(wider, start)
        if made.unexplained_um - grown.unexplained_um < WORTH * tolerance_um:
            return made
        made = grown


def _likeliest(made: Fit) -> str | None:
    """Return the key whose absence the residuals show most surely; None where none is sure.

    Rao's score test, with the score's covariance of residuals that hang together.
    """
    problem = made.problem
    options = tuple(n for n in OPTIONS if n not in problem.names)
    if not options:
        return None
    k, m = problem.k, len(options)
    wider = replace(problem, names=(*problem.names, *options))
    at = np.concatenate([made.coordinates[:k], np.zeros(m), made.coordinates[k:]])
    information, score, meat = loop_fit.normal(replace(made, problem=wider, coordinates=at))
    information = information + np.diag(1.0 / wider.doubt() ** 2)
    own = np.array([j for j in range(at.size) if not k <= j < k + m])
    best, most = None, SURE
    for j, name in enumerate(options):
        away = np.zeros(at.size)
        away[k + j] = 1.0
        away[own] = -np.linalg.solve(information[np.ix_(own, own)], information[own, k + j])
        push, variance = float(away @ score), float(away @ meat @ away)
        sure = push * push / variance if variance > 0 else 0.0
        if push > 0 and sure > most:
            best, most = name, sure
    return best


def _other_structure(made: Fit) -> Problem | None:
    """Return the other law of the table, begun where it is nearest to this one: a cascade is a PID but for a filter."""
    problem = made.problem
    found = made.axis()
    g = found.regulators
    keep = tuple(n for n in problem.names if n in OPTIONS and n not in ("speed_filter_s", "position_ki_per_s2"))
    if g.structure == "pid":
        half = g.position_gain_per_s / 2
        rest = max(half * half - g.position_ki_per_s2, 0.0)
        outer = half - math.sqrt(rest)
        axis = with_regulators(
            found,
            structure="p_pi_pi",
            position_gain_per_s=outer,
            speed_ki=g.speed_kp * (half + math.sqrt(rest)),
            position_ki_per_s2=0.0,
        )
        return replace(problem, axis=axis, names=(*CASCADE, *keep))
    slow = g.speed_ki / g.speed_kp
    axis = with_regulators(
        found,
        structure="pid",
        position_gain_per_s=g.position_gain_per_s + slow,
        position_ki_per_s2=g.position_gain_per_s * slow,
        speed_ki=0.0,
        speed_filter_s=0.0,
    )
    return replace(problem, axis=axis, names=(*PID, *keep))


def _whole_delay(made: Fit) -> Fit:
    """Return the fit with a whole number of cycles as delay, the rest found anew."""
    problem = made.problem
    if DELAY not in problem.names:
        return made
    place = problem.names.index(DELAY)
    cycles = round(made.coordinates[place])
    axis = with_regulators(problem.axis, **{DELAY: cycles})
    fewer = replace(problem, axis=axis, names=tuple(n for n in problem.names if n != DELAY))
    again = loop_fit.fit(fewer, np.delete(made.coordinates, place))
    return replace(again, problem=replace(problem, axis=axis), coordinates=np.insert(again.coordinates, place, cycles))


def _told(name: str, made: Fit, tolerance_um: float, following_um: float) -> LoopEstimate:
    """Return the answer with its verdict."""
    problem = made.problem
    values = np.array([KEYS[n].value(float(c)) for n, c in zip(problem.names, made.coordinates, strict=False)])
    slope = np.array([v if KEYS[n].scale == 0.0 else KEYS[n].scale for n, v in zip(problem.names, values, strict=True)])
    covariance = loop_fit.covariance_of(made) * np.outer(slope, slope)
    structure = problem.axis.regulators.structure
    if structure != "pid":
        integral = dict(zip(problem.names, values, strict=True)).get("position_ki_per_s2", 0.0)
        structure = "double_pi" if integral > 0.0 else "p_pi_pi"
    left = made.unexplained_um
    reasons, warnings = [], []
    if not np.isfinite(left) or left > tolerance_um:
        reasons.append(
            Reason(
                "LoopsUnexplained",
                f"the best loops leave {left:.3g} um of a following error of {following_um:.3g} um, "
                f"more than {tolerance_um:.3g} um",
                "look at the drive's structure, its filters and its notch; raise identification.tolerance_um",
            )
        )
    for n, v, variance in zip(problem.names, values, np.diag(covariance), strict=True):
        if KEYS[n].scale == 0.0 and math.sqrt(variance) > LOOSE * v:
            text = f"{n} is known to {100 * math.sqrt(variance) / v:.0f} % only"
            warnings.append(Reason("LoopsUndetermined", text, "let the axis move faster, or with less feed-forward"))
    verdict = Verdict(not reasons, None, tuple(reasons), left, tuple(warnings))
    return LoopEstimate(name, structure, problem.names, frozen(values), frozen(covariance), verdict)


def with_loops(axis: Axis, loops: LoopEstimate) -> Axis:
    """Return the axis with the regulators that were identified in the place of the configured ones."""
    values: dict[str, object] = axis.regulators.model_dump()
    values |= {"structure": loops.structure} | dict(zip(loops.names, loops.values.tolist(), strict=True))
    if DELAY in loops.names:
        values[DELAY] = round(float(loops.values[loops.names.index(DELAY)]))
    if loops.structure == "pid":
        values |= {"speed_ki": 0.0, "speed_filter_s": 0.0}
    elif loops.structure == "p_pi_pi":
        values["position_ki_per_s2"] = 0.0
    return axis.model_copy(update={"regulators": Regulators.model_validate(values)})


def differences(axis: Axis, loops: LoopEstimate) -> list[Difference]:
    """Return every key that was identified beside its configured value."""
    spread = np.sqrt(np.diag(loops.covariance))
    return [
        Difference(name, float(getattr(axis.regulators, name)), float(value), float(std))
        for name, value, std in zip(loops.names, loops.values, spread, strict=True)
    ]
