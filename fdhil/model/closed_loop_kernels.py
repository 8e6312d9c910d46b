"""Compiled kernels of the closed-loop model: plain numbers in, plain numbers out, run without the interpreter's lock.

All compiled code of the drives is in this file, whatever their structure: numba renews its cache of a compiled function
when the function's own file changes, not when a file that it calls changes.
"""

from __future__ import annotations

import numpy as np

from fdhil.model.numba_decorators import compile_inline_kernel, compile_kernel
from fdhil.records import Float

# indices of the state vector: those of every drive, then those that structures and options add
CURRENT, SPEED, POSITION, SPEED_INTEGRAL, CURRENT_INTEGRAL, CURRENT_DEMAND = range(6)
POSITION_INTEGRAL, SET_POINT_BEFORE, POSITION_BEFORE, FILTERED, SPEED_FILTERED = 6, 7, 8, 9, 15
TABLE, TABLE_SPEED = 16, 17  # a table behind a spring
BRISTLE, NEXT, WAITING = 18, 19, 20  # presliding friction, N.m; ring index and ring of delayed voltages
MOST_WAITING = 32
STATES = WAITING + MOST_WAITING
# rows recorded at each SYNC instant: the number of the cycle's steps with a limit acting, then the state
ROW_LIMITED, ROW_STATE = range(2)
# indices of the gains, see fdhil.model.closed_loop_drive.pack_gains
KV, KFF, SPEED_KP, SPEED_KI, CURRENT_MAX, CURRENT_KP, CURRENT_KI, VOLTAGE_MAX, PERIOD, HALF_STEP_MM = range(10)
POSITION_KI, ACCELERATION, DECAY, RAD_PER_MM, SPEED_CYCLES_PER_S, SPEED_DECAY, FULL_DEAD_TIME_A = range(10, 17)
# LinuxCNC's pid: gains of its terms, output limit (0: none), error-previous-target and speed loop as 0 or 1
DERIVATIVE, FF0, FF2, FF3, DEADBAND_MM, OUTPUT_MAX, PREVIOUS_TARGET, SPEED_LOOP = range(17, 25)
GAINS = 25
# indices of the terms, see fdhil.model.model_terms.pack_terms; then periods per turn, amplitude and phase of each
# ripple
LOAD, DRY_POSITIVE, DRY_NEGATIVE, VISCOUS, VISCOUS_POSITIVE, VISCOUS_NEGATIVE, STRIBECK, STRIBECK_SPEED = range(8)
DEAD_TIME, SPRING, DAMPER, PRESLIDING, RIPPLES = range(8, 13)
STRIBECK_REACH = 6.0  # times its speed; beyond it the Stribeck part is below the last bit of the friction
# control laws from set-point to current demand
CASCADE, PID, LINUXCNC = range(3)
# further memory of LinuxCNC's pid, in elements of the set-point filter that it does not have
COMMAND_SPEED, COMMAND_ACCELERATION, OUTPUT, OUTPUT_LIMITED = 10, 11, 13, 14
# rows of the map over a speed cycle, see fdhil.model.multi_cycle_step, for a moving and for a held table, with its
# bounds
LEAP_CURRENT, LEAP_SPEED, LEAP_INTEGRAL, LEAP_WAY, LEAP_TURN, LEAP_VOLTAGE = range(6)
HELD_CURRENT, HELD_INTEGRAL, HELD_BREAK, HELD_VOLTAGE, LEAP_RESISTANCE = range(6, 11)
LEAP_ROWS, LEAP_COLUMNS = 11, 5


@compile_kernel
def _filter_speed_feedback(speed: float, state: Float, gains: Float) -> float:
    """Return the speed behind the feedback filter, whose memory is in the state."""
    if gains[SPEED_DECAY] > 0.0:
        speed = gains[SPEED_DECAY] * state[SPEED_FILTERED] + (1.0 - gains[SPEED_DECAY]) * speed
        state[SPEED_FILTERED] = speed
    return speed


