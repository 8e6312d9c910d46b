"""Feeds checked rows to the guard as their program runs, and reports the check's refusals."""

import contextlib
from pathlib import Path

from fdhil.arming.arm_plan import ArmPlan
from fdhil.arming.guard_link import GuardLink
from fdhil.arming.residual_offset import REST
from fdhil.arming.standstill_monitor import StandstillMonitor
from fdhil.errors import DeviceError, StoreError
from fdhil.guard import RESERVE_S
from fdhil.records import Notice

SCARCE_S = 5.0  # half the ring: a late check is reported before the guard ends the correction


class StreamFeeder:
    """Feeds the guard with one program's rows; ``go_on`` blocks and is called every few cycles of the daemon."""

    def __init__(self, armed: ArmPlan, guard: GuardLink, standstill: StandstillMonitor) -> None:
        self._armed, self._guard, self._standstill = armed, guard, standstill
        self._name = Path(armed.program).name
        self._reported = 0
        self._scarce = self._broken = False

    def feed_rows(self) -> list[Notice]:
        """Hand the guard the rows that it lacks, as far as they passed; return notices."""
        notices, stream = self._guard.poll_changes(), self._armed.stream
        if self._guard.state in REST:
            return notices
        self._update_first_rows()
        notices += self._report_refusals()
        if self._broken:
            return notices
        if not stream.has_too_few_rows(self._guard.status):
            self._scarce = False
            return notices
        return notices + (self._extend_stream() if stream.has_block else self._report_late_check())

    def _update_first_rows(self) -> None:
        """Replace the first rows by those that begin where the axes stand; a program that has begun continues."""
        first = self._armed.first_block
        if first is None or self._guard.state != "ARMED":
            return
        rows = first.recompute(self._standstill.find_standing_axes())
        if rows is None:
            return
        with contextlib.suppress(DeviceError, StoreError):  # the rows that were armed are still there
            if self._guard.replace_first_rows(self._armed, rows)["ok"]:
                first.apply_rows(rows)

    def _report_refusals(self) -> list[Notice]:
        refused, reported = self._armed.stream.checked.refused, self._reported
        self._reported = len(refused)
        notices = [Notice(reason.code, "minor", f"{reason.text}; {reason.advice}") for reason in refused[reported:]]
        if reported or not refused:
            return notices
        if self._guard.state == "ARMED":
            self._broken = True
            with contextlib.suppress(DeviceError):  # a guard that is gone ramps down on its own
                self._guard.disarm()
            then = "the program had not begun and was disarmed"
        else:
            then = (
                f"it is corrected for another {self.compute_remaining_s():.1f} s, then ramped to zero before that line"
            )
        text = f"{notices[0].text}; {self._name} was armed ahead of its check: {then}"
        return [Notice(notices[0].code, "MAJOR", text), *notices[1:]]

    def _extend_stream(self) -> list[Notice]:
        try:
            answer = self._guard.extend_stream(self._armed, self._armed.stream.take_rows())
        except StoreError as error:
            return self._stop_feeding(error.code, str(error))
        except DeviceError as error:
            return self._stop_feeding("GuardLost", str(error))
        return [] if answer["ok"] else self._stop_feeding("StreamRefused", str(answer["text"]))

    def _stop_feeding(self, code: str, text: str) -> list[Notice]:
        self._broken = True
        return [Notice(code, "MAJOR", f"{text}; the correction ends before these rows")]

    def _report_late_check(self) -> list[Notice]:
        if self._scarce or self._armed.stream.checked.refused or self.compute_remaining_s() > SCARCE_S:
            return []
        self._scarce = True
        text = f"the check of {self._name} is only {self.compute_remaining_s() + RESERVE_S:.1f} s ahead of the motion"
        advice = "reduce the PC's load or arm with --whole; if the check stays behind, the correction ramps to zero"
        return [Notice("CheckBehind", "MAJOR", f"{text}; {advice}")]

    def compute_remaining_s(self) -> float:
        """Return how many seconds of the program remain that can be corrected by the rows that passed."""
        return max(
            0.0, self._armed.stream.checked_until_s - self._guard.path_row * self._armed.stream.period_s - RESERVE_S
        )
