"""Lists the checks of a window: a literal table, asked from top to bottom over one record of evidence."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fdhil.identification.identifiability import unphysical, untold
from fdhil.records import Reason, Result
from fdhil.validation.agreement import values_apart
from fdhil.validation.evidence import LEAST_ROWS, Evidence
from fdhil.validation.interruptions import interruptions
from fdhil.validation.plausibility import clipped, gaps, missing_plateau, missing_stages, not_finite, position_parted
from fdhil.validation.rest import friction_at_rest, rest_faults
from fdhil.validation.signal_consistency import copied_signals, dead_signals, unrelated_signals
from fdhil.validation.simulation import expected_fit_percent
from fdhil.validation.slow_fitted import slow_faults_beside
from fdhil.validation.slow_readings import slow_voltage_faults
from fdhil.validation.slow_timing import current_late
from fdhil.validation.stuck import clipped_peaks, stuck_values
from fdhil.validation.timing import timing_faults, voltage_late
from fdhil.validation.without_voltage import load_comes_and_goes, torque_late, torque_unexplained

NEVER_NEGATIVE = ("dead_time",)
PLATEAU = "plateau"  # weighed where the rapid was run through the closed loop
SURE = 3.0  # standard deviations

Findings = dict[str, list[Reason]]
"""What each check that was asked found, in the order of the table."""


def _always(_: Evidence) -> bool:
    return True


def _enough_rows(evidence: Evidence) -> bool:
    return evidence.window.n >= LEAST_ROWS


def _is_rapid(evidence: Evidence) -> bool:
    return evidence.window.is_rapid


def _is_long_rapid(evidence: Evidence) -> bool:
    return _is_rapid(evidence) and _enough_rows(evidence)


def _has_voltage(evidence: Evidence) -> bool:
    return evidence.has_voltage


def _fitted(evidence: Evidence) -> bool:
    return evidence.fit is not None


def _sound(evidence: Evidence) -> bool:
    return evidence.sound


@dataclass(frozen=True, slots=True)
class Check:
    """One question: ``find`` is asked where the evidence has what it ``needs``.

    It is passed over where a check of ``unless`` has found something: that explains what this one would find. What it
    finds refuses the window, or, where it is ``weighed``, does so only if the model does not explain the rapid at the
    table, and is a warning else.
    """

    name: str
    find: Callable[[Evidence], Iterable[Reason]]
    needs: Callable[[Evidence], bool] = _always
    unless: Sequence[str] = ()
    weighed: bool = False


def _few_rows(evidence: Evidence) -> Iterator[Reason]:
    window, stages = evidence.window, evidence.window.stages
    if _enough_rows(evidence):
        return
    if stages.accelerate is not None and stages.brake is not None:
        text = f"{1 / window.dt_s:.4g} Hz is too slow: a whole rapid has {window.n} samples, fewer than {LEAST_ROWS}"
        yield Reason("LowExcitation", text, "record at 1000 Hz or faster")
    else:
        yield Reason("LowExcitation", f"{window.n} rows are no rapid move", "record a whole rapid")


def _play(evidence: Evidence) -> Iterator[Reason]:
    if evidence.play is not None:
        yield evidence.play.reason()


def _without_voltage(evidence: Evidence) -> bool:
    return not _has_voltage(evidence)


def _no_voltage(evidence: Evidence) -> Iterator[Reason]:
    """Yield a reason where a sensor should have told the voltage: what it tells of K is no data sheet's to replace."""
    sensed = evidence.axis is not None and evidence.axis.voltage.separate
    if sensed and not _has_voltage(evidence) and evidence.window.torque_constant_nm_per_a is None:
        yield Reason("SampleTiming", "the window has no voltage", "connect the voltage sensor")