@compile_kernel
def _compute_cascade_demand(
    place: float, rate: float, speed: float, state: Float, gains: Float
) -> tuple[float, float, float]:
    """Compute P or PI on position, PI on speed; return the current demand and both integrals as if no limit acted.

    ``place`` mm is the set-point, ``rate`` rad/s the speed fed forward, ``speed`` rad/s the filtered speed feedback.
    """
    lag = place - state[POSITION]
    integral = state[POSITION_INTEGRAL] + gains[POSITION_KI] * lag
    error = gains[KV] * lag + integral + rate - speed
    candidate = state[SPEED_INTEGRAL] + gains[SPEED_KI] * error
    return gains[SPEED_KP] * error + candidate, candidate, integral


@compile_kernel
def _compute_pid_demand(
    place: float, rate: float, turned: float, state: Float, gains: Float
) -> tuple[float, float, float]:
    """Compute PID on position; return the current demand, a zero speed integral, and the position integral.

    The derivative is the difference of Kff times set-point less position over one cycle; ``rate`` rad/s adds to it.
    ``turned`` rad is the change of position after the speed-feedback filter.
    """
    lag = place - state[POSITION]
    integral = state[POSITION_INTEGRAL] + gains[POSITION_KI] * lag
    moved = gains[KFF] * (place - state[SET_POINT_BEFORE]) - turned
    state[SET_POINT_BEFORE] = place
    state[POSITION_BEFORE] = state[POSITION]
    speed = gains[KV] * lag + integral + gains[SPEED_CYCLES_PER_S] * moved + rate
    return gains[SPEED_KP] * speed, 0.0, integral


@compile_kernel
def _update_linuxcnc_pid(place: float, state: Float, gains: Float) -> None:
    """Compute the output (rad/s) of LinuxCNC's pid component (2.9, hal/components/pid.c) once, into the state."""
    period, per_mm = gains[PERIOD], gains[RAD_PER_MM]
    error = (state[SET_POINT_BEFORE] if gains[PREVIOUS_TARGET] > 0.0 else place) - state[POSITION]
    deadband = gains[DEADBAND_MM]
    error = error - deadband if error > deadband else error + deadband if error < -deadband else 0.0
    if error * state[OUTPUT_LIMITED] <= 0.0:
        state[POSITION_INTEGRAL] += gains[POSITION_KI] * error
    speed = (place - state[SET_POINT_BEFORE]) / period
    acceleration = (speed - state[COMMAND_SPEED]) / period
    jerk = (acceleration - state[COMMAND_ACCELERATION]) / period
    closing = speed - (state[POSITION] - state[POSITION_BEFORE]) / period
    out = gains[KV] * error + state[POSITION_INTEGRAL] + gains[DERIVATIVE] * per_mm * closing
    out += gains[FF0] * per_mm * place + gains[KFF] * speed
    out += per_mm * (gains[FF2] * acceleration + gains[FF3] * jerk)
    state[OUTPUT_LIMITED] = 0.0
    if gains[OUTPUT_MAX] > 0.0 and abs(out) > gains[OUTPUT_MAX]:
        state[OUTPUT_LIMITED] = np.sign(out)
        out = gains[OUTPUT_MAX] * np.sign(out)
    state[SET_POINT_BEFORE], state[POSITION_BEFORE], state[OUTPUT] = place, state[POSITION], out
    state[COMMAND_SPEED], state[COMMAND_ACCELERATION] = speed, acceleration


@compile_kernel
def _compute_drive_demand(speed: float, more: float, state: Float, gains: Float) -> tuple[float, float]:
    """Return current demand and speed integral of a drive that receives the output of LinuxCNC's pid.

    A drive with a speed loop closes it at its own cycle; one without uses the output as its current demand.
    """
    wanted = state[OUTPUT] + more
    if gains[SPEED_LOOP] == 0.0:
        return gains[SPEED_KP] * wanted, 0.0
    candidate = state[SPEED_INTEGRAL] + gains[SPEED_KI] * (wanted - speed)
    return gains[SPEED_KP] * (wanted - speed) + candidate, candidate


