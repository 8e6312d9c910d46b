"""Integrates motor, screw and table with the drive's three nested loops, one SYNC cycle at a time.

Plant ([DES] eqs. 1 and 2), SI units:

    L di/dt  = u - R i - K w
    Jt dw/dt = K i - ft w - Cd sign(w) - Tl        w = 0 sticks while |K i - Tl| <= Cd

Between two steps of the current loop the voltage and the sign of w are constant, so the plant is linear and its step is
exact (a matrix exponential); on a sign change, w stays 0 for that step. All quantities are in the drive's own
direction; position is the shaft's angle, and the table follows it through the backlash.
"""

import math
from enum import Enum, auto
from typing import NamedTuple

import numba
import numpy as np

from fdhil.config import Nominal, Regulators, SimAxis
from fdhil.errors import ConfigError, ConfigFault
from fdhil.records import PARAMETERS, Float, Parameters

Command = tuple[float, float, float, float, float, float, float, float]

# the only regulators that this drive implements
_PLAIN = {"structure": "p_pi_pi", "torque_feedforward": 0.0}
# indices of the state vector
CURRENT, SPEED, ANGLE, TABLE, SPEED_INTEGRAL, CURRENT_INTEGRAL = range(6)
# indices of the loops vector
(KV, KFF, KPS, KIS, I_MAX, KPC, KIC, U_MAX, INC_PER_RAD, N_SPEED, N_CURRENT) = range(11)
# flags that a cycle returns
CURRENT_LIMIT, VOLTAGE_LIMIT = 1, 2


def discretise_plant(parameters: Float, step_s: float) -> Float:
    """Return the exact plant step as (5, 5): rows of the matrix exponential of [i, w, theta, u, torque].

    ``parameters`` is (6,) R, L, K, Jt, ft, Cd. The step is far below the plant's time constants, so the Taylor series
    converges quickly; otherwise it is halved and squared.
    """
    R, L, K, Jt, ft, _ = parameters
    a = np.zeros((5, 5))
    a[0, 0], a[0, 1], a[0, 3] = -R / L, -K / L, 1.0 / L
    a[1, 0], a[1, 1], a[1, 4] = K / Jt, -ft / Jt, 1.0 / Jt
    a[2, 1] = 1.0
    # in rad, A and V the entries differ by orders of magnitude; the largest one bounds the series
    halvings = max(0, math.ceil(math.log2(np.abs(a).max() * step_s / 0.5)))
    a *= step_s / 2**halvings
    phi = term = np.eye(5)
    for order in range(1, 21):
        term = term @ a / order
        phi = phi + term
    for _ in range(halvings):
        phi = phi @ phi
    return phi


@numba.njit(cache=True, nogil=True)
def _step_plant(state: Float, u: float, load: float, parameters: Float, phi: Float, step_s: float) -> None:
    """Advance current, speed and angle by one step under voltage ``u`` and load torque ``load``."""
    R, L, K, Cd = parameters[0], parameters[1], parameters[2], parameters[5]
    i, w = state[0], state[1]
    drive = K * i - load
    if w == 0.0 and abs(drive) <= Cd:
        decay = math.exp(-R / L * step_s)
        state[0] = i * decay + u / R * (1.0 - decay)
        return
    if w != 0.0:
        sign = 1.0 if w > 0.0 else -1.0
    else:
        sign = 1.0 if drive > 0.0 else -1.0
    torque = -Cd * sign - load
    state[0] = phi[0, 0] * i + phi[0, 1] * w + phi[0, 3] * u + phi[0, 4] * torque
    speed = phi[1, 0] * i + phi[1, 1] * w + phi[1, 3] * u + phi[1, 4] * torque
    turned = phi[2, 0] * i + phi[2, 1] * w + phi[2, 3] * u + phi[2, 4] * torque
    if speed * sign < 0.0:
        speed = 0.0
        turned = 0.5 * w * step_s
    state[1] = speed
    state[2] += turned


@numba.njit(cache=True, nogil=True)
def _coast_plant(state: Float, load: float, parameters: Float, step_s: float) -> None:
    """Advance the plant by one step without current: the power stage is off."""
    Jt, ft, Cd = parameters[3], parameters[4], parameters[5]
    w = state[1]
    state[0] = 0.0
    if w == 0.0 and abs(load) <= Cd:
        return
    if w != 0.0:
        sign = 1.0 if w > 0.0 else -1.0
    else:
        sign = 1.0 if load < 0.0 else -1.0
    speed = w + step_s * (-ft * w - Cd * sign - load) / Jt
    if speed * sign < 0.0:
        speed = 0.0
    state[1] = speed
    state[2] += 0.5 * (w + speed) * step_s


