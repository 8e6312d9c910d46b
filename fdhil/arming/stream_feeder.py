"""Feeds checked rows to the guard as their program runs, and reports the check's refusals."""

import contextlib
from pathlib import Path

from fdhil.arming.guard_link import GuardLink
from fdhil.arming.preparing import Armament
from fdhil.arming.standing import REST
from fdhil.arming.standstill import Standstill
from fdhil.errors import DeviceError, StoreError
from fdhil.guard.guard_protocol import RESERVE_S
from fdhil.records import Notice

SCARCE_S = 5.0  # half the ring: a late check is reported before the guard ends the correction


class StreamFeeder:
    """Feeds the guard with one program's rows; ``go_on`` blocks and is called every few cycles of the daemon."""

    def __init__(self, armed: Armament, guard: GuardLink, standstill: Standstill) -> None:
        self._armed, self._guard, self._standstill = armed, guard, standstill
        self._name = Path(armed.program).name
        self._reported = 0
        self._scarce = self._broken = False

    def go_on(self) -> list[Notice]:
        """Hand the guard the rows that it lacks, as far as they passed; return notices."""
        notices, stream = self._guard.refresh(), self._armed.stream
        if self._guard.state in REST:
            return notices
        self._begin_from_rest()
        notices += self._found()
        if self._broken:
            return notices
        if not stream.lacks(self._guard.status):
            self._scarce = False
            return notices
        return notices + (self._extend() if stream.ready else self._missing())

    def _begin_from_rest(self) -> None:
        """Replace the first rows by those that begin where the axes stand; a program that has begun continues."""
        first = self._armed.first
        if first is None or self._guard.state != "ARMED":
            return
        rows = first.renew(self._standstill.now())
        if rows is None:
            return
        with contextlib.suppress(DeviceError, StoreError):  # the rows that were armed are still there
            if self._guard.renew(self._armed, rows)["ok"]:
                first.take(rows)

    def _found(self) -> list[Notice]:
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
            then = f"it is corrected for another {self.left_s():.1f} s, then ramped to zero before that line"
        text = f"{notices[0].text}; {self._name} was armed ahead of its check: {then}"
        return [Notice(notices[0].code, "MAJOR", text), *notices[1:]]

    def _extend(self) -> list[Notice]:
        try:
            answer = self._guard.extend(self._armed, self._armed.stream.take())
        except StoreError as error:
            return self._ended(error.code, str(error))
        except DeviceError as error:
            return self._ended("GuardLost", str(error))
        return [] if answer["ok"] else self._ended("StreamRefused", str(answer["text"]))

    def _ended(self, code: str, text: str) -> list[Notice]:
        self._broken = True
        return [Notice(code, "MAJOR", f"{text}; the correction ends before these rows")]

    def _missing(self) -> list[Notice]:
        if self._scarce or self._armed.stream.checked.refused or self.left_s() > SCARCE_S:
            return []
        self._scarce = True
        text = f"the check of {self._name} is only {self.left_s() + RESERVE_S:.1f} s ahead of the motion"
        advice = "reduce the PC's load or arm with --whole; if the check stays behind, the correction ramps to zero"
        return [Notice("CheckBehind", "MAJOR", f"{text}; {advice}")]

    def left_s(self) -> float:
        """Return how many seconds of the program remain that can be corrected by the rows that passed."""
        return max(0.0, self._armed.stream.reach_s - self._guard.row * self._armed.stream.period_s - RESERVE_S)
