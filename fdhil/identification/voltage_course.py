"""Tells how the voltage runs within the rows of a rapid: it is the regulators' doing, and with them it is known.

The closed loop is run along the demand once more, by speed-loop cycles. Of a row's voltage its mean is measured; its
course about that mean is taken from the run, as the one ramp that moves the current as far as the course does.
"""

from __future__ import annotations

import math

import numpy as np

from fdhil.config import Axis
from fdhil.identification.loop_replay import Rapid, fitting_periods, rapid_of, standing, with_regulators
from fdhil.model import closed_loop
from fdhil.model.feed_drive import discretise
from fdhil.records import Float, Parameters, Window


def voltage_course(axis: Axis, parameters: Parameters, window: Window) -> Float | None:
    """Return by how much the voltage rises over each row (n,) of a window beyond the back-EMF, V.

    ``axis`` has the drive's own regulators, whose set-points come with every row. None where demand, position and
    current are not all recorded.
    """
    rapid = rapid_of(window, parameters)
    if rapid is None:
        return None
    drive = with_regulators(axis, **fitting_periods(axis.regulators, rapid.dt_s))
    parts = round(rapid.dt_s / drive.regulators.speed_period_s)
    voltage, speed = _run(rapid, drive, parts)
    by_row = voltage[: voltage.size // parts * parts].reshape(-1, parts)
    about = by_row - by_row.mean(axis=1, keepdims=True)
    rise = about @ _weights(parameters, rapid.dt_s, parts)
    course = np.zeros(window.n)
    emf = parameters.K * np.diff(speed[::parts])[: rise.size]
    course[rapid.first : rapid.first + rise.size] = rise - emf
    return course


def _weights(p: Parameters, row_s: float, parts: int) -> Float:
    """Return (parts,) what each part's voltage counts in the ramp over the row that has the same end current."""
    part, row = discretise(p, row_s / parts), discretise(p, row_s)
    answers, through = np.empty(parts), np.eye(2)
    for j in reversed(range(parts)):
        answers[j] = (through @ part.mean)[0, 0]
        through = through @ part.phi
    return np.asarray(answers / row.ramp[0, 0])


def _run(rapid: Rapid, axis: Axis, parts: int) -> tuple[Float, Float]:
    """Return the mean voltage over each speed-loop cycle (m - 1,) and the speed at its instants (m,), rad/s.

    The rows are cut into cycles, so that what is fed forward goes as offsets: of finer rows it would be another one.
    """
    g, plant, rad_per_mm = axis.regulators, rapid.plant, 2 * math.pi / axis.screw_pitch_mm
    place, rate, bend = _ordered(rapid, parts, axis)
    share = 0.0 if g.structure == "pid" else g.speed_feedforward
    drive = with_regulators(
        axis,
        setpoint_filter_s=0.0,
        torque_feedforward=0.0,
        **({} if g.structure == "pid" else {"speed_feedforward": 0.0}),
    )
    answer = closed_loop.simulate(
        plant,
        drive,
        g.speed_period_s,
        place,
        speed_offset_rad_s=share * rad_per_mm * rate,
        torque_offset_nm=g.torque_feedforward * axis.nominal.Jt * rad_per_mm * bend,
        state=standing(rapid, axis),
    )
    current, h = answer.current_a, g.speed_period_s
    emf = plant.K * rad_per_mm * np.diff(answer.position_mm) / h
    return plant.R * (current[1:] + current[:-1]) / 2 + plant.L * np.diff(current) / h + emf, answer.speed_rad_s


def _ordered(rapid: Rapid, parts: int, axis: Axis) -> tuple[Float, Float, Float]:
    """Return set-point (mm), its speed and acceleration at the speed-loop instants, behind the filter on them."""
    r, t = rapid.demand_mm, rapid.dt_s
    held = np.concatenate([r, [r[-1], r[-1]]])
    slope = np.diff(held) / t
    part = np.tile(np.arange(parts) / parts, r.size)
    row = np.repeat(np.arange(r.size), parts)
    bend = np.diff(slope)[row]
    signals = [r[row] + slope[row] * t * part, slope[row] + bend * part, bend / t]
    g = axis.regulators
    if g.setpoint_filter_s > 0.0:
        decay = math.exp(-g.speed_period_s / g.setpoint_filter_s)
        signals = [_filtered(s, decay, g.setpoint_filter_order) for s in signals]
    return signals[0], signals[1], signals[2]


def _filtered(values: Float, decay: float, order: int) -> Float:
    for _ in range(order):
        kept, out = float(values[0]), np.empty_like(values)
        for k, value in enumerate(values.tolist()):
            kept = decay * kept + (1.0 - decay) * value
            out[k] = kept
        values = out
    return values