@numba.njit(cache=True, nogil=True)
def simulate_sync_cycle(
    state: Float,
    loops: Float,
    parameters: Float,
    phi: Float,
    voltage: Float,
    enabled: bool,
    command: Command,
    load: float,
    half_backlash: float,
    step_s: float,
) -> tuple[float, int]:
    """Run one SYNC cycle; return the mean voltage and the limits that acted.

    ``state`` (6,) and ``voltage`` (n,), one value per current step, are written. ``command`` is the set-point at the
    start and end of the cycle (increments), the feed-forward speed at both (increments/s), the speed offset at both
    (rad/s) and the current offset at both (A); each is interpolated linearly and sampled by the speed loop. Each PI
    integrates first and keeps its old integral where its limit acts.
    """
    p0, p1, f0, f1, v0, v1, c0, c1 = command
    n_speed, n_current = int(loops[N_SPEED]), int(loops[N_CURRENT])
    inc_per_rad = loops[INC_PER_RAD]
    speed_step = step_s * n_current
    current_demand = 0.0
    limits = 0
    total = 0.0
    index = 0
    for m in range(n_speed):
        if enabled:
            part = m / n_speed
            position = np.rint(state[TABLE] * inc_per_rad)
            lag = p0 + (p1 - p0) * part - position
            demand = (loops[KV] * lag + loops[KFF] * (f0 + (f1 - f0) * part)) / inc_per_rad + v0 + (v1 - v0) * part
            error = demand - state[SPEED]
            candidate = state[SPEED_INTEGRAL] + loops[KIS] * speed_step * error
            raw = loops[KPS] * error + candidate + c0 + (c1 - c0) * part
            current_demand = min(max(raw, -loops[I_MAX]), loops[I_MAX])
            if current_demand == raw:
                state[SPEED_INTEGRAL] = candidate
            else:
                limits |= CURRENT_LIMIT
        for _ in range(n_current):
            if enabled:
                error = current_demand - state[CURRENT]
                candidate = state[CURRENT_INTEGRAL] + loops[KIC] * step_s * error
                raw = loops[KPC] * error + candidate
                u = min(max(raw, -loops[U_MAX]), loops[U_MAX])
                if u == raw:
                    state[CURRENT_INTEGRAL] = candidate
                else:
                    limits |= VOLTAGE_LIMIT
                _step_plant(state, u, load, parameters, phi, step_s)
            else:
                u = parameters[2] * state[SPEED]  # an open motor shows its back-EMF
                _coast_plant(state, load, parameters, step_s)
            voltage[index] = u
            total += u
            index += 1
            state[TABLE] = min(max(state[TABLE], state[ANGLE] - half_backlash), state[ANGLE] + half_backlash)
    return total / index, limits


class ClosedLoops(Enum):
    """The outermost closed loop; those inside it are closed as well."""

    POSITION = auto()
    SPEED = auto()
    CURRENT = auto()


def select_gains(gains: Float, loops: ClosedLoops) -> Float:
    """Return the gains (4,) KV, KFF, KPS, KIS with those of the open loops at zero.

    >>> select_gains(np.array([50.0, 1.0, 23.0, 1184.0]), ClosedLoops.SPEED).tolist()
    [0.0, 0.0, 23.0, 1184.0]
    """
    position, speed = loops is ClosedLoops.POSITION, loops is not ClosedLoops.CURRENT
    closed: Float = np.array([position, position, speed, speed], dtype=np.float64)
    return gains * closed


class SensedState(NamedTuple):
    """The drive's sensor values at a SYNC, without noise; the position is that of the position loop.

    ``bus`` is the DC-link voltage relative to its no-load value.
    """

    position_rad: float
    speed_rad_s: float
    current_a: float
    voltage_v: float
    bus: float = 1.0


