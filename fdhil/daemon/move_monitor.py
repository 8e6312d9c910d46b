"""Monitors the moves of an axis on the bus: whether identification can use them, and whether the scales agree.

It identifies nothing, but counts moves that never become a window, so that silence has a reason. Pure.
"""

import math
from typing import Any

import numpy as np

from fdhil.config import MachineConfig
from fdhil.drivers import load_event_source
from fdhil.identification import PLATEAU_BAND, PLATEAU_S, RAPID_SHARE, RUN_SHARE
from fdhil.records import AxisSamples, Float, Int

REST_S = 0.1  # standstill of the demand that completes a move
FEW = 3  # moves that are representative
TOO_FAST = 1.05  # of the rapid speed: no override explains more
SCALE_TOLERANCE = 0.02
SCALE_TRAVEL_MM = 50.0  # by which position and the integral of speed are compared
LEAST_MM, LONGEST_GAP_S = 0.2, 0.1  # of a compared block
PATIENCE_S = 5.0  # until a completed move must be a window


def _get_columns(samples: AxisSamples) -> tuple[Int, Float, Float, Float]:
    return samples.tick, samples.demand_mm, samples.position_mm, samples.speed_rad_s


class MoveMonitor:
    """The moves of one axis' demand, from rest to rest."""

    def __init__(self, axis: str, config: MachineConfig) -> None:
        settings = config.axis[axis]
        self._period_s = config.machine.sync_period_s
        self._axis, self._rapid_mm_s = settings, settings.rapid_speed_mm_s
        self._mm_per_rad = settings.screw_pitch_mm / (2 * math.pi)
        self._source = config.g0.source
        self._needed = max(RAPID_SHARE, load_event_source(self._source).least_share)
        # one increment per cycle is the rounding of the set-point, not a motion
        self._still_mm_s = max(RUN_SHARE * self._rapid_mm_s, 2 / settings.scaling.increments_per_mm / self._period_s)
        self._last: AxisSamples | None = None
        self._rest_rows = max(1, round(REST_S / self._period_s))
        self._speed_mm_s, self._peak_mm_s, self._level_mm_s = 0.0, 0.0, 0.0
        self._level_rows = self._still = 0
        self._agreement = [0.0, 0.0, 0.0]  # position by speed, speed by speed, travel
        self.seen = self.slow = self.short = 0
        self.fastest_mm_s = 0.0
        self.usable = 0
        self.usable_s = -math.inf

    def take_samples(self, samples: AxisSamples, now_s: float) -> None:
        """Take a block of samples that arrived now."""
        if samples.tick.size == 0:
            return
        last = self._last
        self._last = samples
        if last is not None and samples.tick[0] > last.tick[-1]:
            columns: list[Any] = [
                np.append(a[-1], b) for a, b in zip(_get_columns(last), _get_columns(samples), strict=True)
            ]
        else:
            columns = list(_get_columns(samples))
        tick, demand, position, speed = columns
        if tick.size < 2:
            return
        seconds = np.diff(tick) * self._period_s
        self._follow_demand_speed(np.abs(np.diff(demand)) / seconds, now_s)
        self._compare_scales(float(position[-1] - position[0]), speed, seconds)

    def _follow_demand_speed(self, speed_mm_s: Float, now_s: float) -> None:
        """Follow the demand's speed (n,): a move is complete once it has stood still for a while."""
        after = np.append(self._speed_mm_s, speed_mm_s)
        self._speed_mm_s = float(after[-1])
        for mm_s in np.fmin(after[1:], after[:-1]).tolist():  # a jump, as drives are enabled, is not a speed
            if not mm_s > self._still_mm_s:
                self._still += 1
                if self._still == self._rest_rows and self._peak_mm_s > 0.0:
                    self._classify_completed_move(now_s)
                continue
            self._still = 0
            if mm_s > self._level_mm_s * (1 + PLATEAU_BAND):
                self._level_mm_s, self._level_rows = mm_s, 0
            self._level_rows += mm_s >= self._level_mm_s * (1 - PLATEAU_BAND)
            self._peak_mm_s = max(self._peak_mm_s, mm_s)

    def _classify_completed_move(self, now_s: float) -> None:
        self.seen += 1
        self.fastest_mm_s = max(self.fastest_mm_s, self._peak_mm_s)
        if self._peak_mm_s < self._needed * self._rapid_mm_s:
            self.slow += 1
        elif self._level_rows * self._period_s < PLATEAU_S:
            self.short += 1
        else:
            self.usable, self.usable_s = self.usable + 1, now_s
        self._peak_mm_s, self._level_mm_s, self._level_rows = 0.0, 0.0, 0

    def _compare_scales(self, moved_mm: float, speed_rad_s: Float, seconds: Float) -> None:
        """Regress the position's travel on that of the speed; ignore blocks with a gap or little travel."""
        turned_mm = float(np.sum((speed_rad_s[1:] + speed_rad_s[:-1]) / 2 * seconds)) * self._mm_per_rad
        far = max(abs(turned_mm), abs(moved_mm))
        if LEAST_MM < far < math.inf and seconds.max() <= LONGEST_GAP_S:
            self._agreement[0] += moved_mm * turned_mm
            self._agreement[1] += turned_mm**2
            self._agreement[2] += far

    @property
    def position_by_speed(self) -> float | None:
        """Ratio of the position's travel to the integral of speed; None until the axis has travelled far enough."""
        across, own, travel_mm = self._agreement
        return across / own if travel_mm >= SCALE_TRAVEL_MM and own > 0.0 else None

    def build_status(self) -> dict[str, Any]:
        """Return the counts and the speed of the fastest move."""
        return {
            "seen": self.seen,
            "too_slow": self.slow,
            "without_plateau": self.short,
            "fastest_mm_s": round(self.fastest_mm_s, 3),
            "position_by_speed": None if self.position_by_speed is None else round(self.position_by_speed, 5),
        }

    def find_trouble(self, windows: int, now_s: float) -> tuple[str, str] | None:
        """Return class and sentence of what keeps the moves from being used; None when nothing does.

        ``windows`` is the number of moves that became a window.
        """
        scale, fastest = self.position_by_speed, self.fastest_mm_s
        pitch, rapid = map(self._axis.format_key, ("screw_pitch_mm", "rapid_speed_mm_s"))
        if scale is not None and abs(scale - 1.0) > SCALE_TOLERANCE:
            text = f"the position travels {scale:.3g} times the integral of the speed"
            return "ScaleSuspect", f"{text}; correct increments_per_rev, the drive's profile or its sign"
        if self.seen >= FEW and fastest > TOO_FAST * self._rapid_mm_s:
            return "PitchSuspect", (
                f"moves reach {self._axis.format_in_unit(fastest, '/s')}, {fastest / self._rapid_mm_s:.2f} times the "
                f"rapid"
                f" speed of the config; correct {pitch}, increments_per_rev or {rapid}"
            )
        if self.seen < FEW or windows:
            return None
        return self._explain_unused_moves(now_s)

    def _explain_unused_moves(self, now_s: float) -> tuple[str, str] | None:
        pitch, rapid = map(self._axis.format_key, ("screw_pitch_mm", "rapid_speed_mm_s"))
        if self.slow:
            return "MovesNotUsed", (
                f"{self.seen} moves recorded, none used: {self.slow} stay below {self._needed:.0%} of the rapid speed"
                f" of {self._axis.format_in_unit(self._rapid_mm_s, '/s', 'g')}, the fastest at"
                f" {self._axis.format_in_unit(self.fastest_mm_s, '/s')}; run rapids at full override, or correct "
                f"{rapid} or"
                f" {pitch}"
            )
        if self.usable >= FEW and now_s - self.usable_s > PATIENCE_S:
            return "MovesNotUsed", (
                f"{self.usable} fast moves recorded, none used: no event of the G0 source {self._source} came; correct"
                ' [g0] or use source = "inferred"'
            )
        if self.short >= FEW and not self.usable:
            return "MovesNotUsed", (
                f"{self.short} fast moves recorded, none used: no plateau of {PLATEAU_S:g} s; run longer rapids"
            )
        return None
