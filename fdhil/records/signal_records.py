"""Records of signals: samples, windows and recordings of an axis."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Literal

from fdhil.records.physical_parameters import Float, Int

TableSignal = Literal["table_mm", "table_m_s2"]
VoltageSampling = Literal["interval_mean", "instant"]


@dataclass(frozen=True, slots=True)
class AxisSamples:
    """A block of one axis' samples on the SYNC grid, all arrays (n,).

    ``tick`` counts SYNC cycles and increases strictly; a hole in it is a lost sample, and ``lost`` counts the frames
    lost while the block was gathered. ``demand_mm`` is r[k], the set-point that the drive follows at that tick, without
    offset. ``offset_mm`` is the position offset (0x60B0) in force. ``compute_motor_voltage_v`` is None when no drive
    object provides it.
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
    """Samples of a separate voltage sensor on its own grid, arrays (n,).

    ``t_ns`` are host-monotonic instants with the uncertainty ``t_error_ns``; ``counter`` is the sensor's own count.
    ``on_grid`` is False where a sensor is polled near its instants: then ``t_ns`` is when each value was valid.
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
    """Voltage of a sensor slower than the drive, on its own grid: ``compute_motor_voltage_v`` (m,), lost samples NaN.

    Sample j covers one period from ``begin_s`` + j ``period_s`` after sample 0 of the window (or is the value at its
    start, by the window's ``voltage_sampling``). ``error_s`` is the uncertainty of ``begin_s``.
    ``estimate_current_lag_s`` (m,), for a polled sensor, is the delay of each value, less than half a period.
    """

    begin_s: float
    period_s: float
    error_s: float
    voltage_v: Float
    late_s: Float | None = None


@dataclass(frozen=True, slots=True)
class TableSamples:
    """Samples of a sensor at an axis' table: ``values`` (n,) in the unit of ``signal`` at ``tick`` (n,), increasing.

    A tick between two SYNCs has a fraction; ``tick_error`` is the uncertainty of all ticks, 0 where sampled at the
    SYNC. Acceleration samples come ``rate_per_tick``; a longer step is a lost one.
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
    """Kind of the move that the NC executes; UNKNOWN where it does not report it."""

    RAPID = "rapid"
    FEED = "feed"
    ARC = "arc"
    REST = "rest"
    HOLD = "hold"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class NcMove:
    """What an NC reported while an axis moved; None where it did not report it.

    ``override`` is the lowest and the highest in force, 1.0 at 100 %; ``held`` whether a feed hold was active.
    """

    line: int | None = None
    program: str | None = None
    override: tuple[float, float] | None = None
    held: bool | None = None


@dataclass(frozen=True, slots=True)
class MoveEvent:
    """From ``tick`` on the axis makes a move of this kind, according to ``source`` (a G0 event source).

    ``nc`` is the NC's report of it, None where the source is not an NC.
    """

    axis: str
    kind: MoveKind
    tick: int
    source: str
    nc: NcMove | None = None


@dataclass(frozen=True, slots=True)
class Temperature:
    """A temperature reading at one location of an axis (``slideway``, ``screw``, ``motor``)."""

    axis: str
    tick: int
    celsius: float
    place: str


@dataclass(frozen=True, slots=True)
class Stages:
    """Half-open sample ranges of a rapid within its window; a missing stage is None."""

    accelerate: tuple[int, int] | None
    cruise: tuple[int, int] | None
    brake: tuple[int, int] | None


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """One G0 of one axis on a uniform grid of ``dt_s``, from rest to rest, with its stages and gaps.

    Arrays are (n,); a lost sample is NaN in every signal, and ``gaps`` lists the half-open ranges that were lost.
    ``compute_motor_voltage_v`` of sample k is the mean over [t_k, t_k + dt) when ``voltage_sampling`` is
    ``interval_mean``, else the
    value at t_k; ``voltage_delay_s`` (the residual delay after alignment by counters, None when unknown) is not
    compensated. ``slow_voltage`` replaces it where a sensor samples more slowly than the drive. ``speed_late_s`` is the
    delay of the recorded speed, already compensated (None: no compensation), with its standard deviation. ``table_mm``
    is the position and ``table_m_s2`` the acceleration of sensors at the table, NaN in samples without a value, None
    without sensors. ``start_s`` is the time of sample 0 in its recording or since the first tick. ``offset_mm`` is the
    position offset in force, None where it was 0 throughout or is unknown. ``torque_constant_nm_per_a`` is the K that
    the recording itself states. ``nc`` is the NC's report of the move, None without one. For a move that is not a rapid
    (``is_rapid``), a whole laboratory recording, ``stages`` and ``direction`` mean little. ``current_off_a`` (n,) is
    one standard deviation of current readings from their means, None where nothing determines it. Windows are equal
    only when identical.
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
        """Number of samples."""
        return int(self.speed_rad_s.size)


@dataclass(frozen=True, slots=True)
class Recording:
    """Samples of one axis before windows are cut, a whole file or the newest ones: arrays (n,), lost samples NaN.

    ``gaps`` are half-open. ``slow_voltage``, counted from sample 0, replaces ``compute_motor_voltage_v`` where a sensor
    is slower; both are None without a source. Sample 0 is at ``start_tick``. The rest is as in :class:`Window`.
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