class PlantPhysics:
    """One axis' mechanics and loops. Angles in rad, in the drive's own direction.

    ``compute_motor_voltage_v`` (n,) holds the terminal voltage of each current step of the last cycle,
    ``voltage_mean_v`` their mean; ``seen`` are the drive's sensor values.
    """

    def __init__(
        self,
        parameters: Parameters,
        regulators: Regulators,
        sync_period_s: float,
        increments_per_rev: int,
        *,
        angle_rad: float = 0.0,
        backlash_rad: float = 0.0,
    ) -> None:
        self.step_s = regulators.current_period_s
        n_speed = round(sync_period_s / regulators.speed_period_s)
        n_current = round(regulators.speed_period_s / regulators.current_period_s)
        self._loops = np.array(
            [
                regulators.position_gain_per_s,
                regulators.speed_feedforward,
                regulators.speed_kp,
                regulators.speed_ki,
                regulators.current_limit_a,
                regulators.current_kp,
                regulators.current_ki,
                regulators.voltage_limit_v,
                increments_per_rev / (2 * math.pi),
                n_speed,
                n_current,
            ]
        )
        self._gains = self._loops[: KIS + 1].copy()
        self._current_limit_a = regulators.current_limit_a
        self._state = np.zeros(6)
        self._half_backlash = backlash_rad / 2
        self._state[ANGLE] = self._state[TABLE] = angle_rad
        self.voltage_v = np.zeros(n_speed * n_current)
        self.voltage_mean_v = 0.0
        self.current_limited = False
        self.voltage_limited = False
        self.load_torque_nm = 0.0
        self.set_parameters(parameters)
        self._unpack_state()

    def set_parameters(self, parameters: Parameters) -> None:
        """Change the plant from the next cycle on; the loops keep their gains."""
        self.parameters = parameters
        self._plant = np.array(list(parameters.as_dict().values()))
        self._phi = discretise_plant(self._plant, self.step_s)

    def close_loops(self, loops: ClosedLoops) -> None:
        """Close the loops from this one inward; a closing speed loop continues from the present current."""
        self._loops[: KIS + 1] = select_gains(self._gains, loops)
        self._state[SPEED_INTEGRAL] = 0.0 if loops is ClosedLoops.CURRENT else self._state[CURRENT]

    def limit_current(self, limit_a: float) -> None:
        """Limit the current demand below the configured limit."""
        self._loops[I_MAX] = min(limit_a, self._current_limit_a)

    @property
    def table_speed_rad_s(self) -> float:
        """The table's speed, as that of the shaft it follows."""
        return self.speed_rad_s

    def compile_kernels(self) -> None:
        """Run one cycle on a copy of the state to compile the kernels, which takes seconds."""
        self._call_kernel(self._state.copy(), self.voltage_v.copy(), False, (0.0,) * 8)

    def run_cycle(self, enabled: bool, command: Command) -> None:
        """Run one SYNC cycle of :func:`simulate_sync_cycle`; ``enabled`` False means that no current flows."""
        if not enabled:
            self._state[SPEED_INTEGRAL] = self._state[CURRENT_INTEGRAL] = 0.0
        self.voltage_mean_v, limits = self._call_kernel(self._state, self.voltage_v, enabled, command)
        self.current_limited = limits & CURRENT_LIMIT != 0
        self.voltage_limited = limits & VOLTAGE_LIMIT != 0
        self._unpack_state()

    def _call_kernel(self, state: Float, voltage: Float, enabled: bool, command: Command) -> tuple[float, int]:
        plant, load, backlash = self._plant, self.load_torque_nm, self._half_backlash
        return simulate_sync_cycle(
            state, self._loops, plant, self._phi, voltage, enabled, command, load, backlash, self.step_s
        )

    def _unpack_state(self) -> None:
        self.current_a, self.speed_rad_s, self.angle_rad, self.table_rad, _, _ = self._state.tolist()
        self.sensed = SensedState(self.table_rad, self.speed_rad_s, self.current_a, self.voltage_mean_v)


def build_plant_parameters(nominal: Nominal, sim_axis: SimAxis) -> Parameters:
    """Return the plant's parameters: those of the simulation section, else the nominal values."""
    named = sim_axis.model_dump(exclude_none=True)
    return Parameters(**{name: named.get(name, getattr(nominal, name)) for name in PARAMETERS})


def check_structure(axis: str, regulators: Regulators) -> None:
    """Raise ConfigError for regulators that the simulated drive does not implement."""
    faults = [
        ConfigFault(f"axis.{axis}.regulators.{key}", "not implemented by the simulated drive", f"leave it at {plain!r}")
        for key, plain in _PLAIN.items()
        if getattr(regulators, key) != plain
    ]
    if faults:
        raise ConfigError("sim", faults)
