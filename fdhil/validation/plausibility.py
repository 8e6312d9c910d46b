"""What must hold of the signals before any fit is believed: finite, not clipped, no hidden gap."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from fdhil.identification.motion import noise_levels, resolution
from fdhil.identification.windows import carried, longest, moving_range, noise_of, smooth
from fdhil.records import Bool, Float, Reason, Window
from fdhil.validation.backlash import backlash
from fdhil.validation.interruptions import interruptions
from fdhil.validation.repeated_readings import alike

CHANCE = 1e-4  # of a false alarm of one check on one good window
TOLERATED_GAP = 3  # rows: a longer gap hides what the drive did
STILL_MM = 0.004  # of the table at rest
TOLERATED_LOSS = 0.02
RAIL_SAMPLES = 3
RESOLVED = 0.2  # of a step: noise below it hides in the resolution
TOLD_STEPS = 1.0  # of noise, beyond which two readings in three differ
LEAST_NOISE_ROWS = 20
SIDE = 3  # rows beside a run of equal readings that tell of it, in lengths of the run
QUANTISATION = 1 / 50
SURE = 6.0
SCALE_TOLERANCE = 0.005  # of the travel: pitch and speed scale are known to that
ELASTIC_UM = 60.0  # a screw's wind-up, and backlash too small to be told


# travel of the position per travel of the integral of speed, and the unit that makes it so
UNITS_MISTAKEN: Mapping[float, str] = {
    1e3: "as a position in mm where m belong",
    1e6: "as a position in um where m belong",
    1e3 / 25.4: "as a position in inches where m belong",
    1e-3: "as a screw pitch in mm where m belong",
    math.pi / 30: "as a speed in 1/min where rad/s belong",
    math.pi / 180: "as a speed in degrees per second where rad/s belong",
    -1.0: "as a position that counts against the speed",
}
UNIT_TOLERANCE = 0.02
HOTTEST_C = 120.0  # no slide-way, screw or winding in service


def implausibilities(window: Window) -> list[Reason]:
    """Return every reason why this window must not be identified from, before any fit; empty when it is plausible."""
    reasons = list(_not_finite(window)) + list(_stages(window))
    if window.n < 32 or any(reason.code == "NotFinite" for reason in reasons):
        return reasons
    reasons += list(_gaps(window))
    reasons += list(_clipped(window))
    play = backlash(window)
    parted = list(_position(window, play.um if play is not None else 0.0))
    # what position tells of the move's course is worth nothing where it contradicts the speed
    return reasons + (parted or list(interruptions(window)) + ([play.reason()] if play is not None else []))


def warnings_of(window: Window) -> list[Reason]:
    """Return what is worth telling but does not refuse the window: coarse quantisation, an odd temperature."""
    found = []
    for name, unit, values in signals_of(window):
        finite = values[np.isfinite(values)]
        span = float(np.ptp(finite)) if finite.size else 0.0
        step = resolution(finite)
        if span > 0 and step > QUANTISATION * span:
            text = f"{name} comes in steps of {step:.3g} {unit}, {100 * step / span:.1f} % of the range used"
            found.append(Reason("Quantised", text, "use a finer scale in the drive's mapping"))
    if window.temperature_c is not None and not -HOTTEST_C < window.temperature_c < HOTTEST_C:
        text = f"{window.temperature_c:g} degC is no temperature of a machine{_kelvin(window.temperature_c)}"
        found.append(Reason("Implausible", text, "give temperature_C in degrees Celsius, drift is told against it"))
    return found


def _kelvin(celsius: float) -> str:
    guess = celsius - 273.15
    return f"; {guess:.0f} degC in kelvin?" if -50.0 < guess < HOTTEST_C else ""


def signals_of(window: Window) -> Iterator[tuple[str, str, Float]]:
    """Yield name, unit and values (n,) of each signal that the window has."""
    if window.voltage_v is not None:
        yield "voltage", "V", window.voltage_v
    yield "current", "A", window.current_a
    yield "speed", "rad/s", window.speed_rad_s


def _lost(window: Window) -> Bool:
    """Return the rows (n,) that the window itself declares as lost."""
    lost = np.zeros(window.n, dtype=bool)
    for a, b in window.gaps:
        lost[a:b] = True
    return lost


def _not_finite(window: Window) -> Iterator[Reason]:
    lost = _lost(window)
    for name, _, values in signals_of(window):
        bad = ~np.isfinite(values) & ~lost
        if bad.any():
            text = f"{name} is not finite in {int(bad.sum())} rows, first at {_time(window, int(np.argmax(bad))):.3f} s"
            yield Reason("NotFinite", text, "check the sensor and its scaling")
    largest = max((float(np.abs(v[np.isfinite(v)]).max(initial=0.0)) for _, _, v in signals_of(window)), default=0.0)
    if largest > 1e9:
        yield Reason("NotFinite", f"a signal reaches {largest:.3g}, which no drive does", "check the scaling")


def _stages(window: Window) -> Iterator[Reason]:
    stages = window.stages
    for name, stage in (("accel", stages.accelerate), ("cruise", stages.cruise), ("brake", stages.brake)):
        if stage is None:
            what = {"accel": "acceleration", "cruise": "100 ms of constant speed", "brake": "braking to rest"}[name]
            yield Reason(f"MissingStage({name})", f"the move has no {what}", "record the whole of a longer rapid")


def _gaps(window: Window) -> Iterator[Reason]:
    a, b = moving_range(window)
    inside = [(g, h) for g, h in window.gaps if (g < b and h > a) or _travels(window, g, h)]
    rows = sum(h - g for g, h in inside)
    if rows and (max(h - g for g, h in inside) > TOLERATED_GAP or rows > TOLERATED_LOSS * (b - a)):
        text = f"{rows} of {b - a} samples of the move are lost, the first at {_time(window, inside[0][0]):.3f} s"
        yield Reason("StaleData", text, "find where frames are lost: bus load, receive buffer")


def _travels(window: Window, begin: int, end: int) -> bool:
    """Return whether the table moves while these rows are lost: the end of the move may lie within them."""
    beside = window.position_mm[[max(0, begin - 1), min(end, window.n - 1)]]
    return bool(abs(beside[1] - beside[0]) > STILL_MM)


def beyond_chance(values: Float, start: int, end: int) -> bool:
    """Return whether the readings of rows ``start`` to ``end``, all alike, are more than the rows about them explain.

    Either side may explain them: by how often it has that very reading (a constant read coarsely), or by how often it
    repeats its reading (a signal that creeps through the steps). Noise of several steps leaves neither.
    """
    length = end - start + 1
    chance = 0.0
    same, step = np.diff(values) == 0.0, resolution(values[np.isfinite(values)])
    sides = (slice(max(0, start - SIDE * length), start), slice(end + 1, end + 1 + SIDE * length))
    for others in (values[sides[0]], values[sides[1]], np.concatenate([values[:start], values[end + 1 :]])):
        # the rows beside may lie at the edge of a step, and the run in its middle
        chance = max(chance, likely_reading(others, step) ** length)
    for side in sides:
        # where noise goes through several steps, no reading comes often: what has this one was cut off as well
        if values[side].size >= length and noise_of(values[side]) < TOLD_STEPS * step:
            likely = all_within(length, values[side] == values[start]), all_within(length - 1, same[side])
            chance = max(chance, *likely)
    return values.size * chance < CHANCE


def likely_reading(values: Float, step: float) -> float:
    """Return how likely a constant with the noise of ``values`` is read alike at most: in the middle of a ``step``."""
    third = np.diff(values, 3)
    third = third[np.isfinite(third)]
    if third.size < LEAST_NOISE_ROWS or step == 0.0:
        return 0.0
    # what is read in steps has the steps' own scatter too
    variance = float(np.mean(third**2)) / 20.0 - step**2 / 12
    return alike(math.sqrt(max(variance, (RESOLVED * step) ** 2)) / step)


def all_within(length: int, others: Bool) -> float:
    """Return how likely ``length`` given rows all have what these and ``others`` have as often as they do, anywhere.

    Exact for rows that may be exchanged for each other (Fisher): no level of noise is needed.
    """
    having, every = int(np.count_nonzero(others)), others.size
    log = math.lgamma(length + having + 1) - math.lgamma(having + 1)
    log += math.lgamma(every + 1) - math.lgamma(length + every + 1)
    return math.exp(log)


def wakes_with_a_jump(part: Float, start: int, end: int) -> bool:
    """Return whether the signal goes on after a run of repeats by more than it ever changes otherwise."""
    change = np.abs(np.diff(part))
    if end >= change.size:
        return False
    others = np.concatenate([change[:start], change[end + 1 :]])
    others = others[np.isfinite(others)]
    return others.size > 0 and bool(change[end] > 2 * others.max(initial=0.0))


def _clipped(window: Window) -> Iterator[Reason]:
    for name, unit, values in signals_of(window):
        if not np.isfinite(values).any():
            continue
        for rail, side in ((np.nanmax(values), "upper"), (np.nanmin(values), "lower")):
            at_rail = values == rail
            start, end = longest(at_rail)
            if rail == 0.0 or end - start < RAIL_SAMPLES or not beyond_chance(values, start, end - 1):
                continue
            text = (
                f"{name} stays at its {side} extreme {rail:.6g} {unit} for {end - start} samples "
                f"from {_time(window, start):.3f} s"
            )
            yield Reason("Saturated", text, "use a larger measuring range")


def _position(window: Window, play_um: float) -> Iterator[Reason]:
    """Compare the position with the integral of speed: a hidden gap, a stuck signal or a wrong scale shows up.

    ``play_um`` is the backlash that the window shows, by which both may part.
    """
    if not np.isfinite(window.position_mm).any() or np.ptp(carried(window.position_mm)) == 0.0:
        return
    to_mm = window.pitch_mm / (2 * math.pi)
    # lost rows are bridged for this comparison alone
    speed, position = _bridged(window.speed_rad_s), _bridged(window.position_mm)
    travel = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2)]) * window.dt_s * to_mm
    noise = noise_levels(window).speed_rad_s * window.dt_s * to_mm
    quantum = max(resolution(position), 1e-6)
    error = position - position[0] - travel
    unit = _unit(travel, error)
    if unit is not None:
        yield unit
        return
    elastic = 1e-3 * (ELASTIC_UM + 1.5 * play_um)
    yield from _jump(window, error, noise, quantum, elastic)
    yield from _scale(travel, error, noise, quantum, elastic)


def _bridged(values: Float) -> Float:
    known = np.isfinite(values)
    if known.all():
        return values
    bridged: Float = np.interp(np.arange(values.size), np.flatnonzero(known), values[known])
    return bridged


def _jump(window: Window, error: Float, noise: float, quantum: float, elastic: float) -> Iterator[Reason]:
    """Find the stretch over which position and integral part most beyond noise, at any length up to 100 ms."""
    worst, where, amount = 0.0, 0, 0.0
    for seconds in (0.0, 0.005, 0.02, 0.05, 0.1):
        length = max(1, round(seconds / window.dt_s))
        if length >= error.size:
            continue
        change = np.abs(error[length:] - error[:-length])
        allowed = SURE * np.hypot(noise * np.sqrt(length + 1), quantum) + elastic
        k = int(np.argmax(change))
        if change[k] / allowed > worst:
            worst, where, amount = float(change[k] / allowed), k, float(change[k])
    if worst > 1.0:
        text = f"position and the integral of speed part by {1e3 * amount:.0f} um at {_time(window, where):.3f} s"
        yield Reason("Implausible", text, "samples are lost or repeated there: check counters and time stamps")


def _unit(travel: Float, error: Float) -> Reason | None:
    """Return the unit that explains how position and integral of speed differ, where one does."""
    whole = float(travel[-1])
    times = 1.0 + float(error[-1]) / whole if whole else 1.0
    for factor, meaning in UNITS_MISTAKEN.items():
        if abs(times / factor - 1.0) < UNIT_TOLERANCE:
            text = f"the position travels {times:.4g} times the integral of speed, {meaning}"
            return Reason("CalibrationSuspect", text, "correct the unit where the recording is made")
    return None


def _scale(travel: Float, error: Float, noise: float, quantum: float, elastic: float) -> Iterator[Reason]:
    whole = abs(float(travel[-1]))
    allowed = SURE * np.hypot(noise * np.sqrt(error.size), quantum) + SCALE_TOLERANCE * whole + elastic
    if whole > 0 and abs(float(error[-1])) > allowed:
        share = 100 * float(error[-1]) / whole
        text = f"the position travels {share:+.2f} % more than the integral of speed"
        yield Reason("CalibrationSuspect", text, "check the screw's pitch, the speed scale and lost samples")


def at_rest(window: Window) -> Bool:
    """Return the rows (n,) in which the table surely stands still, from position and smoothed speed."""
    position = carried(window.position_mm)
    reach = max(1, round(0.010 / window.dt_s))
    ahead, behind = np.roll(position, -reach), np.roll(position, reach)
    still = (np.abs(ahead - position) < STILL_MM) & (np.abs(behind - position) < STILL_MM)
    still[:reach] &= np.abs(position[:reach] - position[0]) < STILL_MM
    still[-reach:] &= np.abs(position[-reach:] - position[-1]) < STILL_MM
    slow = np.abs(smooth(window.speed_rad_s, window.dt_s)) < 0.02 * window.rapid_speed_rad_s
    return still & slow & np.isfinite(window.speed_rad_s)


def _time(window: Window, row: int) -> float:
    return window.start_s + row * window.dt_s
