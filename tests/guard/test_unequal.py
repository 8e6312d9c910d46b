"""One entry per axis: a list that is too short is an error, never a shorter frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from fdhil.guard import adoption, core, feeding, landing, path, plausibility, status, table
from fdhil.guard import feedforward as feed
from fdhil.guard.conditions import views_of
from fdhil.guard.interlocks import Alarm
from fdhil.guard.path import CorrectedPath, Place
from fdhil.guard.protocol import Mode
from fdhil.guard.state import AxisInput, BusView, Inputs, Output, Request, State, initial
from tests.guard import machine
from tests.guard.fed import LAW, LIMITS, fed_settings
from tests.guard.machine import DIGEST

MADE = machine.settings()
STATE = initial(MADE)
FEWER = STATE._replace(axes=STATE.axes[:1])
SEEN = (AxisInput(target=0), AxisInput(target=0))
INPUTS = Inputs(True, SEEN, BusView())
PATH = CorrectedPath(0, ([0, 9], [0, 9]), ([0, 0], [0, 0]), True, DIGEST)
FED = feed.armed((LAW, LAW))._replace(targets=((0,) * 3,) * 2)


def sending(mode: Mode) -> State:
    return FEWER._replace(mode=mode, places=(Place(0),))


def next_offsets(mode: Mode) -> Callable[[], Any]:
    return lambda: core._next_offsets(sending(mode), PATH, MADE)


CASES: dict[str, Callable[[], Any]] = {
    "what belongs to each axis": lambda: views_of(MADE, INPUTS, FEWER),
    "what was observed": lambda: plausibility.observe(FEWER, INPUTS._replace(alarms=()), MADE),
    "speed and torque shown": lambda: plausibility._fed(STATE.axes[0], (0,), [(0, 0)] * 2),  # type: ignore[arg-type]
    "offsets while held": next_offsets(Mode.HOLD),
    "offsets toward zero": next_offsets(Mode.RAMP_DOWN),
    "offsets of the table": next_offsets(Mode.ACTIVE),
    "the check of a frame": lambda: core._wrong_frame(STATE, (0,), MADE),
    "the frame": lambda: core._move(FEWER._replace(mode=Mode.ARMED), INPUTS, MADE),
    "the comparison": lambda: adoption.compared(FEWER, Request("compared", True), MADE),
    "targets and rows": lambda: PATH.mismatch(0, (0,)),
    "targets along the path": lambda: path.rate_between(PATH, 0, (0, 0), (4, 4, 4)),
    "targets heard": lambda: feed.hear(FED, [0]),
    "targets of the laws": lambda: feed.move(FED._replace(targets=((0,) * 3,)), [LIMITS] * 2, 20),
    "limits of the laws": lambda: feed.move(FED, [LIMITS], 20),
    "what is faded": lambda: feed._inside((0,), (0, 0), 1, 20, LIMITS),  # type: ignore[arg-type]
    "the check of speed and torque": lambda: feed.violates(LIMITS, (0,), (0, 0)),  # type: ignore[arg-type]
    "the feed-forward's frame": lambda: feeding.go_on(
        STATE._replace(feed=feed.zeroing(1, Alarm("StaleOffset"))), INPUTS, (), fed_settings(), Output()
    ),
    "a landing": lambda: landing._step(MADE, _Taking(), [(0, 0)], 1),  # type: ignore[arg-type]
    "what is shown": lambda: status.in_um([0], MADE),
}


ZEROS = {"X": [0, 0], "Y": [0, 0]}
BODY = table.encode("XY", ZEROS, ZEROS, DIGEST)
LOADED = CorrectedPath(0, ([0, 0], [0, 0]), ([0, 0], [0, 0]), True, DIGEST)
CASES |= {
    "limits of a table": lambda: table.Loading(LOADED, (machine.LIMITS,)).check(1),
    "demand of a table": lambda: table.renew(
        BODY, 1, "XY", (machine.LIMITS,) * 2, replace(LOADED, demand=LOADED.demand[:1])
    ),
    "offsets of a table": lambda: table.renew(
        BODY, 1, "XY", (machine.LIMITS,) * 2, replace(LOADED, offset=LOADED.offset[:1])
    ),
    "pieces of a table": lambda: table._join([[0], [0]], [[0]], 0),
}


class _Taking:
    def send(self, cob_id: int, data: bytes) -> bool:
        return bool(cob_id and data)


@pytest.mark.parametrize("what", CASES)
def test_a_list_that_is_too_short_is_an_error(what: str) -> None:
    with pytest.raises(ValueError, match="zip"):
        CASES[what]()