@compile_kernel
def _filter_setpoint(place: float, rate: float, bend: float, order: int, decay: float, state: Float) -> None:
    """Filter set-point, speed and acceleration by ``order`` equal first-order filters, in place in the state."""
    for n in range(order):
        at = FILTERED + 3 * n
        place = decay * state[at] + (1.0 - decay) * place
        rate = decay * state[at + 1] + (1.0 - decay) * rate
        bend = decay * state[at + 2] + (1.0 - decay) * bend
        state[at], state[at + 1], state[at + 2] = place, rate, bend


@compile_inline_kernel
def _compute_ripple_torque(angle: float, terms: Float) -> float:
    torque = 0.0
    for n in range(RIPPLES, terms.size, 3):
        torque += terms[n + 1] * np.sin(terms[n] * angle + terms[n + 2])
    return torque


@compile_inline_kernel
def _compute_stribeck_torque(w: float, stribeck: float, stribeck_speed: float) -> float:
    """Return the part of dry friction that exists at low speed only, N.m."""
    if stribeck == 0.0 or abs(w) > STRIBECK_REACH * stribeck_speed:
        return 0.0
    return float(stribeck * np.exp(-((w / stribeck_speed) ** 2)))


@compile_kernel
def compute_friction_torque(speed: Float, angle: Float, terms: Float) -> Float:
    """Return the torque (n,) against the positive direction at speeds rad/s and angles rad of the motor, (n,) each."""
    out = np.empty(speed.size)
    for n in range(speed.size):
        w = speed[n]
        dry = terms[DRY_POSITIVE] if w > 0.0 else terms[DRY_NEGATIVE]
        dry += _compute_stribeck_torque(w, terms[STRIBECK], terms[STRIBECK_SPEED])
        viscous = terms[VISCOUS_POSITIVE] if w > 0.0 else terms[VISCOUS_NEGATIVE]
        out[n] = terms[LOAD] + np.sign(w) * dry + viscous * w + _compute_ripple_torque(angle[n], terms)
    return out


@compile_inline_kernel
def _step_two_mass_row(
    step: Float, row: int, i: float, w: float, apart: float, table_w: float, u: float, against: float, dry: float
) -> float:
    """Apply one row of the two-mass step to a state; ``apart`` is motor less table position."""
    moved = step[row, 0] * i + step[row, 1] * w + step[row, 2] * apart + step[row, 3] * table_w
    return float(moved + step[row, 5] * u - step[row, 6] * against - step[row, 7] * dry)