def _estimate_faults(evidence: Evidence) -> Iterator[Reason]:
    """Yield why the estimate tells no drive: values left open, a fit that does not converge, unphysical values."""
    estimate, fit = evidence.estimate, evidence.fit
    assert estimate is not None
    missing = untold(estimate, slow=evidence.window.slow_voltage is not None or not _has_voltage(evidence))
    yield from missing
    open_end = bool(estimate.missing) and not missing and fit is not None and not fit.converged
    if open_end or estimate.result is Result.DIVERGED:
        yield Reason("SolverFailed", "the fit does not converge", "look at the window's signals")
    yield from unphysical(evidence.told or estimate, one_way=True)
    for name in estimate.terms:
        if name in NEVER_NEGATIVE and estimate.value(name) < -SURE * estimate.std(name):
            text = f"{name} = {estimate.value(name):.4g} would add voltage: voltage or current is off"
            yield Reason("CalibrationSuspect", text, "set the zeros of current and voltage sensor at standstill")


def _slips(evidence: Evidence) -> Iterator[Reason]:
    """Yield a reason where friction falls so much with speed that the axis sticks and slips, or may do so.

    It may where friction does rise towards rest, three deviations do not exclude that it slips, and the place where it
    rests is not told to the tolerance: neither by that friction, which no row tells at rest, nor by a replay.
    """
    estimate, weight, resting = evidence.estimate, evidence.weight, evidence.resting
    if estimate is None or "stribeck" not in estimate.names:
        return
    more, dry = estimate.value("stribeck"), abs(estimate.value("Cd"))
    torque_nm = estimate.value("K") * float(np.nanmax(np.abs(evidence.window.current_a)))
    least = max(dry, SLIPPING_SHARE * torque_nm)
    advice = "lubricate the slide-way, and look at its guides, first of all"
    text = f"higher than the dry friction of {dry:.3g} N.m: the axis"
    if more > least:
        yield Reason("ValidationFailed", f"friction at low speed is {more:.3g} N.m {text} slips", advice)
    elif weight is not None and resting is not None:
        beyond, um = SURE * resting.deviation_nm, SURE * resting.um
        told = weight.allows(um) or weight.allows(evidence.rests_off_um)
        if resting.deviation_nm < more <= least < more + beyond and not told:
            may = f"friction at low speed is {more:.3g} +- {beyond:.2g} N.m {text} may slip"
            limit = f"where it rests is told to {weight.told(um)}, limit {weight.told(weight.limit_um)}"
            yield Reason("ValidationFailed", f"{may}, and {limit}", advice)


def _no_fit(evidence: Evidence) -> Iterator[Reason]:
    if not _fitted(evidence):
        yield Reason("RankDeficient", "there is no fit to check", "record a whole rapid")


def _electrically_late(evidence: Evidence) -> Iterable[Reason]:
    return voltage_late(evidence) if evidence.electrically_late else ()


def _current_late(evidence: Evidence) -> Iterable[Reason]:
    if evidence.window.slow_voltage is None:
        return ()
    others = max((finding.statistic**2 for finding in evidence.findings), default=0.0)
    return current_late(evidence.window, evidence.on_time, others)


def _structure(evidence: Evidence) -> Iterator[Reason]:
    """Yield what the model lacks, each with its cost."""
    for lack in evidence.lacks:
        if lack.finding.matters:
            yield evidence.with_cost(lack.finding.reason(), evidence.cost_um(lack))


def _whiteness(evidence: Evidence) -> Iterable[Reason]:
    return [reason for _, reason in evidence.colour]


def _excess_noise(evidence: Evidence) -> Iterable[Reason]:
    return [reason for _, reason in evidence.excess]


def _late(evidence: Evidence) -> Iterable[Reason]:
    if evidence.late_s:  # by what else the model lacks, where there is such
        return voltage_late(evidence) if not evidence.lacks else ()
    return timing_faults(evidence) if _sound(evidence) else ()


