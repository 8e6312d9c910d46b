"""Holds what the checks look at: a window, the estimate and fit that are judged, noise and resolution."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fdhil.config import Axis, Identification
from fdhil.identification.delay import coarse_delay
from fdhil.identification.estimators import least_squares
from fdhil.identification.fit import Fit, but_delay, fit, with_delay
from fdhil.identification.motion import Noise, noise_levels, resolution
from fdhil.identification.windows import carried, moving_range, smooth
from fdhil.identification.without_voltage import TorqueFit
from fdhil.identification.without_voltage import fit as fit_torque
from fdhil.records import PARAMETERS, Bool, Estimate, Float, Parameters, Reason, Window, rms
from fdhil.validation.backlash import DeadBand, backlash
from fdhil.validation.breakaway import Breakaway, breakaway
from fdhil.validation.replay import completed, replay_window
from fdhil.validation.score_bench import Finding
from fdhil.validation.selection import Lacking, lacking
from fdhil.validation.sensor_reconstruction import Bridge
from fdhil.validation.shifts import LATE, Shift, late_findings, shifts
from fdhil.validation.simulation import fit_percent
from fdhil.validation.structure import DEAD_TIME, FRICTION, OFFSET_CURRENT, findings
from fdhil.validation.table_error import TableError
from fdhil.validation.weight import NEXT_SPEED, Move, Weight, to_and_fro, weigh
from fdhil.validation.whiteness import coloured, noisy
from fdhil.validation.widening import widened

STILL_MM = 0.004  # of the table at rest
STILL_S, STILL_SHARE = 0.010, 0.02  # of the rapid speed
SENSOR_KNOWN = 0.5  # of what a sensor's fault makes at the table: it resembles what is tried, and does not show there
MOST_LATE = 3.0  # samples by which a signal may seem late for something else that the model lacks
LEAST_ROWS = 32  # of a window that may hold a rapid move


@dataclass(frozen=True, slots=True)
class Signal:
    """One sensor over a window: its ``values`` (n,), and the smallest ``step`` between them (0: only one value)."""

    name: str
    unit: str
    values: Float
    step: float


@dataclass(frozen=True, slots=True)
class Resting:
    """The deviations of friction at low speed, and of the place (um) at which the axis comes to rest by it.

    No row tells that friction at rest: it is drawn on from the slowest that surely move. What holds the axis there
    decides where it stays.
    """

    deviation_nm: float
    um: float


def signals_of(window: Window) -> tuple[Signal, ...]:
    """Return the sensors that the window has in every row."""
    told = (
        ("voltage", "V", window.voltage_v),
        ("current", "A", window.current_a),
        ("speed", "rad/s", window.speed_rad_s),
    )
    return tuple(Signal(n, u, v, resolution(v[np.isfinite(v)])) for n, u, v in told if v is not None)


@dataclass(frozen=True)
class Evidence:
    """A window before any fit, or with its ``estimate`` and the ``fit`` of the same method (None: there is none).

    ``axis`` is the axis' section where it is known, and ``sync_period_s`` that of its set-points (None: a row's).
    Without a voltage the fit is ``torque``, of [2] alone. ``recorded`` is the window as it was before its speed was
    mended (None: it was not): whether a sensor repeats itself is asked of its own readings.
    """

    window: Window
    settings: Identification
    estimate: Estimate | None = None
    fit: Fit | None = None
    axis: Axis | None = None
    sync_period_s: float | None = None
    recorded: Window | None = None

    @cached_property
    def signals(self) -> Sequence[Signal]:
        """The sensors as they were read, each with its resolution."""
        return signals_of(self.recorded or self.window)

    @property
    def sensors(self) -> Sequence[Signal]:
        """Those of the signals that vary by themselves: in a laboratory the voltage may be held on purpose."""
        return [signal for signal in self.signals if self.window.is_rapid or signal.name != "voltage"]

    @cached_property
    def noise(self) -> Noise:
        """The noise of the three sensors."""
        return noise_levels(self.window)

    @cached_property
    def moving(self) -> tuple[int, int]:
        """The half-open rows of the move itself."""
        return moving_range(self.window)

    @cached_property
    def at_rest(self) -> Bool:
        """The rows (n,) in which the table surely stands still, from position and smoothed speed."""
        window = self.window
        position = carried(window.position_mm)
        reach = max(1, round(STILL_S / window.dt_s))
        ahead, behind = np.roll(position, -reach), np.roll(position, reach)
        still = (np.abs(ahead - position) < STILL_MM) & (np.abs(behind - position) < STILL_MM)
        still[:reach] &= np.abs(position[:reach] - position[0]) < STILL_MM
        still[-reach:] &= np.abs(position[-reach:] - position[-1]) < STILL_MM
        slow = np.abs(smooth(window.speed_rad_s, window.dt_s)) < STILL_SHARE * window.rapid_speed_rad_s
        return still & slow & np.isfinite(window.speed_rad_s)

    @cached_property
    def play(self) -> DeadBand | None:
        """The backlash that the window shows."""
        return backlash(self.window)

    @cached_property
    def torque(self) -> TorqueFit | None:
        """The fit of [2] alone, for a window without a voltage; None where hardly any row surely moves."""
        return None if self.has_voltage else fit_torque(self.window, self.settings)

    @property
    def has_voltage(self) -> bool:
        """Whether the window has a voltage, of the drive or of a slow sensor."""
        return self.window.voltage_v is not None or self.window.slow_voltage is not None

    @cached_property
    def parameters(self) -> Parameters | None:
        """The estimate as a drive that can be run; what a voltage would tell of it, and did not, is the fit's own."""
        if self.estimate is None or not set(PARAMETERS) <= set(self.estimate.names):
            return None
        told = self.estimate.parameters()
        if self.fit is not None:
            told = completed(told, Parameters(*self.fit.theta[:6]))
        if self.axis is not None:
            return completed(told, Parameters(**self.axis.nominal.model_dump()))
        # through an ordinary loop R and L, which only a voltage tells, do nothing
        return told if self.has_voltage else told.changed(R=1.0, L=1.0)

    @cached_property
    def move(self) -> Move | None:
        """The rows in which the drive surely moves, with the friction of the estimate."""
        if self.parameters is None or not math.isfinite(sum(self.parameters.as_dict().values())):
            return None
        moving = np.zeros(self.window.n)
        moving[slice(*self.moving)] = self.window.direction
        if self.torque is not None:
            moving = self.torque.rows.side
        mode = moving if self.fit is None else self.fit.problem.motions[0].mode
        return Move.of(self.window, self.parameters, np.where(np.abs(mode) == 1, mode, 0.0))

    @cached_property
    def weight(self) -> Weight | None:
        """What the estimate leaves of the rapid at the table; None where there is no drive to run."""
        if self.parameters is None or self.move is None:
            return None
        noise = self.noise.current_a, self.noise.speed_rad_s
        period = self.sync_period_s or self.window.dt_s
        return weigh(self.window, self.settings, self.parameters, self.move, noise, self.axis, period)

    def cost_um(self, lack: Lacking) -> float:
        """Return what the model's lack makes at the table: its torque on this rapid, its bias here and in what is cut.

        Of what is cut less torque is asked than of a rapid: its error counts as the same share of a rapid's.
        """
        p, move = self.parameters, self.move
        if p is None or move is None:
            return math.inf
        loop, dt_s = TableError.of(p, self.window.pitch_mm, self.axis), self.window.dt_s
        cut, shift = move.slower(p, NEXT_SPEED), lack.shift[: len(PARAMETERS)].copy()
        if lack.finding.name == OFFSET_CURRENT:  # to the loop it is a load, which is part of one direction's friction
            shift[PARAMETERS.index("Cd")] = 0.0
        torques = [move.whole(p), move.of_shift(p, shift), cut.whole(p), cut.of_shift(p, shift)]
        if lack.load_nm is not None:
            torques.append(move.integral(lack.load_nm))
        whole, here, all_cut, there, *load = (
            rms(row) for row in loop.um(np.array([to_and_fro(row) for row in torques]), dt_s)
        )
        slower = whole / max(all_cut, 1e-300)
        # what a replay shows of a friction, it shows at all speeds
        shown = lack.finding.name != FRICTION or (self.weight is not None and self.weight.through == "replay")
        return max(here, there * slower, *(um * (1.0 if shown else slower) for um in load))

    @cached_property
    def breakaway(self) -> Breakaway | None:
        """What the move takes more to begin than the model says."""
        return breakaway(self.window, self.on_time) if self.sound else None

    def breakaway_um(self, found: Breakaway) -> float:
        """Return what it makes at the table where a program is cut: the drive turns there, and is slow for longer."""
        p, move = self.parameters, self.move
        if p is None or move is None:
            return math.inf
        loop = TableError.of(p, self.window.pitch_mm, self.axis)
        torques = [move.whole(p), move.slower(p, NEXT_SPEED).whole(p), found.momentum(self.window.n) / NEXT_SPEED]
        courses = loop.um(np.array([to_and_fro(row) for row in torques]), self.window.dt_s)
        whole, all_cut, late = (rms(row) for row in courses)
        return late * whole / max(all_cut, 1e-300)

    @cached_property
    def resting(self) -> Resting | None:
        """How surely friction at low speed is told, and with it the place where the axis rests; None without such."""
        estimate, p = self.told, self.parameters
        if estimate is None or p is None or "stribeck" not in estimate.names:
            return None
        at = [estimate.names.index(name) for name in ("Cd", "stribeck")]
        holds = math.sqrt(float(estimate.covariance[np.ix_(at, at)].sum()))
        loop = TableError.of(p, self.window.pitch_mm, self.axis)
        return Resting(estimate.std("stribeck"), holds * loop.lasting_um(self.window.dt_s))

    @cached_property
    def rests_off_um(self) -> float:
        """How far from where a replay of the rapid comes to rest the axis rested, RMS; infinite without a replay."""
        window, axis, end = self.window, self.axis, self.moving[1]
        if axis is None or self.parameters is None:
            return math.inf
        told = replay_window(window, self.parameters, axis, self.sync_period_s or window.dt_s)
        if told is None:
            return math.inf
        rests = self.at_rest & np.isfinite(window.position_mm) & (np.arange(window.n) >= end)
        return rms(1e3 * (window.position_mm - told.predicted_mm)[rests]) if rests.any() else math.inf

    @cached_property
    def told(self) -> Estimate | None:
        """The estimate with the intervals that hold although the model lacks what was found."""
        if self.estimate is None or not self.sound:
            return self.estimate
        restless = {name for name, _ in (*self.colour, *self.excess)}
        named = any(lack.finding.matters for lack in self.lacks)
        return widened(self.estimate, self.on_time, self.lacks, restless, nameless=bool(restless) and not named)

    @cached_property
    def colour(self) -> list[tuple[str, Reason]]:
        """The signals whose innovations hang together, each with its reason."""
        return list(coloured(self.on_time))

    @cached_property
    def excess(self) -> list[tuple[str, Reason]]:
        """The signals of which the fit needs more noise than they scatter, each with its reason."""
        return list(noisy(self.on_time, self.window))

    @cached_property
    def sound(self) -> bool:
        """Whether there is a fit that can be asked what it lacks."""
        if self.fit is None:
            return False
        return bool(np.isfinite(self.on_time.residuals).all() and np.isfinite(self.on_time.information).all())

    @cached_property
    def lost_v(self) -> float:
        """What of the recorded voltage does not reach the motor: a term of the estimate, or found beside it."""
        found = [abs(lack.finding.amplitude) for lack in self.lacks if lack.finding.name == DEAD_TIME]
        term = self.parameters.term("dead_time") if self.parameters is not None else 0.0
        return abs(term) + sum(found)

    @cached_property
    def harmless(self) -> bool:
        """Whether the model explains the rapid at the table, and nothing it surely lacks makes a next one worse."""
        if self.weight is None or not self.weight.believed or (self.fit is not None and self.late_s):
            return False
        if any(lack.finding.name.endswith(LATE) and abs(lack.finding.amplitude) > MOST_LATE for lack in self.lacks):
            return False
        late = self.breakaway
        # a replay has the move's beginning, where a load that is held at rest may pass for friction that holds more
        if late is not None and self.weight.through == "replay" and not late.more:
            late = None
        if late is not None and not self.weight.allows(self.breakaway_um(late)):
            return False
        return all(self.weight.allows(self.cost_um(it) / _known(it)) for lack in self.lacks for it in lack.with_rivals)

    def with_cost(self, reason: Reason, um: float) -> Reason:
        """Return a reason with what it costs at the table."""
        if self.weight is None:
            return reason
        return replace(reason, text=f"{reason.text}; at the table {self.weight.told(um)}")

    @property
    def judged(self) -> Fit:
        """The fit; only for checks that need one."""
        if self.fit is None:
            raise ValueError("there is no fit to judge")
        return self.fit

    @cached_property
    def late_s(self) -> float:
        """By how much the voltage is late (early: negative) where that is more than a sample, else 0."""
        delay = float(self.judged.theta[6])
        return delay if abs(delay) > max(self.window.dt_s, self.judged.problem.motions[0].voltage_period_s) else 0.0

    @cached_property
    def electrically_late(self) -> bool:
        """Whether [5] alone shows that delay in whole samples: no torque or friction can pass for it."""
        window = self.window
        if not self.late_s or window.voltage_v is None:
            return bool(self.late_s)
        return coarse_delay(least_squares.align(window, self.settings), window.dt_s) != 0.0

    @cached_property
    def on_time(self) -> Fit:
        """The fit, without a delay of more than a sample: what else is wrong moves it too, and has its own name."""
        if not self.late_s:
            return self.judged
        judged = self.judged
        return fit(judged.problem.motions, with_delay(judged.theta, 0.0), but_delay(judged.free))

    @cached_property
    def fit_percent(self) -> float | None:
        """How much of the measured speed the estimate explains when it is simulated from the measured voltage."""
        return None if self.estimate is None else fit_percent(self.window, self.estimate, self.fit)

    @cached_property
    def bridge(self) -> Bridge | None:
        """The fitted window across which one sensor is told by the others; None where the fit cannot tell it."""
        if self.fit is None:
            return None
        motion, theta = self.fit.problem.motions[0], self.fit.theta
        finite = bool(np.isfinite(theta).all() and np.isfinite(self.fit.problem.noises[0].vector()).all())
        bears = motion.slow is None and finite and bool((theta[:4] > 0).all()) and abs(theta[6]) <= motion.dt_s
        return Bridge.over(self.fit) if bears else None

    @cached_property
    def findings(self) -> list[Finding]:
        """What the fit shows beyond the model, the most significant first."""
        return findings(self.on_time)

    @cached_property
    def lacks(self) -> list[Lacking]:
        """What of that surely is there, each beside those before it."""
        if not self.sound:
            return []
        late = late_findings(self.shifts) if self.window.slow_voltage is None else []
        return lacking(self.on_time, [*self.findings, *late])

    @cached_property
    def shifts(self) -> tuple[Shift, Shift]:
        """By how much voltage and current seem late."""
        return shifts(self.on_time)

    def time_s(self, row: int) -> float:
        """Return the time of a row as its recording counts it."""
        return self.window.start_s + row * self.window.dt_s


def _known(lack: Lacking) -> float:
    """Return what share of a lack's error is known: a replay shows a torque, and no sensor."""
    return 1.0 if lack.load_nm is not None else SENSOR_KNOWN
