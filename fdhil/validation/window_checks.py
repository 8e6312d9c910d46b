"""Lists the checks of a window as two literal tables, run from top to bottom: of its signals, and of its fit."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from fdhil.identification import find_unphysical_values, list_missing_reasons
from fdhil.records import Reason, Result
from fdhil.validation.estimate_agreement import find_deviating_values
from fdhil.validation.interrupted_moves import find_interruptions
from fdhil.validation.open_loop_simulation import compute_expected_fit_percent
from fdhil.validation.signal_consistency import find_constant_signals, find_copied_signals, find_unrelated_signals
from fdhil.validation.signal_plausibility import (
    check_plateau,
    compare_position_with_speed,
    find_clipped_signals,
    find_gaps,
    find_invalid_values,
    find_missing_stages,
)
from fdhil.validation.slow_voltage_checks import (
    check_slow_current_delay,
    check_slow_voltage_fit,
    check_slow_voltage_readings,
)
from fdhil.validation.standstill_checks import check_sensor_offsets, check_standstill_friction
from fdhil.validation.stuck_signal import find_clipped_peaks, find_stuck_sensors
from fdhil.validation.table_assessment import TableAssessment
from fdhil.validation.timing_checks import check_fitted_delay, check_signal_delays
from fdhil.validation.torque_checks import check_torque_delay, check_unexplained_torque, detect_intermittent_load
from fdhil.validation.window_signals import LEAST_SAMPLES, WindowSignals

NEVER_NEGATIVE = ("dead_time",)
PLATEAU = "plateau"  # assessed at the table where the rapid was run through the closed loop
SURE = 3.0  # standard deviations
SLIPPING_SHARE = 0.1  # of the largest torque of the move: less additional friction at low speed has little effect

Stage = TypeVar("Stage", WindowSignals, TableAssessment)
Findings = dict[str, list[Reason]]
"""What each check that was run found, in the order of the table."""


@dataclass(frozen=True, slots=True)
class Check(Generic[Stage]):
    """One check: ``find`` is run if the window has what it ``needs`` (None: it always has).

    It is skipped if a check listed in ``unless`` has found something: that explains what this one would find. A finding
    refuses the window; if ``weighed``, only where the model does not explain the rapid at the table, else it warns.
    """

    name: str
    find: Callable[[Stage], Iterable[Reason]]
    needs: Callable[[Stage], bool] | None = None
    unless: Sequence[str] = ()
    weighed: bool = False


def run_checks(checks: Sequence[Check[Stage]], stage: Stage, found: Findings) -> Findings:
    """Return what was ``found`` before, and what these checks find."""
    for check in checks:
        if not any(found.get(other) for other in check.unless) and (check.needs is None or check.needs(stage)):
            found = {**found, check.name: list(check.find(stage))}
    return found


def _has_enough_samples(signals: WindowSignals) -> bool:
    return signals.window.n >= LEAST_SAMPLES


def _is_rapid(signals: WindowSignals) -> bool:
    return signals.window.is_rapid


def _is_long_rapid(signals: WindowSignals) -> bool:
    return _is_rapid(signals) and _has_enough_samples(signals)


def _check_sample_count(signals: WindowSignals) -> Iterator[Reason]:
    window, stages = signals.window, signals.window.stages
    if _has_enough_samples(signals):
        return
    if stages.accelerate is not None and stages.brake is not None:
        rate = f"{1 / window.dt_s:.4g} Hz is too slow"
        text = f"{rate}: a whole rapid has {window.n} samples, fewer than {LEAST_SAMPLES}"
        yield Reason("LowExcitation", text, "record at 1000 Hz or faster")
    else:
        yield Reason("LowExcitation", f"{window.n} samples are too few for a rapid move", "record a whole rapid")


def _check_backlash(signals: WindowSignals) -> list[Reason]:
    return [] if signals.backlash is None else [signals.backlash.build_reason()]


def _check_voltage_recorded(signals: WindowSignals) -> Iterator[Reason]:
    """Yield a reason where a sensor should have measured the voltage: no data sheet replaces what it shows of K."""
    has_sensor = signals.axis is not None and signals.axis.voltage.is_separate
    if has_sensor and not signals.has_voltage and signals.window.torque_constant_nm_per_a is None:
        yield Reason("SampleTiming", "the window has no voltage", "connect the voltage sensor")


def _has_fit(table: TableAssessment) -> bool:
    return table.fitted.fit is not None


def _has_sound_fit(table: TableAssessment) -> bool:
    return table.fitted.has_sound_fit


def _check_torque_delay(table: TableAssessment) -> Iterable[Reason]:
    torque = table.fitted.torque
    return () if torque is None else check_torque_delay(torque, table.fitted.window.dt_s)


def _check_intermittent_load(table: TableAssessment) -> Iterable[Reason]:
    torque = table.fitted.torque
    return () if torque is None else detect_intermittent_load(torque, table.signals)


def _check_unexplained_torque(table: TableAssessment) -> Iterable[Reason]:
    torque = table.fitted.torque
    return () if torque is None else check_unexplained_torque(torque)


def _check_estimate(table: TableAssessment) -> Iterator[Reason]:
    """Yield why the estimate is no drive: undetermined values, a fit that does not converge, unphysical values."""
    fitted, signals = table.fitted, table.signals
    estimate = fitted.estimate
    assert estimate is not None
    missing = list_missing_reasons(estimate, slow=signals.window.slow_voltage is not None or not signals.has_voltage)
    yield from missing
    unconverged = bool(estimate.missing) and not missing and fitted.fit is not None and not fitted.fit.converged
    if unconverged or estimate.result is Result.DIVERGED:
        yield Reason("SolverFailed", "the fit does not converge", "inspect the window's signals")
    yield from find_unphysical_values(fitted.widened_estimate or estimate, one_way=True)
    for name in estimate.terms:
        if name in NEVER_NEGATIVE and estimate.get_value(name) < -SURE * estimate.get_std(name):
            text = f"{name} = {estimate.get_value(name):.4g} would add voltage: voltage or current has an offset"
            yield Reason("CalibrationSuspect", text, "set the zeros of current and voltage sensor at standstill")


def _check_stick_slip(table: TableAssessment) -> Iterator[Reason]:
    """Yield a reason where friction falls so much with speed that the axis sticks and slips, or may do so.

    It may where friction rises towards standstill, three deviations do not exclude that it slips, and the position at
    rest is not known to the tolerance: neither by that friction, which is not observable at rest, nor by a replay.
    """
    estimate, budget, resting = table.fitted.estimate, table.budget, table.rest_position
    if estimate is None or "stribeck" not in estimate.names:
        return
    more, dry = estimate.get_value("stribeck"), abs(estimate.get_value("Cd"))
    torque_nm = estimate.get_value("K") * float(np.nanmax(np.abs(table.fitted.window.current_a)))
    least = max(dry, SLIPPING_SHARE * torque_nm)
    advice = "lubricate the slide-way and inspect its guides first"
    text = f"higher than the dry friction of {dry:.3g} N.m: the axis"
    if more > least:
        yield Reason("ValidationFailed", f"friction at low speed is {more:.3g} N.m {text} slips", advice)
    elif budget is not None and resting is not None:
        beyond, um = SURE * resting.deviation_nm, SURE * resting.um
        known = budget.is_within_limit(um) or budget.is_within_limit(table.rest_position_error_um)
        if resting.deviation_nm < more <= least < more + beyond and not known:
            may = f"friction at low speed is {more:.3g} +- {beyond:.2g} N.m {text} may slip"
            known_to = f"its position at rest is known to {budget.format_error(um)}"
            limit = f"limit {budget.format_error(budget.limit_um)}"
            yield Reason("ValidationFailed", f"{may}, and {known_to}, {limit}", advice)


def _check_fit_exists(table: TableAssessment) -> Iterator[Reason]:
    if not _has_fit(table):
        yield Reason("RankDeficient", "there is no fit to check", "record a whole rapid")


def _check_electrical_delay(table: TableAssessment) -> Iterable[Reason]:
    return check_fitted_delay(table.fitted) if table.fitted.is_electrically_delayed else ()


def _check_current_delay(table: TableAssessment) -> Iterable[Reason]:
    fitted = table.fitted
    if fitted.window.slow_voltage is None:
        return ()
    others = max((finding.statistic**2 for finding in fitted.findings), default=0.0)
    return check_slow_current_delay(fitted.window, fitted.aligned_fit, others)


def _check_structure(table: TableAssessment) -> Iterator[Reason]:
    """Yield what the model lacks, each with its cost at the table."""
    for lack in table.fitted.deficiencies:
        if lack.finding.is_relevant:
            yield table.append_cost(lack.finding.build_reason(), table.compute_cost_um(lack))


def _check_whiteness(table: TableAssessment) -> Iterable[Reason]:
    return [reason for _, reason in table.fitted.autocorrelation]


def _check_excess_noise(table: TableAssessment) -> Iterable[Reason]:
    return [reason for _, reason in table.fitted.excess_noise]


def _check_voltage_delay(table: TableAssessment) -> Iterable[Reason]:
    fitted = table.fitted
    if fitted.voltage_delay_s:  # a deficiency explains it, where there is one
        return check_fitted_delay(fitted) if not fitted.deficiencies else ()
    return check_signal_delays(fitted) if fitted.has_sound_fit else ()


def _check_simulated_speed(table: TableAssessment) -> Iterator[Reason]:
    """Yield a reason where the model follows the speed worse than a correct one would."""
    fitted = table.fitted
    reached, least = fitted.fit_percent, compute_expected_fit_percent(fitted.window, fitted.required_fit)
    if reached is not None and not reached >= least:
        text = f"the model simulated from the measured voltage follows the speed by {reached:.2f} %, not {least:.2f} %"
        yield Reason("ValidationFailed", text, "the drive has an effect that the model lacks")


def _check_values(table: TableAssessment) -> Iterable[Reason]:
    assert table.fitted.estimate is not None
    return find_deviating_values(table.fitted.estimate, table.fitted.required_fit.theta[:6])


DELAYS = ("late voltage", "late current")
MODEL = ("estimate", "fit", *DELAYS, "structure", "whiteness", "excess noise", "standstill", "friction at rest")
SIGNAL_CHECKS: Sequence[Check[WindowSignals]] = (
    Check("finite", find_invalid_values),
    Check("stages", lambda signals: find_missing_stages(signals.window), _is_rapid),
    Check(PLATEAU, lambda signals: check_plateau(signals.window), _is_rapid),
    Check("gaps", find_gaps, _has_enough_samples, ("finite",)),
    Check("range", find_clipped_signals, _has_enough_samples, ("finite",)),
    Check("dead signal", find_constant_signals, _has_enough_samples, ("finite",)),
    Check("copied signal", find_copied_signals, _has_enough_samples, ("finite",)),
    Check("unrelated signal", find_unrelated_signals, _is_long_rapid, ("finite", "dead signal")),
    Check("position", compare_position_with_speed, _has_enough_samples, ("finite",)),
    # a position that contradicts the speed says nothing about the course of the move
    Check("whole move", find_interruptions, _is_long_rapid, ("finite", "position")),
    Check("play", _check_backlash, _has_enough_samples, ("finite",)),
    Check("slow readings", lambda signals: check_slow_voltage_readings(signals.window)),
    Check("voltage", _check_voltage_recorded),
    Check("rows", _check_sample_count, unless=("finite", "stages", PLATEAU, "slow readings", "voltage")),
)
STUCK_SENSOR: Check[TableAssessment] = Check("stuck", lambda table: find_stuck_sensors(table.fitted))
FIT_CHECKS: Sequence[Check[TableAssessment]] = (
    STUCK_SENSOR,
    Check("cut off", lambda table: find_clipped_peaks(table.fitted), _has_fit),
    Check("late torque", _check_torque_delay),
    Check("load", _check_intermittent_load, unless=("late torque",)),
    Check("torque", _check_unexplained_torque, unless=("late torque", "load")),
    Check("estimate", _check_estimate, unless=("late torque", "load", "torque")),
    Check("slips", _check_stick_slip),
    Check("fit", _check_fit_exists, lambda table: table.signals.has_voltage, ("estimate",)),
    Check("late voltage", _check_electrical_delay, _has_fit),
    Check("late current", _check_current_delay, _has_sound_fit, ("late voltage",)),
    Check("structure", _check_structure, _has_sound_fit, DELAYS, weighed=True),
    Check("whiteness", _check_whiteness, _has_sound_fit, (*DELAYS, "structure"), weighed=True),
    Check("excess noise", _check_excess_noise, _has_sound_fit, (*DELAYS, "structure"), weighed=True),
    # a late current looks like a shaft that moves at rest
    Check("standstill", lambda table: check_sensor_offsets(table.fitted), _has_sound_fit, DELAYS),
    Check("friction at rest", check_standstill_friction, _has_sound_fit, DELAYS, weighed=True),
    Check("delay", _check_voltage_delay, _has_fit, (*DELAYS, "standstill")),
    Check("simulation", _check_simulated_speed, _has_fit, (*MODEL, "delay"), weighed=True),
    Check("values", _check_values, _has_fit, (*MODEL, "delay")),
    Check("slow sensor", lambda table: check_slow_voltage_fit(table.fitted), _has_fit, ("range", "slow readings")),
)
WEIGHED = frozenset(check.name for check in FIT_CHECKS if check.weighed)
