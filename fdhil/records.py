"""The immutable records that cross rooms. Arrays are read-only float64 unless said; the unit is in the name.

Physics is SI (V, A, rad/s, N.m, kg.m2, s), path geometry is millimetres, path errors are micrometres where the
name says ``_um``. Drive increments appear in :class:`CorrectionTable` alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Literal

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

PARAMETERS = ("R", "L", "K", "Jt", "ft", "Cd")
UNITS: Mapping[str, str] = {
    "R": "ohm",
    "L": "H",
    "K": "N.m/A",
    "Jt": "kg.m2",
    "ft": "N.m.s",
    "Cd": "N.m",
    # what current and speed alone tell
    "Jt/K": "A.s2/rad",
    "ft/K": "A.s/rad",
    "Cd/K": "A",
}


def frozen(values: npt.ArrayLike) -> Float:
    """Return ``values`` as a read-only float64 array (a copy, so that no caller can reach into a record)."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def frozen_ints(values: npt.ArrayLike) -> Int:
    """Return ``values`` as a read-only int64 array."""
    array = np.array(values, dtype=np.int64)
    array.setflags(write=False)
    return array


@dataclass(frozen=True, slots=True)
class Parameters:
    """The six physical parameters of equations [1] and [2]: ohm, H, N.m/A, kg.m2, N.m.s, N.m."""

    R: float
    L: float
    K: float
    Jt: float
    ft: float
    Cd: float

    def as_dict(self) -> dict[str, float]:
        """Return the parameters by symbol, in the order of ``PARAMETERS``."""
        return {name: float(getattr(self, name)) for name in PARAMETERS}


VoltageSampling = Literal["interval_mean", "instant"]


@dataclass(frozen=True, slots=True)
class AxisSamples:
    """A block of one axis' samples on the SYNC grid, all arrays (n,).

    ``tick`` counts SYNC cycles and rises strictly; a hole in it is a lost sample, and ``lost`` counts the frames that
    were lost while the block was gathered. ``demand_mm`` is r[k], what the drive follows at that tick, without offset.
    ``offset_mm`` is the position offset (0x60B0) in force. ``voltage_v`` is None when no drive object gives it.
    """

    axis: str
    tick: Int
    demand_mm: Float
    position_mm: Float
    speed_rad_s: Float
    current_a: Float
    voltage_v: Float | None
    offset_mm: Float
    statusword: Int
    lost: int = 0


@dataclass(frozen=True, slots=True)
class VoltageSamples:
    """Samples of a separate voltage sensor: ``t_ns`` (n,) host-monotonic instants of the sensor's own grid,
    with their uncertainty ``t_error_ns`` (n,), and ``voltage_v`` (n,). ``counter`` (n,) is the sensor's own count."""

    sensor: str
    axis: str
    counter: Int
    t_ns: Int
    t_error_ns: Int
    voltage_v: Float
    sample_rate_hz: float


@dataclass(frozen=True, slots=True)
class SlowVoltage:
    """Voltage of a sensor slower than the drive, on its own grid beside a window: ``voltage_v`` (m,), lost samples NaN.

    Sample j covers ``begin_s`` + j ``period_s`` after row 0 of the window and one period from there (or is the value at
    its begin, as the window's ``voltage_sampling`` says). ``error_s`` is how far off ``begin_s`` may be.
    """

    begin_s: float
    period_s: float
    error_s: float
    voltage_v: Float


@dataclass(frozen=True, slots=True)
class TickTimes:
    """Host-monotonic time ``t_ns`` (n,) at which the SYNC of each ``tick`` (n,) was received."""

    tick: Int
    t_ns: Int


class MoveKind(Enum):
    """What the NC ordered."""

    RAPID = "rapid"
    FEED = "feed"
    REST = "rest"


@dataclass(frozen=True, slots=True)
class MoveEvent:
    """From ``tick`` on the axis makes a move of this kind, as ``source`` (a G0 event source) says."""

    axis: str
    kind: MoveKind
    tick: int
    source: str


@dataclass(frozen=True, slots=True)
class Temperature:
    """A temperature reading at a place of an axis (``slideway``, ``screw``, ``motor``)."""

    axis: str
    tick: int
    celsius: float
    place: str


@dataclass(frozen=True, slots=True)
class Stages:
    """Half-open sample ranges of a rapid inside its window; an absent stage is None."""

    accelerate: tuple[int, int] | None
    cruise: tuple[int, int] | None
    brake: tuple[int, int] | None


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """One G0 of one axis on a uniform grid of ``dt_s``, from rest to rest, with its stages and gaps.

    Arrays are (n,); a lost sample is NaN in every signal, and ``gaps`` lists the half-open ranges that were lost.
    ``voltage_v`` of row k is the mean over [t_k, t_k + dt) when ``voltage_sampling`` is ``interval_mean``, else the
    value at t_k; ``voltage_delay_s`` (what is left after alignment by counters, None when not known) has not been
    taken out. ``slow_voltage`` stands in its place where a sensor samples more slowly than the drive.
    ``start_s`` is the time of row 0 in its recording or since the first tick. ``offset_mm`` is the position
    offset in force, None where it was 0 throughout or is not known. Two windows are equal when they are the same one.
    """

    axis: str
    start_tick: int
    start_s: float
    dt_s: float
    demand_mm: Float
    position_mm: Float
    speed_rad_s: Float
    current_a: Float
    voltage_v: Float | None
    voltage_sampling: VoltageSampling
    stages: Stages
    direction: int
    rapid_speed_rad_s: float
    pitch_mm: float
    gaps: tuple[tuple[int, int], ...] = ()
    temperature_c: float | None = None
    voltage_delay_s: float | None = None
    source: str = ""
    offset_mm: Float | None = None
    slow_voltage: SlowVoltage | None = None

    @property
    def n(self) -> int:
        """Number of rows."""
        return int(self.speed_rad_s.size)