@compile_kernel
def _run_current_cycles(
    demand_a: float,
    limited: bool,
    plant: Float,
    masses: Float | None,
    gains: Float,
    terms: Float | None,
    n_current: int,
    delay: int,
    state: Float,
) -> int:
    """Run the current loop and the plant for one speed cycle; return the number of steps with a limit acting.

    ``limited``: the current demand is at its limit. The voltage acts ``delay`` steps after it was computed, less the
    inverter's dead time. Ripples are evaluated at the middle of each step. ``masses`` (2, 5, 8), or None for a rigid
    screw, is the exact step of motor and table, free and with the table held; dry friction then acts on the table.
    Branches of None arguments are not compiled. Dry friction with presliding is the force of a bristle (Dahl 1968): it
    builds up with displacement until it reaches sliding friction, and nothing sticks.
    """
    phi_ii, phi_iw, phi_wi, phi_ww, phi_xi, phi_xw = plant[0], plant[1], plant[2], plant[3], plant[4], plant[5]
    i_u, w_u, x_u, i_t, w_t, x_t = plant[6], plant[7], plant[8], plant[9], plant[10], plant[11]
    still, still_u, torque_constant, dry = plant[12], plant[13], plant[14], plant[15]
    kp, ki, voltage_max, half_step_mm = gains[CURRENT_KP], gains[CURRENT_KI], gains[VOLTAGE_MAX], gains[HALF_STEP_MM]
    i, w, x, integral = state[CURRENT], state[SPEED], state[POSITION], state[CURRENT_INTEGRAL]
    steps, at = 0, int(state[NEXT])
    if terms is not None:
        load, viscous, dead_v, slow = terms[LOAD], terms[VISCOUS], terms[DEAD_TIME], terms[STRIBECK]
        positive, negative, slow_speed = terms[DRY_POSITIVE], terms[DRY_NEGATIVE], terms[STRIBECK_SPEED]
        more_positive, more_negative = terms[VISCOUS_POSITIVE] - viscous, terms[VISCOUS_NEGATIVE] - viscous
        rad_per_mm, full_a = gains[RAD_PER_MM], gains[FULL_DEAD_TIME_A]
        spring, damper, table_w, table = terms[SPRING] * rad_per_mm, terms[DAMPER], state[TABLE_SPEED], state[TABLE]
        bristle, sliding = state[BRISTLE], 0.0
        if terms[PRESLIDING] > 0.0:
            sliding = 2e3 * half_step_mm / terms[PRESLIDING]
    for _ in range(n_current):
        error = demand_a - i
        candidate = integral + ki * error
        raw = kp * error + candidate
        u = min(max(raw, -voltage_max), voltage_max)
        if u == raw:
            integral = candidate
            if limited:
                steps += 1
        else:
            steps += 1
        if delay > 0:
            u, state[WAITING + at] = state[WAITING + at], u
            at = at + 1 if at + 1 < delay else 0
        against, push, rubbing = 0.0, torque_constant * i, w
        if terms is not None:
            if dead_v != 0.0:
                u -= dead_v * min(max(i / full_a, -1.0), 1.0)
            against = load + (more_positive if w > 0.0 else more_negative) * w
            if terms.size > RIPPLES:
                against += _compute_ripple_torque(rad_per_mm * (x + half_step_mm * w), terms)
            push -= against
            if masses is not None:
                rubbing, push = table_w, spring * (x - table) + damper * w
        # one friction sign per step: that of the motion, or of the motion that the torque will start
        forward = rubbing > 0.0 or (rubbing == 0.0 and push > 0.0)
        if terms is not None:
            dry = (positive if forward else negative) + _compute_stribeck_torque(rubbing, slow, slow_speed)
        friction = -dry if forward else dry
        held = rubbing == 0.0 and abs(push) <= dry
        builds_up = False
        if terms is not None and sliding > 0.0:
            bristle = -friction + (bristle + friction) * np.exp(-abs(rubbing) * sliding)
            friction, held, builds_up = -bristle, False, True
        if masses is not None:
            m, apart = masses[1 if held else 0], x - table
            table_next = _step_two_mass_row(m, 3, i, w, apart, table_w, u, against, -friction)
            moved = _step_two_mass_row(m, 4, i, w, apart, table_w, u, against, -friction)
            if table_next * friction > 0.0 and not builds_up:
                moved, table_next = half_step_mm * table_w, 0.0
            w_next = _step_two_mass_row(m, 1, i, w, apart, table_w, u, against, -friction)
            x = table + _step_two_mass_row(m, 2, i, w, apart, table_w, u, against, -friction)
            i = _step_two_mass_row(m, 0, i, w, apart, table_w, u, against, -friction)
            w, table, table_w = w_next, table + moved, table_next
            continue
        if held:
            i = still * i + still_u * u
            continue
        total = friction - against
        w_next = phi_wi * i + phi_ww * w + w_u * u + w_t * total
        if w_next * friction > 0.0 and not builds_up:  # reversal: the table stops for this step
            x += half_step_mm * w
            w_next = 0.0
        else:
            x += phi_xi * i + phi_xw * w + x_u * u + x_t * total
        i = phi_ii * i + phi_iw * w + i_u * u + i_t * total
        w = w_next
    state[CURRENT], state[SPEED], state[POSITION], state[CURRENT_INTEGRAL] = i, w, x, integral
    state[NEXT] = at
    if terms is not None:
        state[BRISTLE] = bristle
    if masses is not None:
        state[TABLE_SPEED], state[TABLE] = table_w, table
    return steps


