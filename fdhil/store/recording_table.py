"""A recording as in every file format: headers (texts by key) and columns of numbers by name.

A time step that differs by more than 1 % is a gap. A recording may lack the voltage; its header may then give the
motor's torque constant.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fdhil.csv_text import MAX_ROWS, quote_cell
from fdhil.errors import RecordingError
from fdhil.records import Float, Recording, SlowVoltage, VoltageSampling, freeze_array

RECORDING_FORMAT = "fdhil-recording-1"
COLUMNS = ("time_s", "current_A", "speed_rad_per_s")
PATH = ("position_m", "demand_m")  # only for results in micrometres; they need a pitch
ANGLE = "angle_rad"  # of the motor, in place of a position
VOLTAGE_COLUMN = "voltage_V"
TABLE = ("table_mm", "table_m_s2")  # sensors at the table, which may have lost samples
REQUIRED = ("format", "sample_rate_hz", "axis")
PITCH_KEY = "pitch_m_per_rev"  # required with a position or a demand
STAND_IN_PITCH_M = 2e-3 * math.pi  # of a motor without a screw: 1 mm in a message means 1 rad
SAMPLING = "voltage_sampling"  # required with a voltage
IMPORT_NOTES = "import_notes"  # header: conversions of another program's numbers
COLUMN_SOURCES: Mapping[str, tuple[str, ...]] = {
    "speed_source": ("sensor", "difference", "filtered"),
    "voltage_source": ("terminals", "command"),
}
UNITS: Mapping[str, str] = {
    "time_s": "s",
    "voltage_V": "V",
    "current_A": "A",
    "speed_rad_per_s": "rad/s",
    "position_m": "m",
    "demand_m": "m",
    "angle_rad": "rad",
    "table_mm": "mm",
    "table_m_s2": "m/s2",
}
STEP_TOLERANCE = 0.01
UNIT_KEYS = ("unit", "units")  # keys of a column's unit, in lower case
# errors of the readers of damaged files
UNREADABLE = (
    ArithmeticError, AssertionError, AttributeError, EOFError, LookupError, MemoryError, OSError, RuntimeError,
    TypeError, ValueError, struct.error, zlib.error,
)  # fmt: skip
MIN_ROWS = 16
MOST_SHOWN = 12  # names in an error
MAX_VALUES = 64_000_000  # half a gigabyte
MAX_SAMPLES_CHARS = 16 * 1024 * 1024
PITCH_M = (1e-5, 0.8)
PITCH_DEG, RADIUS_M = (
    (1e-3, 360.0),
    (0.01, 10.0),
)  # of a rotary axis, and the radius at which an angle counts as a length
PITCH_OF_ROTARY = "pitch_deg_per_rev"
ANGLES = {"position_m": "position_deg", "demand_m": "demand_deg"}
RATE_HZ = (1.0, 1e6)
SLOW_HZ = 200.0  # slower rates give too few samples of an acceleration within 0.1 s
RECORD_HZ = 1000  # recommended for rapids
RAPID_M_S = (1e-4, 20.0)
CONSTANT_NM_A = (1e-3, 100.0)


@dataclass(frozen=True, slots=True)
class RecordingTable:
    """``headers`` and ``columns`` (n,) of a recording; a lost sample is a missing row.

    For other programs' files also: ``clocks``, columns that are times in s by their type; ``doubts``, why a column
    cannot be used; ``interruption``, why row numbers cannot replace times; ``others``, columns sampled at other times;
    ``texts``, what the file says about a column.
    """

    headers: Mapping[str, str]
    columns: Mapping[str, Float]
    clocks: frozenset[str] = frozenset()
    doubts: Mapping[str, str] = field(default_factory=dict)
    interruption: str = ""
    others: tuple[RecordingTable, ...] = ()
    texts: Mapping[str, Sequence[str]] = field(default_factory=dict)


def make_recording(table: RecordingTable, source: str = "recording") -> Recording:
    """Return the recording of a table. Raises RecordingError with the fault and its remedy."""
    check_headers(table.headers, table.columns, source)
    table, pitches = _convert_angles(table, source)
    headers = dict(table.headers)
    names = [name for name in (*COLUMNS, *PATH, ANGLE, VOLTAGE_COLUMN, *TABLE) if name in table.columns]
    values = _stack_columns(table, names, source)
    dt = 1.0 / _parse_within(headers, "sample_rate_hz", RATE_HZ, source)
    rows, gaps = _place_samples(values[:, 0], dt, source)
    columns = _spread_samples(values, rows)
    sampling = _parse_sampling(headers, source) if SAMPLING in headers else "interval_mean"
    _check_sources(headers, source)
    pitch_m = _parse_within(headers, PITCH_KEY, pitches, source) if PITCH_KEY in headers else STAND_IN_PITCH_M
    rapid_m_s = (
        _parse_within(headers, "rapid_speed_m_per_s", RAPID_M_S, source) if "rapid_speed_m_per_s" in headers else None
    )
    paths = {name: _get_column(name, names, columns) for name in PATH}
    position_m, demand_m = paths["position_m"], paths["demand_m"]
    if position_m is None:
        angle = _get_column(ANGLE, names, columns)
        angle = _integrate_speed(columns[:, 2], dt, headers.get("speed_source")) if angle is None else angle
        position_m = angle * (pitch_m / (2 * math.pi))
    return Recording(
        axis=headers["axis"],
        dt_s=dt,
        time_s=freeze_array(values[0, 0] + dt * np.arange(columns.shape[0])),
        voltage_v=_get_column(VOLTAGE_COLUMN, names, columns),
        current_a=freeze_array(columns[:, 1]),
        speed_rad_s=freeze_array(columns[:, 2]),
        position_mm=freeze_array(position_m * 1e3),
        demand_mm=freeze_array(np.full(len(columns), np.nan) if demand_m is None else demand_m * 1e3),
        voltage_sampling=sampling,
        pitch_mm=pitch_m * 1e3,
        rapid_speed_rad_s=None if rapid_m_s is None else rapid_m_s / pitch_m * 2 * math.pi,
        temperature_c=_parse_optional(headers, "temperature_C", source),
        gaps=gaps,
        headers=headers,
        slow_voltage=_parse_slow_voltage(headers, float(values[0, 0]), dt, source),
        torque_constant_nm_per_a=_parse_torque_constant(headers, source),
        table_mm=_get_column("table_mm", names, columns),
        table_m_s2=_get_column("table_m_s2", names, columns),
    )


def _integrate_speed(speed_rad_s: Float, dt_s: float, source: str | None) -> Float:
    """Integrate a speed to an angle (n,), in place of a position that was not recorded; lost samples NaN.

    A speed that is a difference of positions is the mean over the interval before.
    """
    known = np.isfinite(speed_rad_s)
    speed = np.interp(np.arange(known.size), np.flatnonzero(known), speed_rad_s[known])
    means = speed[1:] if source == "difference" else (speed[1:] + speed[:-1]) / 2
    angle = np.concatenate([[0.0], np.cumsum(means * dt_s)])
    return np.where(known, angle, np.nan)


def _convert_angles(table: RecordingTable, source: str) -> tuple[RecordingTable, tuple[float, float]]:
    """Convert the angles of a rotary axis to arc lengths; return the table and the allowed pitches."""
    headers, columns = dict(table.headers), dict(table.columns)
    if PITCH_OF_ROTARY not in headers:
        return table, PITCH_M
    if "radius_m" not in headers:
        raise RecordingError(
            f"{source} has no header radius_m: give the radius at which its angles count as path error"
        )
    m_per_deg = math.radians(_parse_within(headers, "radius_m", RADIUS_M, source))
    headers["pitch_m_per_rev"] = repr(_parse_within(headers, PITCH_OF_ROTARY, PITCH_DEG, source) * m_per_deg)
    if (rapid := _parse_optional(headers, "rapid_speed_deg_per_s", source)) is not None:
        headers["rapid_speed_m_per_s"] = repr(rapid * m_per_deg)
    columns |= {name: columns.pop(angle) * m_per_deg for name, angle in ANGLES.items() if angle in columns}
    return replace(table, headers=headers, columns=columns), (0.0, math.inf)


def check_size(rows: int, columns: int, source: str) -> None:
    """Refuse a file that declares more than a recording can have, before any of it is read."""
    if rows > MAX_ROWS or rows * columns > MAX_VALUES:
        raise RecordingError(f"{source} declares {columns} columns of {rows} rows, too many for a recording: split it")


def make_length_error(sizes: Mapping[str, int], source: str) -> RecordingError:
    return RecordingError(f"{source} has columns of different lengths, {sizes}: export them with one time step")


def make_unreadable_error(source: str, kind: str, error: BaseException) -> RecordingError:
    """Return the error that says why a file is not of its kind."""
    first = (str(error).splitlines() or [type(error).__name__])[0][:200]
    return RecordingError(f"{source} is not a readable {kind}: {first}; export it again")


def check_headers(headers: Mapping[str, str], columns: Mapping[str, object], source: str) -> dict[str, str]:
    """Return the headers of a recording with these columns. Raises RecordingError with what is missing."""
    rotary = PITCH_OF_ROTARY in headers
    has_path = any(name in columns for name in PATH)
    required = [
        *REQUIRED,
        *([PITCH_KEY] if has_path and not rotary else []),
        *([SAMPLING] if VOLTAGE_COLUMN in columns else []),
    ]
    if rotary and "pitch_m_per_rev" in headers:
        raise RecordingError(f"{source} has pitch_m_per_rev and {PITCH_OF_ROTARY}: keep the one for its axis' unit")
    if not rotary and (angles := [name for name in ANGLES.values() if name in columns]):
        what = f"{source} has {' and '.join(angles)}, but no header {PITCH_OF_ROTARY}"
        raise RecordingError(f"{what}: give it and radius_m, or name the columns position_m and demand_m")
    missing = [key for key in required if not headers.get(key)]
    if missing:
        raise RecordingError(
            f"{source} has no header {', '.join(missing)}: add a line such as '# {missing[0]}: ...', or give "
            "--columns with a column map for another program's file"
        )
    if headers["format"] != RECORDING_FORMAT:
        raise RecordingError(
            f"{source} has format {quote_cell(headers['format'])}, not {RECORDING_FORMAT!r}: convert it first"
        )
    absent = [name for name in COLUMNS if name not in columns]
    absent += [angle for name, angle in ANGLES.items() if rotary and name in columns]
    if absent:
        has = ", ".join([quote_cell(name) for name in columns][:MOST_SHOWN]) or "no columns"
        raise RecordingError(
            f"{source} has no column {', '.join(absent)}; it has {has}: rename, or give --columns with a column map"
        )
    return dict(headers)


def _stack_columns(table: RecordingTable, names: list[str], source: str) -> Float:
    sizes = {name: table.columns[name].size for name in names}
    if len(set(sizes.values())) > 1:
        raise make_length_error(sizes, source)
    if sizes["time_s"] < MIN_ROWS and 1 < sizes["time_s"] < SLOW_HZ * np.ptp(table.columns["time_s"]):
        raise RecordingError(
            f"{source} has {sizes['time_s']} samples in {np.ptp(table.columns['time_s']):.3g} s, too few to "
            f"resolve a drive's acceleration: record at {RECORD_HZ} Hz or faster"
        )
    if sizes["time_s"] < MIN_ROWS:
        raise RecordingError(f"{source} is truncated: {sizes['time_s']} rows are too few; record it again")
    for name in names:
        values = table.columns[name]
        wrong = np.isinf(values) if name in TABLE else ~np.isfinite(values)
        if wrong.any():
            what = f"{source} has a non-finite {name} in row {int(np.argmax(wrong)) + 1}"
            raise RecordingError(f"{what}: leave out the row of a lost sample")
    return np.column_stack([table.columns[name] for name in names])


def _get_column(name: str, names: list[str], columns: Float) -> Float | None:
    return freeze_array(columns[:, names.index(name)]) if name in names else None


def _parse_slow_voltage(headers: dict[str, str], start_s: float, dt_s: float, source: str) -> SlowVoltage | None:
    """Return the samples of a voltage sensor that is slower than the rows, if the headers contain them.

    Sample j begins at ``voltage_begin_s`` + j ``voltage_period_s`` on the time axis of the rows, the first of which is
    at ``start_s`` and which are ``dt_s`` apart; a lost one is ``nan`` in ``voltage_samples_V``.
    """
    if "voltage_samples_V" not in headers:
        return None
    period, begin = (
        _parse_positive(headers, "voltage_period_s", source),
        _parse_optional(headers, "voltage_begin_s", source),
    )
    if period < dt_s / 2:  # aligning finer samples with the rows would take hours
        raise RecordingError(
            f"{source} has voltage samples {period:g} s apart, closer than its rows: give voltage_period_s in seconds"
        )
    if len(headers["voltage_samples_V"]) > MAX_SAMPLES_CHARS:
        raise RecordingError(f"{source} has too many voltage samples for a recording: split it")
    try:
        samples = np.array(headers["voltage_samples_V"].split(), dtype=np.float64)
    except ValueError:
        raise RecordingError(f"{source} has an invalid voltage sample: copy or export it again") from None
    if begin is None or not samples.size or np.isinf(samples).any() or np.isnan(samples).all():
        raise RecordingError(
            f"{source} has voltage samples of a slower sensor without voltage_begin_s or without a finite value: "
            "export it again"
        )
    error = _parse_optional(headers, "voltage_error_s", source) or 0.0
    return SlowVoltage(
        begin - start_s,
        period,
        abs(error),
        freeze_array(samples),
        _parse_late_times(headers, samples.size, period, source),
    )


def _parse_late_times(headers: dict[str, str], samples: int, period: float, source: str) -> Float | None:
    """Return how much later than its grid time each sample of a slow sensor was taken."""
    if "voltage_late_s" not in headers:
        return None
    try:
        late = np.array(headers["voltage_late_s"][:MAX_SAMPLES_CHARS].split(), dtype=np.float64)
    except ValueError:
        late = np.zeros(0)
    if late.size != samples or not (np.abs(late) < period / 2).all():
        raise RecordingError(f"{source} has invalid voltage_late_s for its voltage samples: export it again")
    return freeze_array(late)


def _place_samples(
    time_s: Float, dt: float, source: str
) -> tuple[np.ndarray[tuple[int], np.dtype[np.int64]], tuple[tuple[int, int], ...]]:
    """Return the grid row (n,) of each sample and the half-open gaps between them."""
    steps = np.diff(time_s)
    if (steps <= 0).any():
        k = int(np.argmax(steps <= 0))
        raise RecordingError(f"{source}: time does not rise at {time_s[k + 1]:g} s: sort or record it again")
    if time_s[-1] - time_s[0] > MAX_ROWS * dt:
        raise RecordingError(f"{source}: a gap of {steps.max():g} s is too long for one run: split the file there")
    off = np.abs(steps - dt) > STEP_TOLERANCE * dt
    if off.mean() > 0.5:
        raise RecordingError(
            f"{source}: rows are {np.median(steps):g} s apart, but sample_rate_hz means {dt:g} s: correct the header"
        )
    # a deviating step is a gap even if it rounds to one sample: a row is missing or misplaced
    counts = np.where(off, np.maximum(np.rint(steps / dt), 2), 1).astype(np.int64)
    rows = np.concatenate([[0], np.cumsum(counts)])
    gaps = tuple((int(rows[k]) + 1, int(rows[k + 1])) for k in np.flatnonzero(off))
    return rows, gaps


def _spread_samples(table: Float, rows: np.ndarray[tuple[int], np.dtype[np.int64]]) -> Float:
    columns = np.full((int(rows[-1]) + 1, table.shape[1]), np.nan)
    columns[rows] = table
    return columns


def _parse_sampling(headers: dict[str, str], source: str) -> VoltageSampling:
    value = headers["voltage_sampling"]
    if value == "interval_mean":
        return "interval_mean"
    if value == "instant":
        return "instant"
    raise RecordingError(f"{source} has voltage_sampling {quote_cell(value)}: it must be interval_mean or instant")


def _check_sources(headers: dict[str, str], source: str) -> None:
    for key, words in COLUMN_SOURCES.items():
        if key in headers and headers[key] not in words:
            raise RecordingError(f"{source} has {key} {quote_cell(headers[key])}: it must be {' or '.join(words)}")


def _parse_torque_constant(headers: dict[str, str], source: str) -> float | None:
    key = "torque_constant_nm_per_a"
    return _parse_within(headers, key, CONSTANT_NM_A, source) if key in headers else None


def _parse_positive(headers: dict[str, str], key: str, source: str) -> float:
    value = _parse_optional(headers, key, source)
    if value is None or not value > 0:
        raise RecordingError(
            f"{source} has header {key} = {quote_cell(str(headers.get(key)))}: it must be a number above 0"
        )
    return value


def _parse_within(headers: dict[str, str], key: str, bounds: tuple[float, float], source: str) -> float:
    value, (low, high) = _parse_positive(headers, key, source), bounds
    if low <= value <= high:
        return value
    length = key in ("pitch_m_per_rev", "rapid_speed_m_per_s")
    guess = f" (is {value:g} in mm? then write {value / 1e3:g})" if length and value > high else ""
    text = f"{source} has header {key} = {value:g}, outside the {low:g} to {high:g} of machines: correct it{guess}"
    raise RecordingError(text)


def _parse_optional(headers: dict[str, str], key: str, source: str) -> float | None:
    if key not in headers:
        return None
    try:
        value = float(headers[key])
    except ValueError:
        raise RecordingError(
            f"{source} has header {key} = {quote_cell(headers[key])} instead of a number: correct it"
        ) from None
    if not math.isfinite(value):
        raise RecordingError(f"{source} has the non-finite header {key} = {quote_cell(headers[key])}: correct it")
    return value
