"""One entry per axis: a list that is too short is an error, never a shorter frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from fdhil.guard import (
    corrected_path,
    correction_table,
    emergency_ramp,
    feedforward_step,
    guard_status,
    guard_step,
    offset_adoption,
    read_back_checks,
)
from fdhil.guard import feedforward_law as feed
from fdhil.guard.corrected_path import CorrectedPath, PathPosition
from fdhil.guard.guard_protocol import Mode
from fdhil.guard.guard_state import (
    AxisInput,
    BusView,
    GuardRequest,
    GuardState,
    StepInputs,
    StepOutput,
    make_initial_state,
)
from fdhil.guard.interlock_checks import combine_axis_views
from fdhil.guard.interlocks import Alarm
from tests.guard import simulated_bus
from tests.guard.feedforward_machine import LAW, LIMITS, fed_settings
from tests.guard.simulated_bus import DIGEST

MADE = simulated_bus.settings()
STATE = make_initial_state(MADE)
FEWER = STATE._replace(axes=STATE.axes[:1])
SEEN = (AxisInput(target=0), AxisInput(target=0))
INPUTS = StepInputs(True, SEEN, BusView())
PATH = CorrectedPath(0, ([0, 9], [0, 9]), ([0, 0], [0, 0]), True, DIGEST)
FED = feed.arm_feedforward((LAW, LAW))._replace(targets=((0,) * 3,) * 2)


def sending(mode: Mode) -> GuardState:
    return FEWER._replace(mode=mode, places=(PathPosition(0),))


def next_offsets(mode: Mode) -> Callable[[], Any]:
    return lambda: guard_step._compute_next_offsets(sending(mode), PATH, MADE)


CASES: dict[str, Callable[[], Any]] = {
    "what belongs to each axis": lambda: combine_axis_views(MADE, INPUTS, FEWER),
    "what was observed": lambda: read_back_checks.observe_drives(FEWER, INPUTS._replace(alarms=()), MADE),
    "speed and torque shown": lambda: read_back_checks._compare_feedforward_read_back(
        STATE.axes[0],
        (0,),  # type: ignore[arg-type]
        [(0, 0)] * 2,
    ),
    "offsets while held": next_offsets(Mode.HOLD),
    "offsets toward zero": next_offsets(Mode.RAMP_DOWN),
    "offsets of the table": next_offsets(Mode.ACTIVE),
    "the check of a frame": lambda: guard_step._check_offset_frames(STATE, (0,), MADE),
    "the frame": lambda: guard_step._move_offsets(FEWER._replace(mode=Mode.ARMED), INPUTS, MADE),
    "the comparison": lambda: offset_adoption.apply_drive_comparison(FEWER, GuardRequest("compared", True), MADE),
    "targets and rows": lambda: PATH.measure_row_distance(0, (0,)),
    "targets along the path": lambda: corrected_path.compute_path_rate(PATH, 0, (0, 0), (4, 4, 4)),
    "targets heard": lambda: feed.take_targets(FED, [0]),
    "targets of the laws": lambda: feed.advance_feedforward(FED._replace(targets=((0,) * 3,)), [LIMITS] * 2, 20),
    "limits of the laws": lambda: feed.advance_feedforward(FED, [LIMITS], 20),
    "what is faded": lambda: feed._limit_pair((0,), (0, 0), 1, 20, LIMITS),  # type: ignore[arg-type]
    "the check of speed and torque": lambda: feed.violates_limits(LIMITS, (0,), (0, 0)),  # type: ignore[arg-type]
    "the feed-forward's frame": lambda: feedforward_step.step_feedforward(
        STATE._replace(feed=feed.begin_zeroing(1, Alarm("StaleOffset"))), INPUTS, (), fed_settings(), StepOutput()
    ),
    "a landing": lambda: emergency_ramp._send_next_offsets(MADE, _Taking(), [(0, 0)], 1),  # type: ignore[arg-type]
    "what is shown": lambda: guard_status.convert_to_um([0], MADE),
}


ZEROS = {"X": [0, 0], "Y": [0, 0]}
BODY = correction_table.encode_table("XY", ZEROS, ZEROS, DIGEST)
LOADED = CorrectedPath(0, ([0, 0], [0, 0]), ([0, 0], [0, 0]), True, DIGEST)
CASES |= {
    "limits of a table": lambda: correction_table.TableLoading(LOADED, (simulated_bus.LIMITS,)).check_next_rows(1),
    "demand of a table": lambda: correction_table.begin_renewal(
        BODY, 1, "XY", (simulated_bus.LIMITS,) * 2, replace(LOADED, demand=LOADED.demand[:1])
    ),
    "offsets of a table": lambda: correction_table.begin_renewal(
        BODY, 1, "XY", (simulated_bus.LIMITS,) * 2, replace(LOADED, offset=LOADED.offset[:1])
    ),
    "pieces of a table": lambda: correction_table._join_columns([[0], [0]], [[0]], 0),
}


class _Taking:
    def send(self, cob_id: int, data: bytes) -> bool:
        return bool(cob_id and data)


@pytest.mark.parametrize("what", CASES)
def test_list_that_is_too_short_is_an_error(what: str) -> None:
    with pytest.raises(ValueError, match="zip"):
        CASES[what]()