@compile_kernel
def _interpolate_row(values: Float, k: int, part: float) -> float:
    """Return the value ``part`` of the way from sample k to k + 1; the last value is held beyond the end."""
    last = values.size - 1
    low = values[min(k, last)]
    return float(low + (values[min(k + 1, last)] - low) * part)


@compile_inline_kernel
def _bound_moving_voltage(
    i: float, w: float, integral: float, demand_a: float, friction: float, unit: float, plant: Float, leap: Float
) -> float:
    """Return a bound on the voltage demanded of a moving table in a speed cycle; inf where it may reverse.

    ``friction`` N.m acts against the positive direction; ``unit`` is its size in units of the map's friction.
    """
    net = abs(i - friction / plant[14])
    e, q, ai, aw = abs(demand_a - i), abs(integral - leap[LEAP_RESISTANCE, 0] * i - plant[14] * w), abs(i), abs(w)
    turn = leap[LEAP_TURN, 0] * net + leap[LEAP_TURN, 1] * aw + leap[LEAP_TURN, 2] * e + leap[LEAP_TURN, 3] * q
    if unit > 0.0 and not aw > turn + leap[LEAP_TURN, 4] * unit:
        return float(np.inf)
    peak = leap[LEAP_VOLTAGE, 0] * ai + leap[LEAP_VOLTAGE, 1] * aw + leap[LEAP_VOLTAGE, 2] * e
    return float(peak + leap[LEAP_VOLTAGE, 3] * q + leap[LEAP_VOLTAGE, 4] * unit)


@compile_inline_kernel
def _bound_holding_voltage(i: float, integral: float, demand_a: float, room: float, plant: Float, leap: Float) -> float:
    """Return a bound on the voltage demanded of a held table; inf where it may break loose.

    ``room`` N.m is the change of motor torque up to which the table stays held.
    """
    ai, e, q = abs(i), abs(demand_a - i), abs(integral - leap[LEAP_RESISTANCE, 0] * i)
    if not plant[14] * (leap[HELD_BREAK, 2] * e + leap[HELD_BREAK, 3] * q) <= room:
        return float(np.inf)
    return float(leap[HELD_VOLTAGE, 0] * ai + leap[HELD_VOLTAGE, 2] * e + leap[HELD_VOLTAGE, 3] * q)


@compile_inline_kernel
def _apply_map_row(leap: Float, row: int, i: float, w: float, integral: float, demand_a: float, side: float) -> float:
    moved = leap[row, 0] * i + leap[row, 1] * w + leap[row, 2] * integral
    return float(moved + leap[row, 3] * demand_a + leap[row, 4] * side)


@compile_inline_kernel
def _bound_cycle_voltage(
    i: float, w: float, integral: float, demand_a: float, plant: Float, leap: Float
) -> tuple[float, float]:
    """Return a bound on the voltage of a speed cycle (inf: not linear), and the friction sign, 0 for a held table."""
    dry = plant[15]
    if w == 0.0 and dry > 0.0:
        return _bound_holding_voltage(i, integral, demand_a, dry - plant[14] * abs(i), plant, leap), 0.0
    side = 1.0 if w > 0.0 else -1.0
    return _bound_moving_voltage(i, w, integral, demand_a, side * dry, 1.0 if dry > 0.0 else 0.0, plant, leap), side


