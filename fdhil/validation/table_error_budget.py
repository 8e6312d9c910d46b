"""Assesses a window's model in micrometres at the table: the residual that it leaves, and the error by its bias.

Where the axis' regulators are known, the rapid is replayed through the closed loop with the model, and the residual of
the measured positions is compared with the tolerance. Where they are not, the torque that the model leaves is passed
through an ordinary loop, and compared with the effect of all torque of the move (the share hardly depends on the loop),
or with the recorded following error where that is larger: a drive without feed-forward.

With an ideal current loop, speed demand Kv e + Ki int e and a PI on speed, a torque d moves the shaft by

    theta / d = s^2 / (Jt s^4 + ft s^3 + K (kp s + ki) (s^2 + Kv s + Ki))

(the loop's integrator removes a constant torque: a load matters where it steps, a ripple near the loop's corner). Only
the integral of a torque is needed, the momentum in N.m.s: no signal is differentiated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fdhil.config import TOLERANCE_SHARE, Axis, Identification
from fdhil.identification import compute_moving_mean, fill_forward, find_fft_size
from fdhil.model import compute_friction_torque
from fdhil.records import Bool, Float, Parameters, Reason, Window, compute_rms
from fdhil.validation.move_replay import Replay, replay_with_load_search

# of a drive with unknown regulators: corner of its speed loop, and its position gain
ORDINARY_SPEED_HZ, ORDINARY_KV = 30.0, 30.0
INTEGRAL_SHARE = 0.2  # of the speed loop's corner: the corner of its integral
SETTLED_S = 0.5  # by then a loop has settled: earlier torque has no effect
UM_PER_MM = 1e3
MOST_SHARE = 0.15  # of the effect of all torque: a model that leaves more is invalid, however much the axis lags
NEXT_SPEED = 0.3  # of the rapid speed: speed of a cutting program
SCATTER = 3.0  # deviations by which the power of noise may exceed the expected one
BEGINNING_S = 0.060  # before the first row in motion
SMOOTHING_S = 0.002  # of the current, whose noise would push a shaft at rest
LOOPS_DIFFER = "LoopsDiffer"  # code if the model explains the torque but not the closed loop
NOISE_ROWS = 25.0e-3  # s: over which noise behind a position loop is correlated


@dataclass(frozen=True, slots=True)
class TorqueToTableError:
    """The loop of one axis about one drive: gains (A.s/rad, A/rad, 1/s, 1/s2) and mechanics, and um per rad."""

    inertia: float
    viscous: float
    torque_constant: float
    speed_kp: float
    speed_ki: float
    position_kv: float
    position_ki: float
    um_per_rad: float

    @classmethod
    def derive(cls, parameters: Parameters, pitch_mm: float, axis: Axis | None) -> TorqueToTableError:
        """Return the loop with the regulators of the axis' section, or with ordinary ones without a section."""
        to_um = UM_PER_MM * pitch_mm / (2 * math.pi)
        mechanics = parameters.Jt, max(parameters.ft, 0.0), parameters.K
        if axis is None:
            corner = 2 * math.pi * ORDINARY_SPEED_HZ
            kp = corner * parameters.Jt / parameters.K
            return cls(*mechanics, kp, INTEGRAL_SHARE * corner * kp, ORDINARY_KV, 0.0, to_um)
        g = axis.regulators
        return cls(*mechanics, g.speed_kp, g.speed_ki, g.position_gain_per_s, g.position_ki_per_s2, to_um)

    def compute_frequency_response(self, size: int, dt_s: float) -> Float:
        """Return the complex gain from momentum (N.m.s) to the table (um) at the frequencies of ``size`` rows."""
        s = 2j * math.pi * np.fft.rfftfreq(size, dt_s)
        s[0] = 1e-9j  # a constant torque has no lasting effect
        speed, place = self.speed_kp * s + self.speed_ki, s * s + self.position_kv * s + self.position_ki
        free = self.inertia * s**4 + self.viscous * s**3
        gain: Float = self.um_per_rad * s**3 / (free + self.torque_constant * speed * place)
        return gain

    def convert_momentum_to_um(self, momentum: Float, dt_s: float) -> Float:
        """Return the error at the table (q, n), um, by the integrals (q, n) of torques, N.m.s, rows dt apart."""
        n = momentum.shape[-1]
        settled = math.ceil(SETTLED_S / dt_s)
        size = find_fft_size(n + 3 * settled)
        # the transform is circular: the final momentum is held until the loop has settled, then faded out
        fading = np.cos(np.linspace(0.0, math.pi, settled)) / 2 + 0.5
        tail = np.concatenate([np.ones(settled), fading, np.zeros(size - n - 2 * settled)])
        whole = np.concatenate([momentum, momentum[..., -1:] * tail], axis=-1)
        out: Float = np.fft.irfft(np.fft.rfft(whole) * self.compute_frequency_response(size, dt_s), size)[..., :n]
        return out

    def compute_step_peak_um(self, dt_s: float) -> float:
        """Return how far a step of 1 N.m moves the table before the loop has compensated it, um."""
        since: Float = dt_s * np.arange(math.ceil(SETTLED_S / dt_s), dtype=np.float64)
        return float(np.abs(self.convert_momentum_to_um(since, dt_s)).max())

    def compute_noise_um(self, white: float, walk: float, n: int, dt_s: float) -> float:
        """Return the RMS (um) by a momentum of white noise and one of a random walk, by their deviation per row."""
        size = find_fft_size(n + 3 * math.ceil(SETTLED_S / dt_s))
        power = np.abs(self.compute_frequency_response(size, dt_s)[1:]) ** 2
        step = 2 * np.sin(math.pi * np.fft.rfftfreq(size)[1:])
        return math.sqrt(float(power @ (white**2 + (walk / step) ** 2)) * 2 / size)


