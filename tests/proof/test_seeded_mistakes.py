"""The proof fails for a wrong limit or transition; otherwise it would prove nothing."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from fdhil.guard import guard_step, offset_limits
from fdhil.guard.guard_protocol import Mode
from tests.proof import test_frames, test_motion
from tests.proof.symbolic import NotProven, for_every_path

pytestmark = pytest.mark.usefixtures("long_computation")

Theorem = Callable[[pytest.MonkeyPatch], None]
PASSED_ON = partial(test_frames.frames_keep_limits, Mode.RAMP_DOWN)
LEFT_BEHIND = partial(test_frames.frames_leave, Mode.RAMP_DOWN)

MISTAKES: tuple[tuple[Callable[..., Any], str, str, Theorem], ...] = (
    (offset_limits.move_toward_goal, "-limits.hard_rate, limits.hard_rate", "-limits.hard_rate, limits.hard_rate + 1",
     test_motion.follow_keeps_limits),
    (offset_limits.move_toward_goal, "rate + limits.acceleration)", "rate + limits.acceleration + 3)",
     test_motion.follow_keeps_limits),
    (offset_limits.move_toward_goal, "missing = wanted - offset - wanted_rate", "missing = offset - wanted - "
                                                                                "wanted_rate",
     test_motion.ramp_to_zero_ends),
    (offset_limits._limit_outward_speed, "limits.offset - outward * offset", "limits.offset + outward * offset",
     test_motion.follow_keeps_limits),
    (offset_limits._limit_outward_speed, "max(0, limits.offset - outward * offset)", "limits.offset",
     test_motion.follow_keeps_limits),
    (offset_limits.decelerate_offset, "speed = rate -", "speed = rate +", test_motion.brake_keeps_limits_and_ends),
    (offset_limits.decelerate_offset, "-limits.acceleration, limits.acceleration)", "0, limits.acceleration)",
     test_motion.brake_keeps_limits_and_ends),
    (offset_limits.find_limit_violation, "abs(speed) <= limits.hard_rate", "speed <= limits.hard_rate",
     test_motion.check_lets_pass_only_what_keeps_limits),
    (offset_limits.find_limit_violation, "speed > 0 if offset > 0", "speed > 0 if offset < 0",
     test_motion.check_lets_pass_what_is_safe),
    (guard_step._move_offsets, "if wrong is not None", "if wrong is not None and state.measuring", PASSED_ON),
    (guard_step._check_offset_frames, "abs(offset) <= ", "offset <= ", PASSED_ON),
    (guard_step._note_sent_offset, "move = offset - axis.offset", "move = axis.offset - offset", PASSED_ON),
    (guard_step._note_sent_offset, "offset=offset", "offset=axis.offset", PASSED_ON),
    (guard_step._move_offsets, f"state = {guard_step._finish_ramps.__name__}(",
     f"return state, StepOutput()\n    state = {guard_step._finish_ramps.__name__}(", LEFT_BEHIND),
)  # fmt: skip


def put_mistake(function: Callable[..., Any], right: str, wrong: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace a function in its module by one with a mistake."""
    module, name, source = sys.modules[function.__module__], function.__name__, inspect.getsource(function)
    assert right in source
    monkeypatch.setattr(module, name, function)  # so that it is put back
    exec(compile("from __future__ import annotations\n" + source.replace(right, wrong), name, "exec"), vars(module))


@pytest.mark.parametrize(("function", "right", "wrong", "theorem"), MISTAKES)
def test_mistake_breaks_the_proof(
    function: Callable[..., Any], right: str, wrong: str, theorem: Theorem, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_mistake(function, right, wrong, monkeypatch)
    with pytest.raises(NotProven):
        for_every_path(partial(theorem, monkeypatch))
