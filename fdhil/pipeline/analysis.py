"""Analyses one window: asks the checks of its signals, estimates, and asks the checks of the fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fdhil.config import Axis, Identification
from fdhil.identification.estimators import chosen, maximum_likelihood
from fdhil.identification.identifiability import empty_estimate
from fdhil.identification.without_voltage import told
from fdhil.records import Estimate, Reason, Result, Verdict, Window, WindowOutcome
from fdhil.validation import BEFORE_ANY_FIT, LEAST_ROWS, OF_THE_FIT, Evidence, Findings, ask

GAVE_UP = (np.linalg.LinAlgError, FloatingPointError, ZeroDivisionError, OverflowError)
UNFIT = "NotFinite"


def analyse(window: Window, settings: Identification, axis: Axis | None = None) -> WindowOutcome:
    """Return what one window says of the drive, and whether it is believed; never raises, whatever the data.

    ``axis`` is the axis' section where it is known.
    """
    signals = Evidence(window, settings, axis=axis)
    found = ask(BEFORE_ANY_FIT, signals, {})
    reasons = _listed(found)
    if window.n < LEAST_ROWS or any(reason.code == UNFIT for reason in reasons):
        return _outcome(replace(signals, estimate=_none(settings, Result.NOT_FINITE, reasons[0])), found)
    try:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            evidence = estimated(signals)
            return _outcome(evidence, ask(OF_THE_FIT, evidence, found))
    except GAVE_UP as error:
        reason = gave_up(error, "look at the window's signals")
        # what each sensor's own rows tell holds all the same
        found = ask(OF_THE_FIT[:1], signals, {**found, "solver": [reason]})
        return _outcome(replace(signals, estimate=_none(settings, Result.DIVERGED, reason)), found)


def estimated(signals: Evidence) -> Evidence:
    """Return the evidence with the estimate by the method asked for, and the fit that is judged.

    Without a voltage [2] alone is fitted, with the torque constant of the recording or of the axis: there is no fit
    of both equations.
    """
    window, settings, axis = signals.window, signals.settings, signals.axis
    if window.voltage_v is None and window.slow_voltage is None:
        known = {} if axis is None else {"R": axis.nominal.R, "L": axis.nominal.L, "K": axis.nominal.K}
        return replace(signals, estimate=told([window], signals.torque, known))
    name, estimator = chosen(settings)
    fit = maximum_likelihood.fit_windows([window], settings)
    if name == maximum_likelihood.NAME and fit is not None:
        return replace(signals, estimate=maximum_likelihood.finish(fit), fit=fit)
    return replace(signals, estimate=estimator([window], settings), fit=fit)


def gave_up(error: BaseException, advice: str) -> Reason:
    """Return the reason of a solver that ended with an error."""
    return Reason("SolverFailed", f"the solver gave up ({error})", advice)


def _none(settings: Identification, result: Result, reason: Reason) -> Estimate:
    return empty_estimate(chosen(settings)[0], result, reason)


def _listed(found: Findings) -> tuple[Reason, ...]:
    return tuple(reason for reasons in found.values() for reason in reasons)


def _outcome(evidence: Evidence, found: Findings) -> WindowOutcome:
    reasons = _listed(found)
    return WindowOutcome(evidence.window, evidence.estimate, Verdict(not reasons, evidence.fit_percent, reasons))