@dataclass(frozen=True, slots=True)
class TableErrorBudget:
    """The residual of a model on a rapid at the table, RMS um, and its limit: ``limit_um`` of ``whole_um``.

    ``torque_um`` is the effect of the unexplained torque. ``through`` is the loop used: a replay of the rapid, the
    axis' own loop without one, or an ordinary loop, where only the share is meaningful.
    """

    unexplained_um: float
    limit_um: float
    whole_um: float
    torque_um: float
    through: Literal["replay", "own loop", "ordinary loop"]
    too_soft: bool = False
    """Whether the replay explains the rapid without the configured resonance."""

    def is_within_limit(self, um: float) -> bool:
        """Return whether that error at the table is within the limit."""
        return um <= self.limit_um

    @property
    def is_absolute(self) -> bool:
        """Return whether all figures are micrometres at the axis' own table."""
        return self.through != "ordinary loop"

    @property
    def is_met(self) -> bool:
        """Return whether the model explains the rapid."""
        return self.is_within_limit(self.unexplained_um)

    def build_reason(self) -> Reason:
        """Return why the model is not accepted."""
        advice = "the drive has an effect that the model lacks, or current and speed are not sampled at one instant"
        if self.through != "replay":
            error = self.format_error(self.unexplained_um)
            text = f"the torque that the model leaves unexplained causes {error} at the table"
            return Reason("ValidationFailed", f"{text}, limit {self.format_error(self.limit_um)}", advice)
        text = (
            f"the closed loop with this model leaves {self.unexplained_um:.3g} um RMS of a following error of "
            f"{self.whole_um:.3g} um unexplained, limit {self.limit_um:.3g} um"
        )
        if self.too_soft:
            return Reason(
                "ValidationFailed", text, "the model explains it without resonance_hz: correct that value, or remove it"
            )
        if self.is_within_limit(self.torque_um):
            advice = (
                "the model explains the torque: the drive's loops differ from the configuration "
                "(fdhil identify --loops), or "
                "demand and position are not those that the drive follows: held, late, or from other samples"
            )
            return Reason(LOOPS_DIFFER, text, advice)
        return Reason("ValidationFailed", text, advice)

    def format_error(self, um: float) -> str:
        """Return an error at the table as text: in um, or as a share where the loops are unknown."""
        return f"{um:.2g} um" if self.is_absolute else f"{um / self.whole_um:.1%} of the effect of all torque"


