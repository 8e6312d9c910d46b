"""Proves that no step of the guard's core outputs an offset beyond the limits, whatever else fails in it.

The offsets that the core would send are replaced by arbitrary integers: the check before the output is proven first.
Then it is proven that the check stops nothing that the core itself computes from a safe state, so that a ramp to zero
always leaves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import count

import pytest

from fdhil.guard import core, limits
from fdhil.guard.interlocks import Alarm
from fdhil.guard.path import Place
from fdhil.guard.protocol import ON_PATH, SENDING, Mode
from fdhil.guard.settings import Settings
from fdhil.guard.state import BusView, Inputs, Output, State, initial
from tests.guard.machine import settings as guard_settings
from tests.proof.symbolic import Integer, assume, for_every_path, integers, prove
from tests.proof.test_motion import Axis

CEILING, NEXT_OFFSETS = limits.ceiling.__name__, core._next_offsets.__name__

pytestmark = pytest.mark.usefixtures("long_computation")

MODES = sorted(SENDING)


class AnyPath:
    """A table with arbitrary offsets, not even smooth."""

    def offsets_at(self, row: int) -> tuple[Integer]:
        return (integers(f"table_{row}")[0],)


class Core:
    """The core with one axis, its limits, offset and rate unknown; axes are stepped one by one with the same code.

    Settings are refused where the largest offset exceeds the compiled ceiling.
    """

    def __init__(self, mode: Mode, monkeypatch: pytest.MonkeyPatch) -> None:
        self.axis = Axis(monkeypatch)
        (self.ceiling,) = integers("ceiling")
        assume(self.axis.limits.offset <= self.ceiling)
        monkeypatch.setattr(core, CEILING, lambda _increments_per_mm: self.ceiling)
        monkeypatch.setattr(core, "type", lambda value: int if isinstance(value, Integer) else type(value), False)
        made = guard_settings(axes=("X",))
        self.settings: Settings = replace(made, axes=(replace(made.axes[0], limits=self.axis.limits),))
        blank = initial(made)
        held = blank.axes[0]._replace(offset=self.axis.offset, rate=self.axis.rate, sent=(self.axis.offset,) * 8)
        self.state: State = blank._replace(mode=mode, axes=(held,), places=(Place(5),))

    def move(self) -> tuple[State, Output]:
        inputs = Inputs(True, (), BusView(silent=False), path=AnyPath())
        return core._move(self.state, inputs, self.settings)


def frames_keep_limits(mode: Mode, monkeypatch: pytest.MonkeyPatch) -> None:
    made = Core(mode, monkeypatch)
    wanted, broken, calls = integers("anything broken")[0], integers("broken")[0], iter(range(9))

    def computed(_state: State, _path: object, _settings: Settings) -> tuple[tuple[Integer, ...], Alarm | None]:
        if mode in ON_PATH and next(calls) == 0 and broken == 1:
            return (), Alarm("OffsetRate")
        return (wanted,), None

    monkeypatch.setattr(core, NEXT_OFFSETS, computed)
    state, output = made.move()
    after = state.axes[0]
    if output.offsets is None:
        prove(state.mode in (Mode.OFF, Mode.FROZEN))
        return
    (frame,) = output.offsets
    prove(made.axis.keeps_limits(frame, made.axis.offset, made.axis.rate))
    prove(abs(frame) <= made.ceiling)
    remembers_zero = state.mode is Mode.OFF  # its axes are at rest at the zero that was sent
    prove((after.offset == frame) & (after.sent[0] == frame))
    prove(after.rate == (0 if remembers_zero else frame - made.axis.offset))


def promise_motion(axis: Axis, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put what was proven of the motion and of its check in their place."""
    numbers = count()

    def move(_limits: object, offset: Integer, rate: Integer, *_goal: object) -> Integer:
        prove(axis.is_safe(offset, rate))
        (following,) = integers(f"following_{next(numbers)}")
        assume(axis.is_good(following, offset, rate))
        return following

    def violation(_limits: object, offset: Integer, rate: Integer, following: Integer) -> str | None:
        if axis.is_good(following, offset, rate):
            return None
        (passes,) = integers(f"passes_{next(numbers)}")
        return None if passes == 1 else "OffsetRate"

    for name, promise in {"follow": move, "brake": move, "violation": violation}.items():
        monkeypatch.setattr(core, name, promise)


def frames_leave(mode: Mode, monkeypatch: pytest.MonkeyPatch) -> None:
    """From a safe state inside the ceiling a frame always leaves, and the state that it leaves is safe.

    ``follow``, ``brake`` and ``violation`` stand for what ``test_motion`` proves of them.
    """
    made = Core(mode, monkeypatch)
    promise_motion(made.axis, monkeypatch)
    assume(abs(made.axis.offset) <= made.ceiling)
    if mode is Mode.ARMED:
        assume(made.axis.offset == 0, made.axis.rate == 0)
    state, output = made.move()
    prove(output.offsets is not None)
    prove(state.mode is not Mode.FROZEN or (state.cause is not None and state.cause.code == "EchoMismatch"))
    after = state.axes[0]
    prove(made.axis.is_safe(after.offset, after.rate))
    prove(abs(after.offset) <= made.ceiling)


@pytest.mark.parametrize("theorem", [frames_keep_limits, frames_leave], ids=lambda theorem: theorem.__name__)
@pytest.mark.parametrize("mode", MODES)
def test_frames(
    theorem: Callable[[Mode, pytest.MonkeyPatch], None], mode: Mode, monkeypatch: pytest.MonkeyPatch
) -> None:
    for_every_path(partial(theorem, mode, monkeypatch))
