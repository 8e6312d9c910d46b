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

from fdhil.guard import guard_step, offset_limits
from fdhil.guard.corrected_path import PathPosition
from fdhil.guard.guard_protocol import ON_PATH, SENDING, Mode
from fdhil.guard.guard_settings import GuardSettings
from fdhil.guard.guard_state import BusView, GuardState, StepInputs, StepOutput, make_initial_state
from fdhil.guard.interlocks import Alarm
from tests.guard.simulated_bus import settings as guard_settings
from tests.proof.symbolic import Integer, assume, for_every_path, integers, prove
from tests.proof.test_motion import Axis

CEILING, NEXT_OFFSETS = offset_limits.compute_offset_ceiling.__name__, guard_step._compute_next_offsets.__name__

pytestmark = pytest.mark.usefixtures("long_computation")

MODES = sorted(SENDING)


class AnyPath:
    """A table with arbitrary offsets, not even smooth."""

    def get_row_offsets(self, row: int) -> tuple[Integer]:
        return (integers(f"table_{row}")[0],)


class Core:
    """The core with one axis, its limits, offset and rate unknown; axes are stepped one by one with the same code.

    Settings are refused where the largest offset exceeds the compiled ceiling.
    """

    def __init__(self, mode: Mode, monkeypatch: pytest.MonkeyPatch) -> None:
        self.axis = Axis(monkeypatch)
        (self.ceiling,) = integers("ceiling")
        assume(self.axis.limits.offset <= self.ceiling)
        monkeypatch.setattr(guard_step, CEILING, lambda _increments_per_mm: self.ceiling)
        monkeypatch.setattr(guard_step, "type", lambda value: int if isinstance(value, Integer) else type(value), False)
        made = guard_settings(axes=("X",))
        self.settings: GuardSettings = replace(made, axes=(replace(made.axes[0], limits=self.axis.limits),))
        blank = make_initial_state(made)
        held = blank.axes[0]._replace(offset=self.axis.offset, rate=self.axis.rate, sent=(self.axis.offset,) * 8)
        self.state: GuardState = blank._replace(mode=mode, axes=(held,), places=(PathPosition(5),))

    def move(self) -> tuple[GuardState, StepOutput]:
        inputs = StepInputs(True, (), BusView(silent=False), path=AnyPath())
        return guard_step._move_offsets(self.state, inputs, self.settings)


def frames_keep_limits(mode: Mode, monkeypatch: pytest.MonkeyPatch) -> None:
    made = Core(mode, monkeypatch)
    wanted, broken, calls = integers("anything broken")[0], integers("broken")[0], iter(range(9))

    def computed(
        _state: GuardState, _path: object, _settings: GuardSettings
    ) -> tuple[tuple[Integer, ...], Alarm | None]:
        if mode in ON_PATH and next(calls) == 0 and broken == 1:
            return (), Alarm("OffsetRate")
        return (wanted,), None

    monkeypatch.setattr(guard_step, NEXT_OFFSETS, computed)
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

    for name, promise in {
        "move_toward_goal": move,
        "decelerate_offset": move,
        "find_limit_violation": violation,
    }.items():
        monkeypatch.setattr(guard_step, name, promise)


def frames_leave(mode: Mode, monkeypatch: pytest.MonkeyPatch) -> None:
    """From a safe state inside the ceiling a frame always leaves, and the state that it leaves is safe.

    ``move_toward_goal``, ``decelerate_offset`` and ``find_limit_violation`` are replaced by what
    ``test_theorem_about_motion_is_proven`` proves of them.
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
def test_theorem_about_frames_is_proven(
    theorem: Callable[[Mode, pytest.MonkeyPatch], None], mode: Mode, monkeypatch: pytest.MonkeyPatch
) -> None:
    for_every_path(partial(theorem, mode, monkeypatch))