@dataclass(frozen=True, slots=True)
class DriveMotion:
    """The rows of a window in which the drive moves to ``side`` (n,), +1 or -1, else 0; current and speed (n,).

    ``friction`` (n,) is the model's torque of friction and loads against the positive direction, N.m. ``begins`` (n,)
    marks the rows before those, in which the drive may begin to move.
    """

    current: Float
    speed: Float
    side: Float
    friction: Float
    begins: Bool
    dt_s: float

    @classmethod
    def extract(cls, window: Window, parameters: Parameters, side: Float) -> DriveMotion:
        """Return the move of a window, with the friction of a model."""
        speed = fill_forward(window.speed_rad_s)
        angle = 2 * math.pi / window.pitch_mm * fill_forward(window.position_mm)
        friction = np.where(side != 0, compute_friction_torque(parameters, np.abs(speed) * side, angle), 0.0)
        moving = np.flatnonzero(side)
        first = int(moving[0]) if moving.size else 0
        begins = np.zeros(side.size, dtype=np.bool_)
        begins[max(0, first - round(BEGINNING_S / window.dt_s)) : first] = True
        return cls(fill_forward(window.current_a), speed, side, friction, begins, window.dt_s)

    def integrate_torque(self, torque_nm: Float) -> Float:
        """Return the integral (n,) of a torque (n,) over the rows in which the drive moves."""
        over = np.where(self.side[:-1] != 0, (torque_nm[1:] + torque_nm[:-1]) / 2, 0.0) * self.dt_s
        return np.concatenate([[0.0], np.cumsum(over)])

    def accumulate_speed_gain(self, speed: Float) -> Float:
        """Return the speed (n,) gained in those rows."""
        return np.concatenate([[0.0], np.cumsum(np.where(self.side[:-1] != 0, np.diff(speed), 0.0))])

    def compute_unexplained_momentum(self, p: Parameters) -> Float:
        """Return the momentum (n,) that the model leaves unexplained, N.m.s."""
        return (
            self.integrate_torque(p.K * self.current - self.friction)
            - p.Jt * self.accumulate_speed_gain(self.speed)
            + self._compute_breakaway_momentum(p)
        )

    def _compute_breakaway_momentum(self, p: Parameters) -> Float:
        """Return that momentum of the rows in which the move begins, by the torque beyond friction at rest."""
        rows = np.flatnonzero(self.begins)
        if rows.size == 0:
            return np.zeros(self.speed.size)
        way = self.side[rows[-1] + 1]
        width = 2 * round(SMOOTHING_S / 2 / self.dt_s) + 1
        held = way * self.friction[rows[-1] + 1]
        net = way * p.K * compute_moving_mean(self.current, width) - held - way * p.ft * self.speed
        push = np.where(self.begins, np.maximum(net, 0.0), 0.0) * self.dt_s
        gained = np.where(self.begins, np.append(np.diff(self.speed), 0.0), 0.0)
        made: Float = np.concatenate([[0.0], np.cumsum(way * push - p.Jt * gained)[:-1]])
        return made

    def compute_total_momentum(self, p: Parameters) -> Float:
        """Return the momentum (n,) of all torque that the model has."""
        return self.integrate_torque(self.friction) + p.Jt * self.accumulate_speed_gain(self.speed)

    def scale_speed(self, p: Parameters, share: float) -> DriveMotion:
        """Return the move at a share of its speed, by the same model: a cut."""
        speed = share * self.speed
        friction = self.friction + p.ft * (speed - self.speed)
        current = (p.Jt * np.gradient(speed, self.dt_s) + friction) / p.K
        return replace(self, speed=speed, friction=friction, current=np.where(self.side != 0, current, self.current))

    def compute_bias_momentum(self, p: Parameters, shift: Float) -> Float:
        """Return the momentum (n,) by a shift of the parameters by ``shift`` (6,)."""
        _, _, of_k, of_jt, of_ft, of_cd = shift
        off = of_ft * self.speed + of_cd * self.side - of_k * self.current
        made: Float = self.integrate_torque(off) + of_jt * self.accumulate_speed_gain(self.speed)
        return made