@compile_inline_kernel
def _average_torque(
    i: float, w: float, x: float, half_mm: float, faster: float, plant: Float, rad_per_mm: float, terms: Float
) -> float:
    """Return the mean torque against the positive direction over a speed cycle in which the table moves.

    ``half_mm`` is the travel in half a cycle at 1 rad/s, ``faster`` the speed gained in that time per N.m. Ripples are
    averaged; friction is evaluated at the middle of the cycle.
    """
    side = 1.0 if w > 0.0 else -1.0
    dry = terms[DRY_POSITIVE] if w > 0.0 else terms[DRY_NEGATIVE]
    viscous = (terms[VISCOUS_POSITIVE] if w > 0.0 else terms[VISCOUS_NEGATIVE]) - terms[VISCOUS]
    middle = w + faster * (plant[14] * i - terms[LOAD] - side * dry)
    if middle * side <= 0.0:
        middle = w
    mean = (
        terms[LOAD]
        + side * (dry + _compute_stribeck_torque(middle, terms[STRIBECK], terms[STRIBECK_SPEED]))
        + viscous * middle
    )
    for n in range(RIPPLES, terms.size, 3):
        turned = terms[n] * rad_per_mm * half_mm * middle
        ripple = np.sin(terms[n] * rad_per_mm * (x + 0.5 * half_mm * (w + middle)) + terms[n + 2])
        mean += terms[n + 1] * ripple * (np.sin(turned) / turned if turned != 0.0 else 1.0)
    return float(mean)


@compile_inline_kernel
def _advance_speed_cycle(
    i: float, w: float, integral: float, demand_a: float, side: float, held: bool, leap: Float
) -> tuple[float, float, float]:
    """Return current, speed and current integral after a speed cycle."""
    if held:
        return (
            _apply_map_row(leap, HELD_CURRENT, i, w, integral, demand_a, side),
            0.0,
            _apply_map_row(leap, HELD_INTEGRAL, i, w, integral, demand_a, side),
        )
    return (
        _apply_map_row(leap, LEAP_CURRENT, i, w, integral, demand_a, side),
        _apply_map_row(leap, LEAP_SPEED, i, w, integral, demand_a, side),
        _apply_map_row(leap, LEAP_INTEGRAL, i, w, integral, demand_a, side),
    )


