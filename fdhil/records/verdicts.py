"""Verdicts on a drive: estimates, and whether they are believed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Literal

import numpy as np

from fdhil.records.signals import Window
from fdhil.records.values import PARAMETERS, RATIOS, Float, Parameters


class Result(Enum):
    """How an estimation ended."""

    OK = "OK"
    UNDER_EXCITED = "UNDER_EXCITED"
    ILL_CONDITIONED = "ILL_CONDITIONED"
    DIVERGED = "DIVERGED"
    UNPHYSICAL = "UNPHYSICAL"
    NOT_FINITE = "NOT_FINITE"


@dataclass(frozen=True, slots=True)
class Reason:
    """Why something was refused or is not known: the class name of FAULTS, the figure that caused it, what to do."""

    code: str
    text: str
    advice: str = ""

    def __str__(self) -> str:
        return f"{self.code}: {self.text}"


@dataclass(frozen=True, slots=True)
class Estimate:
    """An estimator's answer: ``values`` (k,) and ``covariance`` (k, k) of ``names``; NaN where the data cannot tell.

    ``residuals`` maps "electrical" (V) and "mechanical" (A) to their residuals (m,), in standard deviations where the
    method is maximum likelihood. ``missing`` maps the names that are NaN to the reason. ``delay_s`` is the voltage
    delay that the data show, None when not estimated, and ``delay_std_s`` its standard deviation. ``systematic`` (k, q)
    is that part of the covariance, one standard deviation a column, which is the same in every window of a drive, None
    when not told. ``names`` are ``PARAMETERS``, then the terms that joined; what is ``given`` was not estimated: the
    data sheet or the recording tells it.
    """

    method: str
    names: tuple[str, ...]
    values: Float
    covariance: Float
    residuals: Mapping[str, Float]
    result: Result
    missing: Mapping[str, Reason] = field(default_factory=dict)
    delay_s: float | None = None
    delay_std_s: float | None = None
    systematic: Float | None = None
    given: tuple[str, ...] = ()

    def value(self, name: str) -> float:
        """Return one parameter's value (NaN when the data cannot tell it)."""
        return float(self.values[self.names.index(name)])

    def std(self, name: str) -> float:
        """Return one parameter's standard deviation."""
        k = self.names.index(name)
        return float(np.sqrt(self.covariance[k, k]))

    def parameters(self) -> Parameters:
        """Return the six parameters and the terms that joined; NaN stays NaN."""
        return Parameters.of({name: self.value(name) for name in (*PARAMETERS, *self.terms)})

    @property
    def terms(self) -> tuple[str, ...]:
        """The names of the terms that joined the six."""
        return tuple(name for name in self.names if name not in PARAMETERS and name not in RATIOS)


@dataclass(frozen=True, slots=True)
class Verdict:
    """The validation's answer for one window or pool.

    ``reasons`` refuse; ``warnings`` name what the model does not have, what that costs, and what to do.
    ``unexplained_um`` is the RMS at the table, through the closed loop, of what is left unexplained of the rapid's
    following error; None where the regulators are not known.
    """

    accepted: bool
    fit_percent: float | None
    reasons: tuple[Reason, ...] = ()
    unexplained_um: float | None = None
    warnings: tuple[Reason, ...] = ()


@dataclass(frozen=True, slots=True)
class AtTable:
    """What an encoder at the table tells of a move, um: its error against the demand, RMS and at most.

    ``unseen`` is the part of it that the drive's encoder does not see. ``left_rms_um`` is what is left of the error
    beside that which the window's own model predicts at the table, None where the regulators are not known.
    """

    error_rms_um: float
    error_max_um: float
    unseen_rms_um: float
    unseen_max_um: float
    left_rms_um: float | None = None


@dataclass(frozen=True, slots=True)
class WindowOutcome:
    """One window that was analysed: what was estimated, and whether it is believed; what the table's encoder tells."""

    window: Window
    estimate: Estimate | None
    verdict: Verdict
    at_table: AtTable | None = None


@dataclass(frozen=True, slots=True)
class ParameterSet:
    """A published revision of one axis' parameters: pooled from ``windows`` accepted windows.

    ``window_ticks`` are where they start, where that is known. ``unexplained_um`` and ``warnings`` are the verdict's.
    ``loops`` are the keys of ``[axis.X.regulators]`` by which the loops that it was validated with differ from the
    configured ones; None where that was not recorded.
    """

    axis: str
    revision: int
    parameters: Parameters
    covariance: Float
    windows: int
    tick: int
    temperature_c: float | None
    config_digest: str
    window_ticks: tuple[int, ...] = ()
    unexplained_um: float | None = None
    warnings: tuple[Reason, ...] = ()
    loops: Mapping[str, float | str] | None = None


@dataclass(frozen=True, slots=True)
class LoopEstimate:
    """The drive's own loops as rapids show them: ``values`` (k,) and ``covariance`` (k, k) of ``names``.

    ``names`` are keys of ``[axis.X.regulators]``, and ``structure`` is the one of the table that fits best. What the
    loops leave of the following error is the ``unexplained_um`` of the verdict; ``configured_um`` is what the
    configured ones leave, None where there are none.
    """

    axis: str
    structure: str
    names: tuple[str, ...]
    values: Float
    covariance: Float
    verdict: Verdict
    configured_um: float | None = None


@dataclass(frozen=True, slots=True)
class Notice:
    """Something an operator should know: a FAULTS class, its severity, cause, effect and next action."""

    code: str
    severity: Literal["info", "minor", "MAJOR"]
    text: str
    axis: str = ""
    tick: int = 0
