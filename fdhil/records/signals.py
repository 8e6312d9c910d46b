"""Signals: samples, windows and recordings of an axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Literal

from fdhil.records.values import Float, Int

TableSignal = Literal["table_mm", "table_m_s2"]
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
    with their uncertainty ``t_error_ns`` (n,), and ``voltage_v`` (n,). ``counter`` (n,) is the sensor's own count.

    ``on_grid`` is False where a sensor was asked near its instants: ``t_ns`` is then when each value was true.
    """

    sensor: str
    axis: str
    counter: Int
    t_ns: Int
    t_error_ns: Int
    voltage_v: Float
    sample_rate_hz: float
    on_grid: bool = True


@dataclass(frozen=True, slots=True)
class SlowVoltage:
    """Voltage of a sensor slower than the drive, on its own grid beside a window: ``voltage_v`` (m,), lost samples NaN.

    Sample j covers ``begin_s`` + j ``period_s`` after row 0 of the window and one period from there (or is the value at
    its begin, as the window's ``voltage_sampling`` says). ``error_s`` is how far off ``begin_s`` may be.
    ``late_s`` (m,), of a sensor that was asked near its instants, is by how much later each value was true, less than
    half a period.
    """

    begin_s: float
    period_s: float
    error_s: float
    voltage_v: Float
    late_s: Float | None = None


@dataclass(frozen=True, slots=True)
class TableSamples:
    """Samples of a sensor at an axis' table: ``values`` (n,) in the unit of ``signal`` at ``tick`` (n,), which rises.

    A tick between two SYNCs has a fraction; ``tick_error`` is how far off all of them may be, 0 where they were sampled
    at the SYNC. Samples of an acceleration come ``rate_per_tick``; a longer step is a lost one.
    """

    axis: str
    signal: TableSignal
    tick: Float
    tick_error: float
    values: Float
    rate_per_tick: float = 1.0


@dataclass(frozen=True, slots=True)
class TickTimes:
    """Host-monotonic time ``t_ns`` (n,) at which the SYNC of each ``tick`` (n,) was received."""

    tick: Int
    t_ns: Int


class MoveKind(Enum):
    """What the NC ordered; UNKNOWN is what it did not tell."""

    RAPID = "rapid"
    FEED = "feed"
    ARC = "arc"
    REST = "rest"
    HOLD = "hold"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class NcMove:
    """What an NC said of itself while an axis moved; None is what it did not tell.

    ``override`` is the least and the greatest that was in force, 1.0 at 100 %; ``held`` whether a feed hold was on.
    """

    line: int | None = None
    program: str | None = None
    override: tuple[float, float] | None = None
    held: bool | None = None


@dataclass(frozen=True, slots=True)
class MoveEvent:
    """From ``tick`` on the axis makes a move of this kind, as ``source`` (a G0 event source) says.

    ``nc`` is what the NC said of it, None where the source is no NC.
    """

    axis: str
    kind: MoveKind
    tick: int
    source: str
    nc: NcMove | None = None


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
    ``speed_late_s`` is how late the recorded speed was, which has been taken out (None: nothing was), with its standard
    deviation. ``table_mm`` is the place and ``table_m_s2`` the acceleration that sensors at the table tell, NaN in rows
    that they do not, None without them. ``start_s`` is the time of row 0 in its recording or since the first tick.
    ``offset_mm`` is the position offset in force, None where it was 0 throughout or is not known.
    ``torque_constant_nm_per_a`` is the K that the recording itself tells. ``nc`` is what the NC said of the move,
    None where it was not heard. Of a move that is no rapid (``is_rapid``), a whole laboratory recording, ``stages`` and
    ``direction`` mean little. ``current_off_a`` is one standard deviation (n,) of how far readings of the current may
    be from its means, None where nothing determines it. Two windows are equal when they are the same one.
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
    speed_late_s: float | None = None
    speed_late_std_s: float = 0.0
    torque_constant_nm_per_a: float | None = None
    table_mm: Float | None = None
    table_m_s2: Float | None = None
    nc: NcMove | None = None
    is_rapid: bool = True
    current_off_a: Float | None = None

    @property
    def n(self) -> int:
        """Number of rows."""
        return int(self.speed_rad_s.size)


@dataclass(frozen=True, slots=True)
class Recording:
    """A stretch of one axis before windows are cut, a whole file or the newest samples: arrays (n,), lost samples NaN.

    ``gaps`` are half-open. ``slow_voltage``, counted from row 0, stands in the place of ``voltage_v`` where a sensor is
    slower than the rows; both are None without a source. Row 0 is ``start_tick``. The rest is as in :class:`Window`.
    """

    axis: str
    dt_s: float
    time_s: Float
    voltage_v: Float | None
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
    start_tick: int = 0
    voltage_delay_s: float | None = None
    offset_mm: Float | None = None
    source: str = ""
    torque_constant_nm_per_a: float | None = None
    table_mm: Float | None = None
    table_m_s2: Float | None = None