def _simulation(evidence: Evidence) -> Iterator[Reason]:
    """Yield a reason where the model follows the speed worse than a right one would."""
    reached, least = evidence.fit_percent, expected_fit_percent(evidence.window, evidence.judged)
    if reached is not None and not reached >= least:
        text = f"the model simulated from the measured voltage follows the speed by {reached:.2f} %, not {least:.2f} %"
        yield Reason("ValidationFailed", text, "the drive does what the model does not have")


def _values(evidence: Evidence) -> Iterable[Reason]:
    assert evidence.estimate is not None
    return values_apart(evidence.estimate, evidence.judged.theta[:6])


SLIPPING_SHARE = 0.1  # of the largest torque of the move: less than this more friction at low speed does little
MODEL = (
    "estimate",
    "fit",
    "late voltage",
    "late current",
    "structure",
    "whiteness",
    "excess noise",
    "standstill",
    "friction at rest",
)
BEFORE_ANY_FIT: Sequence[Check] = (
    Check("finite", not_finite),
    Check("stages", missing_stages, _is_rapid),
    Check(PLATEAU, missing_plateau, _is_rapid),
    Check("gaps", gaps, _enough_rows, ("finite",)),
    Check("range", clipped, _enough_rows, ("finite",)),
    Check("dead signal", dead_signals, _enough_rows, ("finite",)),
    Check("copied signal", copied_signals, _enough_rows, ("finite",)),
    Check("unrelated signal", unrelated_signals, _is_long_rapid, ("finite", "dead signal")),
    Check("position", position_parted, _enough_rows, ("finite",)),
    # what position tells of the move's course is worth nothing where it contradicts the speed
    Check("whole move", interruptions, _is_long_rapid, ("finite", "position")),
    Check("play", _play, _enough_rows, ("finite",)),
    Check("slow readings", slow_voltage_faults),
    Check("voltage", _no_voltage),
    Check("rows", _few_rows, unless=("finite", "stages", PLATEAU, "slow readings", "voltage")),
)
OF_THE_FIT: Sequence[Check] = (
    Check("stuck", stuck_values),
    Check("cut off", clipped_peaks, _fitted),
    Check("late torque", torque_late, _without_voltage),
    Check("load", load_comes_and_goes, _without_voltage, ("late torque",)),
    Check("torque", torque_unexplained, _without_voltage, ("late torque", "load")),
    Check("estimate", _estimate_faults, unless=("late torque", "load", "torque")),
    Check("slips", _slips),
    Check("fit", _no_fit, _has_voltage, ("estimate",)),
    Check("late voltage", _electrically_late, _fitted),
    Check("late current", _current_late, _sound, ("late voltage",)),
    Check("structure", _structure, _sound, ("late voltage", "late current"), weighed=True),
    Check("whiteness", _whiteness, _sound, ("late voltage", "late current", "structure"), weighed=True),
    Check("excess noise", _excess_noise, _sound, ("late voltage", "late current", "structure"), weighed=True),
    # a late current seems to move a shaft at rest
    Check("standstill", rest_faults, _sound, ("late voltage", "late current")),
    Check("friction at rest", friction_at_rest, _sound, ("late voltage", "late current"), weighed=True),
    Check("delay", _late, _fitted, ("late voltage", "late current", "standstill")),
    Check("simulation", _simulation, _fitted, (*MODEL, "delay"), weighed=True),
    Check("values", _values, _fitted, (*MODEL, "delay")),
    Check("slow sensor", slow_faults_beside, _fitted, ("range", "slow readings")),
)


WEIGHED = frozenset(check.name for check in (*BEFORE_ANY_FIT, *OF_THE_FIT) if check.weighed)


def ask(checks: Sequence[Check], evidence: Evidence, found: Findings) -> Findings:
    """Return what was ``found`` before, and what these checks find."""
    for check in checks:
        if not any(found.get(other) for other in check.unless) and check.needs(evidence):
            found = {**found, check.name: list(check.find(evidence))}
    return found