def append_return_move(momentum: Float) -> Float:
    """Return the momentum (2 n,) of a move and its immediate return, where dry and viscous friction differ."""
    return np.concatenate([momentum, momentum[-1] - momentum])


def assess_table_error(
    window: Window,
    settings: Identification,
    parameters: Parameters,
    move: DriveMotion,
    noise: tuple[float, float],
    axis: Axis | None,
    sync_period_s: float,
) -> TableErrorBudget | None:
    """Return a model's residual of a window; ``noise`` are the deviations of current (A) and speed (rad/s)."""
    if not _can_simulate(parameters):
        return None
    loop = TorqueToTableError.derive(parameters, window.pitch_mm, axis)
    whole, left = (
        compute_rms(row)
        for row in loop.convert_momentum_to_um(
            np.array([move.compute_total_momentum(parameters), move.compute_unexplained_momentum(parameters)]),
            window.dt_s,
        )
    )
    left = _subtract_noise(left, loop, parameters, move, noise)
    replayed = _replay_if_configured(window, parameters, axis, sync_period_s)
    if replayed is None and axis is not None:
        return TableErrorBudget(left, settings.compute_tolerance_um(whole), whole, left, "own loop")
    if replayed is None:
        limit = min(TOLERANCE_SHARE * max(whole, _measure_following_error_um(window)), MOST_SHARE * whole)
        return TableErrorBudget(left, limit, whole, left, "ordinary loop")
    limit = settings.compute_tolerance_um(replayed.measured_um)
    soft = (
        replayed.unexplained_um > limit
        and _replay_without_resonance_um(window, parameters, axis, sync_period_s) <= limit
    )
    return TableErrorBudget(replayed.unexplained_um, limit, replayed.measured_um, left, "replay", soft)


def _replay_without_resonance_um(
    window: Window, parameters: Parameters, axis: Axis | None, sync_period_s: float
) -> float:
    """Return the residual of a replay without the configured resonance; infinite where none is configured."""
    if axis is None or axis.resonance_hz is None:
        return math.inf
    stiff = replace(parameters, terms=tuple(pair for pair in parameters.terms if not pair[0].startswith("resonance")))
    replayed = _replay_if_configured(window, stiff, axis.model_copy(update={"resonance_hz": None}), sync_period_s)
    return math.inf if replayed is None else replayed.unexplained_um


def _measure_following_error_um(window: Window) -> float:
    """Return the RMS following error that was recorded beyond that at rest, um; 0 without a recorded demand."""
    apart = (window.position_mm - window.demand_mm)[np.isfinite(window.position_mm - window.demand_mm)]
    if apart.size == 0 or not np.nanmax(window.demand_mm) > np.nanmin(window.demand_mm):
        return 0.0
    return 1e3 * compute_rms(apart - apart[0])


def _can_simulate(parameters: Parameters) -> bool:
    values = np.array(list(parameters.as_dict().values()))
    return bool(np.isfinite(values).all() and (values[:4] > 0).all())


def _replay_if_configured(
    window: Window, parameters: Parameters, axis: Axis | None, sync_period_s: float
) -> Replay | None:
    return None if axis is None else replay_with_load_search(window, parameters, axis, sync_period_s)


def _subtract_noise(
    left: float, loop: TorqueToTableError, p: Parameters, move: DriveMotion, noise: tuple[float, float]
) -> float:
    n, dt_s = move.speed.size, move.dt_s
    current_a, speed_rad_s = noise
    moving = float(np.mean(move.side != 0))
    expected = loop.compute_noise_um(p.Jt * speed_rad_s, p.K * current_a * dt_s, n, dt_s) * math.sqrt(moving)
    independent = max(1.0, moving * n * dt_s / max(NOISE_ROWS, dt_s))
    return math.sqrt(max(0.0, left**2 - expected**2 * (1.0 + SCATTER * math.sqrt(2.0 / independent))))
