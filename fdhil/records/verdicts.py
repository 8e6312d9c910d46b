"""Records of estimates, verdicts and notices."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Literal

import numpy as np

from fdhil.records.physical_parameters import PARAMETERS, RATIOS, Float, Parameters
from fdhil.records.signal_records import Window


class Result(Enum):
    """Outcome of an estimation."""

    OK = "OK"
    UNDER_EXCITED = "UNDER_EXCITED"
    ILL_CONDITIONED = "ILL_CONDITIONED"
    DIVERGED = "DIVERGED"
    UNPHYSICAL = "UNPHYSICAL"
    NOT_FINITE = "NOT_FINITE"


@dataclass(frozen=True, slots=True)
class Reason:
    """Why something was refused or is unknown: the class name of FAULTS, the figure behind it, the next action."""

    code: str
    text: str
    advice: str = ""

    def __str__(self) -> str:
        return f"{self.code}: {self.text}"


@dataclass(frozen=True, slots=True)
class Estimate:
    """Result of an estimator: ``values`` (k,) and ``covariance`` (k, k) of ``names``; NaN where not identifiable.

    ``residuals`` maps "electrical" (V) and "mechanical" (A) to their residuals (m,), in standard deviations where the
    method is maximum likelihood. ``missing`` maps names that are NaN to the reason. ``measure_delay_s`` is the voltage
    delay
    that the data show, None when not estimated, and ``delay_std_s`` its standard deviation. ``systematic`` (k, q) is
    the part of the covariance that all windows of a drive share, one standard deviation a column, None when
    unavailable. ``names`` are ``PARAMETERS``, then the added terms; ``given`` names were not estimated but taken from
    the data sheet or the recording.
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

    def get_value(self, name: str) -> float:
        """Return one parameter's value, NaN when it is not identifiable."""
        return float(self.values[self.names.index(name)])

    def get_std(self, name: str) -> float:
        """Return one parameter's standard deviation."""
        k = self.names.index(name)
        return float(np.sqrt(self.covariance[k, k]))

    def build_parameters(self) -> Parameters:
        """Return the six parameters and the added terms; NaN stays NaN."""
        return Parameters.from_mapping({name: self.get_value(name) for name in (*PARAMETERS, *self.terms)})

    @property
    def terms(self) -> tuple[str, ...]:
        """The names of the terms beyond the six parameters."""
        return tuple(name for name in self.names if name not in PARAMETERS and name not in RATIOS)


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of the validation of one window or pool.

    ``reasons`` refuse; ``warnings`` name what the model lacks, what that costs, and what to do. ``unexplained_um`` is
    the RMS at the table, through the closed loop, of the unexplained part of the rapid's following error; None where
    the regulators are unknown.
    """

    accepted: bool
    fit_percent: float | None
    reasons: tuple[Reason, ...] = ()
    unexplained_um: float | None = None
    warnings: tuple[Reason, ...] = ()


@dataclass(frozen=True, slots=True)
class AtTable:
    """What an encoder at the table measures of a move, um: its error against the demand, RMS and maximum.

    ``unseen`` is the part that the drive's encoder does not see. ``left_rms_um`` is the residual after subtracting what
    the window's own model predicts at the table, None where the regulators are unknown.
    """

    error_rms_um: float
    error_max_um: float
    unseen_rms_um: float
    unseen_max_um: float
    left_rms_um: float | None = None


@dataclass(frozen=True, slots=True)
class WindowOutcome:
    """One analysed window: its estimate, its verdict, and the error measured at the table."""

    window: Window
    estimate: Estimate | None
    verdict: Verdict
    at_table: AtTable | None = None


@dataclass(frozen=True, slots=True)
class ParameterSet:
    """A published revision of one axis' parameters, pooled from ``windows`` accepted windows.

    ``window_ticks`` are their start ticks, where known. ``unexplained_um`` and ``warnings`` are the verdict's.
    ``loops`` are the keys of ``[axis.X.regulators]`` in which the loops used for validation differ from the configured
    ones; None where that was not recorded.
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
    """The drive's own control loops as identified from rapids: ``values`` (k,) and ``covariance`` (k, k) of ``names``.

    ``names`` are keys of ``[axis.X.regulators]``; ``structure`` is the best-fitting one. The residual following error
    with these loops is the verdict's ``unexplained_um``; ``configured_um`` is that with the configured loops, None
    where there are none.
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
    """Information for the operator: a FAULTS class, its severity, cause, effect and next action."""

    code: str
    severity: Literal["info", "minor", "MAJOR"]
    text: str
    axis: str = ""
    tick: int = 0
