"""Check, by a move back and forth, the units and signs of speed, current and voltage. Pure.

The energy spent on a path that ends where it began is only friction and heat, whatever weight or spring acts on the
axis: the integrals of i w, u i and u w over it are positive, and each requires two correct signs (FAULTS B10).
"""

import math
from collections.abc import Iterator

import numpy as np

from fdhil.commissioning.finding import Finding
from fdhil.config import Axis
from fdhil.records import Float, Recording

SPEED_TOLERANCE = 0.05
TRAVEL_TOLERANCE = 0.02
TABLE_TOLERANCE = 0.05  # backlash on a jog of 5 mm is less
LEAST_CORRELATION = 0.05  # of two signals, to determine the sign of their product
RESTING = 0.2  # of the top speed: slower samples show offsets and rounding
CODE = "SignOrScale"


def assess_jog(jog: Recording, distance_mm: float, axis: Axis) -> Iterator[Finding]:
    """Compare the recording of a jog over ``distance_mm`` and back with an axis whose units are correct."""
    commanded = abs(distance_mm)
    way = float(np.nanmax(np.abs(jog.position_mm - jog.position_mm[np.isfinite(jog.position_mm)][0])))
    wanted, went = axis.format_in_unit(commanded, form="g"), axis.format_in_unit(way, form=".3f")
    cause = f"{CODE}: it was commanded {wanted}, but its position (0x6064) moved {went}"
    same = abs(way - commanded) <= TRAVEL_TOLERANCE * commanded
    advice = "its set-point and position have different scales; correct its factors (0x6091, 0x6092)"
    yield Finding("travel", wanted, went, same, cause, advice)
    yield _check_speed_unit(jog)
    yield from _check_table_travel(jog)
    power = compute_signal_correlations(jog)
    yield _check_sign("current", "current times speed", power["current x speed"], "drive.sign or the current's sign")
    voltage = [power[name] for name in ("voltage x current", "voltage x speed") if name in power]
    if voltage:
        yield _check_sign("voltage", "voltage times current, and times speed", min(voltage), VOLTAGE_ADVICE)
    else:
        cause = "no voltage was recorded"
        yield Finding("voltage sign", "positive", "unknown", None, cause, "R and L stay as in the data sheet")


VOLTAGE_ADVICE = "the sensor's leads, its word order and [axis.*.voltage] scale"


def compute_signal_correlations(rows: Recording) -> dict[str, float]:
    """Return the correlation (-1 to 1) of each pair of current, speed and voltage over the samples in motion."""
    speed, current, voltage = rows.speed_rad_s, rows.current_a, interpolate_voltage(rows)
    signals = {"current x speed": (current, speed)}
    if voltage is not None:
        signals |= {"voltage x current": (voltage, current), "voltage x speed": (voltage, speed)}
    moving = np.abs(np.nan_to_num(speed)) > RESTING * np.nanmax(np.abs(speed))
    return {name: _compute_correlation(a[moving], b[moving]) for name, (a, b) in signals.items()}


def interpolate_voltage(rows: Recording) -> Float | None:
    """Return the voltage at each sample (n,), interpolated linearly from a slower sensor; None without one."""
    slow = rows.slow_voltage
    if slow is None:
        return rows.voltage_v
    middle = slow.begin_s + slow.period_s * (np.arange(slow.voltage_v.size) + 0.5)
    known = np.isfinite(slow.voltage_v)
    at = np.arange(rows.speed_rad_s.size) * rows.dt_s
    return np.interp(at, middle[known], slow.voltage_v[known]) if known.any() else None


def _compute_correlation(a: Float, b: Float) -> float:
    known = np.isfinite(a) & np.isfinite(b)
    size = math.sqrt(float(np.square(a[known]).sum()) * float(np.square(b[known]).sum()))
    return float(a[known] @ b[known]) / size if size > 0.0 else 0.0


def _check_sign(what: str, product: str, correlation: float, where: str) -> Finding:
    shown = f"{correlation:+.2f}"
    if abs(correlation) < LEAST_CORRELATION:
        cause = f"{CODE}: {product} cancel out over a move back and forth ({shown}): the sign of its {what} is unknown"
        return Finding(f"{what} sign", "positive", shown, False, cause, f"check {where}")
    cause = f"{CODE}: {product} is negative over a move back and forth ({shown}): its {what} has the wrong sign"
    return Finding(f"{what} sign", "positive", shown, correlation > 0.0, cause, f"check {where}")


def _check_speed_unit(jog: Recording) -> Finding:
    rate = np.gradient(jog.position_mm, jog.dt_s) * 2 * math.pi / jog.pitch_mm
    known = np.isfinite(rate) & np.isfinite(jog.speed_rad_s)
    power = float(np.square(rate[known]).sum())
    ratio = float(rate[known] @ jog.speed_rad_s[known]) / power if power > 0.0 else 0.0
    cause = f"{CODE}: its speed (0x606C) is {ratio:.3g} times the derivative of its position"
    same = abs(ratio - 1.0) <= SPEED_TOLERANCE
    return Finding("speed unit", "1", f"{ratio:.3f}", same, cause, "set drive.speed_unit, or its speed's unit (0x60A9)")


def _check_table_travel(jog: Recording) -> Iterator[Finding]:
    if jog.table_mm is None:
        return
    known = np.isfinite(jog.table_mm) & np.isfinite(jog.position_mm)
    if not known.any():
        return
    place, table = (values[known] - values[known][0] for values in (jog.position_mm, jog.table_mm))
    ratio = float(place @ table) / float(place @ place)
    cause = f"{CODE}: its table moves {ratio:.3g} times the distance of its motor"
    advice = "check drive.sign, screw_pitch_mm and increments_per_rev, then sign and scale of the table's encoder"
    yield Finding("table", "1", f"{ratio:.3f}", abs(ratio - 1.0) <= TABLE_TOLERANCE, cause, advice)


def assess_acceleration_power(rows: Recording) -> Finding:
    """Check the power balance: during acceleration of a rapid the integral of u i is positive, as R is."""
    voltage = interpolate_voltage(rows)
    expected = "power in while accelerating"
    if voltage is None:
        return Finding("power balance", expected, "no voltage", None, "no voltage was recorded", "nothing")
    speed = np.abs(np.nan_to_num(rows.speed_rad_s))
    rising = np.gradient(speed, rows.dt_s) > 0.2 * float(np.max(np.gradient(speed, rows.dt_s)))
    known = rising & np.isfinite(voltage) & np.isfinite(rows.current_a)
    joule = float(voltage[known] @ rows.current_a[known]) * rows.dt_s
    cause = f"{CODE}: it delivered {-joule:.1f} J while it accelerated, which is impossible for a motor"
    return Finding("power balance", expected, f"{joule:+.1f} J", joule > 0.0, cause, f"check {VOLTAGE_ADVICE}")
