"""Checks whether the current recorded with a slow voltage is late against the speed, by the gain in likelihood.

The delay of a slow voltage is one of the parameters. Current and speed come in the same rows: a current that a drive or
a recorder assigns to later ones shifts by whole rows, which a load along the ramps imitates badly.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from fdhil.identification.estimators import maximum_likelihood
from fdhil.identification.estimators.maximum_likelihood import Fit
from fdhil.identification.filtering import moving_mean
from fdhil.identification.innovations import innovations
from fdhil.identification.motion import Motion
from fdhil.identification.normal import inverse_of
from fdhil.identification.slow_voltage import innovations_of
from fdhil.records import Float, Reason, Window
from fdhil.validation.shifts import LARGEST, SMOOTHING_S
from fdhil.validation.significance import BUDGET
from fdhil.validation.timing import SEARCH

LEAST_GAIN = BUDGET["timing"].deviations ** 2
FIRST_SHARE = 0.1  # of the required gain that the score must show at first: it is too small for a long delay


def current_late(window: Window, fit: Fit, least_gain: float) -> Iterator[Reason]:
    """Yield a reason if the current is late by more than a row, and the window likelier so by ``least_gain``.

    ``fit`` is the window's; the gain is one of twice the log likelihood.
    """
    plain, last, rows = fit.problem.motions[0], fit, 0
    found, std = _shift(fit)
    if not (found / std) ** 2 > max(LEAST_GAIN, FIRST_SHARE * least_gain):
        return
    for _ in range(SEARCH):
        wanted = rows + _whole(found)
        if wanted == rows:
            break
        rows = wanted
        last = maximum_likelihood.fit([replace(plain, current=_earlier(plain.current, rows))], last.theta, last.free)
        if not (np.isfinite(last.residuals).all() and np.isfinite(last.information).all()):
            return
        found, _ = _shift(last)
    if abs(rows) > LARGEST and _cost(fit) - _cost(last) > max(LEAST_GAIN, least_gain):
        late_ms = 1e3 * window.dt_s * abs(rows)
        text = (
            f"current is {late_ms:.3g} ms {'late' if rows > 0 else 'early'} against speed and voltage, "
            f"more than a sample of {1e3 * window.dt_s:g} ms"
        )
        yield Reason("SampleTiming", text, "take voltage, current and speed from one SYNC, or enter the sensor's delay")


def _whole(rows: float) -> int:
    """Return the next whole row, away from zero: a score underestimates a long delay."""
    return int(np.sign(rows) * np.ceil(abs(rows) - 0.5))


def _earlier(current: Float, rows: int) -> Float:
    return current[np.clip(np.arange(current.size) + rows, 0, current.size - 1)]


def _shift(fit: Fit) -> tuple[float, float]:
    """Return the current's delay by the innovations, in rows, and its standard deviation."""
    motion: Motion = fit.problem.motions[0]
    width = 2 * round(SMOOTHING_S / 2 / motion.dt_s) + 1
    earlier = replace(motion, current=motion.current + np.gradient(moving_mean(motion.current, width)))
    gains, theta = fit.problem.filters[0], fit.theta
    answer = innovations(earlier, theta, gains) - innovations(motion, theta, gains)
    rest = answer - fit.jacobian @ (inverse_of(fit.information)[0] @ (fit.jacobian.T @ answer))
    power = float(rest @ rest)
    return (-float(rest @ fit.residuals) / power, power**-0.5) if power > 0.0 else (0.0, np.inf)


def _cost(fit: Fit) -> float:
    """Return minus twice the log likelihood, without its constant."""
    return innovations_of(
        fit.problem.motions[0], fit.theta, fit.problem.noises[0].vector() ** 2, float(fit.theta[6])
    ).cost