@compile_kernel
def _run_multi_cycle_steps(
    reference: Float,
    current_offset: Float,
    first: int,
    plant: Float,
    leap: Float,
    gains: Float,
    terms: Float | None,
    shape: tuple[int, int, int, int, int, int],
    state: Float,
    out: Float,
) -> None:
    """Run a cascade without delay or speed offsets as :func:`run` does, one map per speed cycle where linear.

    With terms, a map uses the mean of their torque; a constant voltage loss becomes a change of the integral. ``out``
    (1 + kept, rows) is written. The state is kept in local variables: memory access would dominate the run time.
    """
    kept, n_speed, n_current, order, last = shape[1], shape[2], shape[3], shape[4], reference.size - 1
    kv, kff, speed_kp, speed_ki, position_ki = (
        gains[KV],
        gains[KFF],
        gains[SPEED_KP],
        gains[SPEED_KI],
        gains[POSITION_KI],
    )
    period, current_max, voltage_max = gains[PERIOD], gains[CURRENT_MAX], gains[VOLTAGE_MAX]
    decay, seen = gains[SPEED_DECAY], state[SPEED_FILTERED]
    i, w, x, demand_a = state[CURRENT], state[SPEED], state[POSITION], state[CURRENT_DEMAND]
    speeds, currents, places = state[SPEED_INTEGRAL], state[CURRENT_INTEGRAL], state[POSITION_INTEGRAL]
    if terms is not None:
        rad_per_mm, load, dead_v, full_a = gains[RAD_PER_MM], terms[LOAD], terms[DEAD_TIME], gains[FULL_DEAD_TIME_A]
        positive, negative, slow = terms[DRY_POSITIVE], terms[DRY_NEGATIVE], terms[STRIBECK]
        half_mm, faster = gains[HALF_STEP_MM] * n_current, plant[10] * (0.5 * n_current)
    for row in range(out.shape[1]):
        k = first + row
        r0, r1, r2 = reference[min(k, last)], reference[min(k + 1, last)], reference[min(k + 2, last)]
        slope = (r1 - r0) / period
        bend = (r2 - r1) / period - slope
        forward = gains[ACCELERATION] * (bend / period)
        out[ROW_STATE + CURRENT, row], out[ROW_STATE + SPEED, row], out[ROW_STATE + POSITION, row] = i, w, x
        out[ROW_STATE + SPEED_INTEGRAL, row], out[ROW_STATE + CURRENT_INTEGRAL, row] = speeds, currents
        out[ROW_STATE + CURRENT_DEMAND, row] = demand_a
        if kept > POSITION_INTEGRAL:
            out[ROW_STATE + POSITION_INTEGRAL, row] = places
            state[SPEED_FILTERED] = seen
            for n in range(SET_POINT_BEFORE, kept):
                out[ROW_STATE + n, row] = state[n]
        limited = 0
        for m in range(n_speed):
            part = m / n_speed
            wanted, rate = r0 + (r1 - r0) * part, slope + bend * part
            if order > 0:
                _filter_setpoint(wanted, rate, bend / period, order, gains[DECAY], state)
                at = FILTERED + 3 * (order - 1)
                wanted, rate, forward = state[at], state[at + 1], gains[ACCELERATION] * state[at + 2]
            lag = wanted - x
            place = places + position_ki * lag
            seen = decay * seen + (1.0 - decay) * w
            error = kv * lag + place + kff * rate - seen
            candidate = speeds + speed_ki * error
            raw = speed_kp * error + candidate + forward
            if current_offset.size > 0:
                raw += _interpolate_row(current_offset, k, part)
            demand_a = min(max(raw, -current_max), current_max)
            if demand_a == raw:
                speeds, places = candidate, place
            lost_v = 0.0
            if terms is None:
                may, side = _bound_cycle_voltage(i, w, currents, demand_a, plant, leap)
                held = side == 0.0
            else:
                lost_v, held = dead_v if i > 0.0 else -dead_v, w == 0.0
                left, side, may = currents - lost_v, 0.0, np.inf
                if dead_v != 0.0 and (min(abs(i), abs(demand_a)) < full_a or i * demand_a < 0.0):
                    pass  # the dead-time voltage changes within the cycle
                elif held:
                    push = plant[14] * i - load - _compute_ripple_torque(rad_per_mm * x, terms)
                    room = min(positive - push, negative + push) + slow
                    may = _bound_holding_voltage(i, left, demand_a, room, plant, leap)
                else:
                    side = _average_torque(i, w, x, half_mm, faster, plant, rad_per_mm, terms)
                    if w * _apply_map_row(leap, LEAP_SPEED, i, w, left, demand_a, side) > 0.0:
                        may = _bound_moving_voltage(i, w, left, demand_a, side, abs(side), plant, leap)
            if may <= voltage_max - abs(lost_v):
                limited += n_current if demand_a != raw else 0
                if not held:
                    x += _apply_map_row(leap, LEAP_WAY, i, w, currents - lost_v, demand_a, side)
                i, w, currents = _advance_speed_cycle(i, w, currents - lost_v, demand_a, side, held, leap)
                currents += lost_v
            else:
                state[CURRENT], state[SPEED], state[POSITION], state[CURRENT_INTEGRAL] = i, w, x, currents
                clipped = demand_a != raw
                limited += _run_current_cycles(demand_a, clipped, plant, None, gains, terms, n_current, 0, state)
                i, w, x, currents = state[CURRENT], state[SPEED], state[POSITION], state[CURRENT_INTEGRAL]
        out[ROW_LIMITED, row] = limited
    state[CURRENT], state[SPEED], state[POSITION], state[CURRENT_DEMAND] = i, w, x, demand_a
    state[SPEED_INTEGRAL], state[CURRENT_INTEGRAL], state[POSITION_INTEGRAL] = speeds, currents, places
    state[SPEED_FILTERED] = seen if decay > 0.0 else 0.0