@dataclass(frozen=True, slots=True)
class Recording:
    """A whole recorded file of one axis before windows are cut: arrays (n,), lost samples NaN, ``gaps`` half-open.

    ``slow_voltage``, counted from row 0, stands in the place of ``voltage_v`` where a sensor is slower than the rows.
    """

    axis: str
    dt_s: float
    time_s: Float
    voltage_v: Float
    current_a: Float
    speed_rad_s: Float
    position_mm: Float
    demand_mm: Float
    voltage_sampling: VoltageSampling
    pitch_mm: float
    rapid_speed_rad_s: float | None
    temperature_c: float | None = None
    gaps: tuple[tuple[int, int], ...] = ()
    headers: Mapping[str, str] = field(default_factory=dict)
    slow_voltage: SlowVoltage | None = None


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
    when not told.
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

    def value(self, name: str) -> float:
        """Return one parameter's value (NaN when the data cannot tell it)."""
        return float(self.values[self.names.index(name)])

    def std(self, name: str) -> float:
        """Return one parameter's standard deviation."""
        k = self.names.index(name)
        return float(np.sqrt(self.covariance[k, k]))

    def parameters(self) -> Parameters:
        """Return the six parameters; NaN stays NaN."""
        return Parameters(*(self.value(name) for name in PARAMETERS))


@dataclass(frozen=True, slots=True)
class Verdict:
    """The validation's answer for one window or pool."""

    accepted: bool
    fit_percent: float | None
    reasons: tuple[Reason, ...] = ()


@dataclass(frozen=True, slots=True)
class WindowOutcome:
    """One window that was analysed: what was estimated, and whether it is believed."""

    window: Window
    estimate: Estimate | None
    verdict: Verdict


@dataclass(frozen=True, slots=True)
class ParameterSet:
    """A published revision of one axis' parameters: pooled from ``windows`` accepted windows."""

    axis: str
    revision: int
    parameters: Parameters
    covariance: Float
    windows: int
    tick: int
    temperature_c: float | None
    config_digest: str


@dataclass(frozen=True, slots=True)
class Trajectory:
    """A reference on the SYNC grid: ``time_s`` (n,) and ``position_mm`` per axis (n,); ``rapid`` (n,) marks G0 rows.

    ``line`` (n,) is the source line of the program that ordered the row, 0 where there is none.
    """

    dt_s: float
    time_s: Float
    position_mm: Mapping[str, Float]
    rapid: Bool
    line: Int

    @property
    def axes(self) -> tuple[str, ...]:
        """The axes in the order of the machine."""
        return tuple(self.position_mm)


@dataclass(frozen=True, slots=True)
class Zone:
    """A stretch of the path whose contour error stands out: where it is, how much, and why."""

    start_s: float
    end_s: float
    where: str
    max_um: float
    cause: str


@dataclass(frozen=True, slots=True)
class Prediction:
    """Predicted against reference: per axis arrays (n,), contour error (n,) in um, and zones.

    ``current_a`` per axis (n,) is the model's at the SYNC instants; ``limited_s`` is the time each axis spent with a
    limit acting.
    """

    reference: Trajectory
    predicted_mm: Mapping[str, Float]
    error_um: Mapping[str, Float]
    contour_um: Float
    current_a: Mapping[str, Float]
    limited_s: Mapping[str, float]
    zones: tuple[Zone, ...] = ()


@dataclass(frozen=True, slots=True)
class Skill:
    """Predicted against measured following error of one recorded move."""

    axis: str
    tick: int
    rms_um: float
    max_um: float
    delay_ms: float
    measured_rms_um: float


@dataclass(frozen=True, slots=True)
class Correction:
    """What a correction method plans for a reference: offsets per axis (n,), the path error without and with them.

    ``offset_um`` is added to the reference; ``refused`` is empty when the gate lets the correction through, else the
    offsets are all 0. ``warnings`` do not refuse. ``delay_s`` is the delay tau of r(t - tau) that was aimed at. Speed
    and torque offsets (n,) per axis are empty unless the method is an on-line feed-forward.
    """

    method: str
    before: Prediction
    after: Prediction
    offset_um: Mapping[str, Float]
    refused: tuple[Reason, ...] = ()
    warnings: tuple[Reason, ...] = ()
    delay_s: float = 0.0
    speed_offset_rad_s: Mapping[str, Float] = field(default_factory=dict)
    torque_offset_nm: Mapping[str, Float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class CorrectionTable:
    """What the guard loads: rows of demand and offset in drive increments, (n,) int64 per axis."""

    axes: tuple[str, ...]
    demand_increments: Mapping[str, Int]
    offset_increments: Mapping[str, Int]
    program_digest: str
    digest: str


@dataclass(frozen=True, slots=True)
class Notice:
    """Something an operator should know: a FAULTS class, its severity, cause, effect and next action."""

    code: str
    severity: Literal["info", "minor", "MAJOR"]
    text: str
    axis: str = ""
    tick: int = 0


Outcome = WindowOutcome | ParameterSet | Skill | Notice
