"""Assesses a fitted window at the table, in micrometres: the error by its model and by what the model lacks."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fdhil.records import PARAMETERS, Float, Parameters, Reason, compute_rms
from fdhil.validation.breakaway import Breakaway
from fdhil.validation.model_deficiencies import Deficiency
from fdhil.validation.move_replay import replay_with_load_search
from fdhil.validation.signal_delays import LATE
from fdhil.validation.structure_tests import FRICTION, OFFSET_CURRENT
from fdhil.validation.table_error_budget import (
    NEXT_SPEED,
    DriveMotion,
    TableErrorBudget,
    TorqueToTableError,
    append_return_move,
    assess_table_error,
)
from fdhil.validation.window_fit import WindowFit
from fdhil.validation.window_signals import WindowSignals

SENSOR_KNOWN = 0.5  # share of a sensor fault's error that is known: a replay shows torques, and no sensor
MOST_LATE = 3.0  # samples by which a signal may seem late because of something else that the model lacks


@dataclass(frozen=True, slots=True)
class RestPosition:
    """Standard deviations of friction at low speed (N.m), and of the position where the axis rests by it (um).

    Friction at standstill is not observable; it is extrapolated from the slowest samples in motion.
    """

    deviation_nm: float
    um: float


@dataclass(frozen=True)
class TableAssessment:
    """What the model of a fitted window means at the table."""

    fitted: WindowFit

    @property
    def signals(self) -> WindowSignals:
        """The signals of the window."""
        return self.fitted.signals

    @cached_property
    def drive_motion(self) -> DriveMotion | None:
        """The samples in which the drive moves, with the friction of the estimate; None without finite parameters."""
        window, p, fit = self.fitted.window, self.fitted.parameters, self.fitted.fit
        if p is None or not math.isfinite(sum(p.as_dict().values())):
            return None
        side = np.zeros(window.n)
        side[slice(*self.signals.motion_range)] = window.direction
        if self.fitted.torque is not None:
            side = self.fitted.torque.rows.side
        mode = side if fit is None else fit.problem.motions[0].mode
        return DriveMotion.extract(window, p, np.where(np.abs(mode) == 1, mode, 0.0))

    @cached_property
    def budget(self) -> TableErrorBudget | None:
        """What the estimate leaves of the rapid at the table, and how much it may; None without a drive to run."""
        p, move, signals = self.fitted.parameters, self.drive_motion, self.signals
        if p is None or move is None:
            return None
        noise = signals.noise.current_a, signals.noise.speed_rad_s
        return assess_table_error(
            signals.window, signals.settings, p, move, noise, signals.axis, signals.setpoint_period_s
        )

    def _convert_to_um(self, loop: TorqueToTableError, momentums: list[Float]) -> list[float]:
        """Return the RMS at the table (um) of momentums (n,), each with its return move."""
        moves = np.array([append_return_move(momentum) for momentum in momentums])
        return [compute_rms(row) for row in loop.convert_momentum_to_um(moves, self.fitted.window.dt_s)]

    def _derive_loop(self, p: Parameters) -> TorqueToTableError:
        return TorqueToTableError.derive(p, self.fitted.window.pitch_mm, self.signals.axis)

    def compute_cost_um(self, lack: Deficiency) -> float:
        """Return the error at the table by a deficiency: its torque on this rapid, its bias here and when cutting.

        Cutting asks for less torque than a rapid: its error counts as the same share of a rapid's.
        """
        p, move = self.fitted.parameters, self.drive_motion
        if p is None or move is None:
            return math.inf
        cut, shift = move.scale_speed(p, NEXT_SPEED), lack.shift[: len(PARAMETERS)].copy()
        if lack.finding.name == OFFSET_CURRENT:  # to the loop it is a load, which is part of one direction's friction
            shift[PARAMETERS.index("Cd")] = 0.0
        torques = [
            move.compute_total_momentum(p),
            move.compute_bias_momentum(p, shift),
            cut.compute_total_momentum(p),
            cut.compute_bias_momentum(p, shift),
        ]
        if lack.load_nm is not None:
            torques.append(move.integrate_torque(lack.load_nm))
        whole, here, all_cut, there, *load = self._convert_to_um(self._derive_loop(p), torques)
        slower = whole / max(all_cut, 1e-300)
        # friction that a replay shows, it shows at all speeds
        shown = lack.finding.name != FRICTION or (self.budget is not None and self.budget.through == "replay")
        return max(here, there * slower, *(um * (1.0 if shown else slower) for um in load))

    def compute_breakaway_um(self, found: Breakaway) -> float:
        """Return the error by a breakaway torque when cutting: there the drive reverses, and stays slow for longer."""
        p, move = self.fitted.parameters, self.drive_motion
        if p is None or move is None:
            return math.inf
        late_nms = found.integrate_torque(self.fitted.window.n) / NEXT_SPEED
        torques = [move.compute_total_momentum(p), move.scale_speed(p, NEXT_SPEED).compute_total_momentum(p), late_nms]
        whole, all_cut, late = self._convert_to_um(self._derive_loop(p), torques)
        return late * whole / max(all_cut, 1e-300)

    @cached_property
    def rest_position(self) -> RestPosition | None:
        """How precisely friction at low speed, and by it the position at rest, is known; None without such a term."""
        estimate, p = self.fitted.widened_estimate, self.fitted.parameters
        if estimate is None or p is None or "stribeck" not in estimate.names:
            return None
        at = [estimate.names.index(name) for name in ("Cd", "stribeck")]
        holding_nm = math.sqrt(float(estimate.covariance[np.ix_(at, at)].sum()))
        um = holding_nm * self._derive_loop(p).compute_step_peak_um(self.fitted.window.dt_s)
        return RestPosition(estimate.get_std("stribeck"), um)

    @cached_property
    def rest_position_error_um(self) -> float:
        """RMS distance at rest, after the move, from the replay; infinite without a replay."""
        window, axis, p = self.fitted.window, self.signals.axis, self.fitted.parameters
        if axis is None or p is None:
            return math.inf
        replayed = replay_with_load_search(window, p, axis, self.signals.setpoint_period_s)
        if replayed is None:
            return math.inf
        after = np.arange(window.n) >= self.signals.motion_range[1]
        rests = self.signals.standstill & np.isfinite(window.position_mm) & after
        return compute_rms(1e3 * (window.position_mm - replayed.predicted_mm)[rests]) if rests.any() else math.inf

    @cached_property
    def is_harmless(self) -> bool:
        """Whether the model explains the rapid at the table, and no deficiency would degrade a next move."""
        budget = self.budget
        if budget is None or not budget.is_met or (self.fitted.fit is not None and self.fitted.voltage_delay_s):
            return False
        deficiencies = self.fitted.deficiencies
        if any(it.finding.name.endswith(LATE) and abs(it.finding.amplitude) > MOST_LATE for it in deficiencies):
            return False
        late = self.fitted.breakaway
        # a replay includes the start of the move, where a load held at rest may look like friction that holds more
        if late is not None and budget.through == "replay" and not late.exceeds_model:
            late = None
        if late is not None and not budget.is_within_limit(self.compute_breakaway_um(late)):
            return False
        return all(
            budget.is_within_limit(self.compute_cost_um(it) / (1.0 if it.load_nm is not None else SENSOR_KNOWN))
            for each in deficiencies
            for it in each.with_alternatives
        )

    def append_cost(self, reason: Reason, um: float) -> Reason:
        """Return a reason with its cost at the table."""
        if self.budget is None:
            return reason
        return replace(reason, text=f"{reason.text}; at the table {self.budget.format_error(um)}")