@compile_kernel
def run_sync_cycles(
    reference: Float,
    speed_offset: Float,
    current_offset: Float,
    first: int,
    rows: int,
    plant: Float,
    leap: Float,
    masses: Float | None,
    gains: Float,
    terms: Float | None,
    shape: tuple[int, int, int, int, int, int],
    state: Float,
) -> Float:
    """Run SYNC cycles ``first`` .. ``first + rows - 1``; return (1 + kept, rows), sampled at the start of each cycle.

    ``reference`` (n,) mm is held beyond its end; ``speed_offset`` rad/s and ``current_offset`` A are (n,) or empty.
    ``plant`` (16,), ``leap`` (LEAP_ROWS, LEAP_COLUMNS) or empty, and ``gains`` (GAINS,): see
    :mod:`fdhil.model.closed_loop_drive`.
    ``terms``, None for a plain drive, and ``masses``: see :mod:`fdhil.model.model_terms`. ``shape``: law, states
    recorded per
    cycle, speed cycles per SYNC cycle, current cycles per speed cycle, order of the set-point filter, current cycles of
    delay. ``state`` (STATES,) is written.
    """
    law, kept, n_speed, n_current, order, delay = shape
    last = reference.size - 1
    out = np.empty((ROW_STATE + kept, rows))
    if law == CASCADE and leap.size > 0 and speed_offset.size == 0:
        _run_multi_cycle_steps(reference, current_offset, first, plant, leap, gains, terms, shape, state, out)
        return out
    kff, period, current_max, filtered = gains[KFF], gains[PERIOD], gains[CURRENT_MAX], gains[SPEED_DECAY] > 0.0
    for row in range(rows):
        k = first + row
        r0, r1, r2 = reference[min(k, last)], reference[min(k + 1, last)], reference[min(k + 2, last)]
        rise = r1 - r0
        slope = rise / period
        bend = (r2 - r1) / period - slope
        limited = 0
        for n in range(kept):
            out[ROW_STATE + n, row] = state[n]
        for m in range(n_speed):
            part = m / n_speed
            place, rate, acceleration = r0 + rise * part, slope + bend * part, bend / period
            if order > 0:
                _filter_setpoint(place, rate, acceleration, order, gains[DECAY], state)
                at = FILTERED + 3 * (order - 1)
                place, rate, acceleration = state[at], state[at + 1], state[at + 2]
            more = _interpolate_row(speed_offset, k, part) if speed_offset.size > 0 else 0.0
            if law == CASCADE:
                speed = _filter_speed_feedback(state[SPEED], state, gains) if filtered else state[SPEED]
                raw, speed_integral, position_integral = _compute_cascade_demand(
                    place, kff * rate + more, speed, state, gains
                )
            elif law == LINUXCNC:
                if m == 0:
                    _update_linuxcnc_pid(r0, state, gains)
                speed = _filter_speed_feedback(state[SPEED], state, gains) if filtered else state[SPEED]
                raw, speed_integral = _compute_drive_demand(speed, more, state, gains)
                position_integral = state[POSITION_INTEGRAL]
            else:
                turned = gains[RAD_PER_MM] * (state[POSITION] - state[POSITION_BEFORE])
                turned = _filter_speed_feedback(turned, state, gains) if filtered else turned
                raw, speed_integral, position_integral = _compute_pid_demand(place, more, turned, state, gains)
            raw += gains[ACCELERATION] * acceleration
            if current_offset.size > 0:
                raw += _interpolate_row(current_offset, k, part)
            demand_a = min(max(raw, -current_max), current_max)
            if demand_a == raw:  # all integrals are frozen while the limit acts
                state[SPEED_INTEGRAL], state[POSITION_INTEGRAL] = speed_integral, position_integral
            state[CURRENT_DEMAND] = demand_a
            clipped = demand_a != raw
            limited += _run_current_cycles(demand_a, clipped, plant, masses, gains, terms, n_current, delay, state)
        out[ROW_LIMITED, row] = limited
    return out
