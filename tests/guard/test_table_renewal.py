"""New first rows for an armed table before its start: accepted complete and checked, or not at all."""

from __future__ import annotations

import json
import os
import socket
from typing import Any

import pytest

from fdhil.guard import correction_table
from fdhil.guard.guard_protocol import Mode
from fdhil.guard.guard_socket import DescriptorCloser, GuardSocketClient
from tests.guard.guard_rig import DEMAND, OFFSET, OWNER
from tests.guard.simulated_bus import DIGEST
from tests.guard.test_guard_loop import Make, inside, make

__all__ = ["make"]


def renewing(height: int, rows: int = 200, **changes: Any) -> int:
    demand, offset = ([list(column[:rows]) for column in columns] for columns in (DEMAND, OFFSET))
    offset[0] = [value + min(height, k // 20, (rows - k) // 20) for k, value in enumerate(offset[0])]
    values = {"demand": dict(zip("XY", demand, strict=True)), "offset": dict(zip("XY", offset, strict=True))} | changes
    digest = values.get("program_digest", DIGEST)
    return correction_table.seal_table(
        correction_table.encode_table("XY", values["demand"], values["offset"], digest, 0, False)
    )


def test_armed_guard_accepts_new_first_rows_before_the_start(make: Make) -> None:
    shop = make()
    client = shop.arm()
    assert shop.guard.intake.path is not None
    before = [list(column) for column in shop.guard.intake.path.offset]
    sealed = renewing(3)
    try:
        assert shop.ask(client, {"request": "table"}, sealed)["code"] == "TableBusy"  # it does not say what it means
        answer = shop.ask(client, {"request": "table", "renew": True}, sealed)
    finally:
        os.close(sealed)
    assert answer["ok"], answer
    assert answer["rows"] == [0, len(before[0])]
    path = shop.guard.intake.path
    assert path.offset[0][100] == before[0][100] + 3
    assert list(path.offset[0][200:]) == before[0][200:]
    assert shop.state == "ARMED"
    shop.playing = True
    shop.run(100)
    assert shop.state == "ACTIVE"
    row = shop.guard.state.places[0].row + 1
    assert shop.offsets()[-1] == path.offset[0][row] == before[0][row] + 3
    inside(shop.offsets())


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"program_digest": "another"}, "ProgramMismatch"),
        ({"demand": {"X": [7] * 200, "Y": [0] * 200}}, "ProgramMismatch"),
        ({"offset": {"X": [0] * 100 + [200] * 100, "Y": [0] * 200}}, "OffsetRate"),
    ],
)
def test_renewal_with_other_rows_or_beyond_a_limit_is_refused(make: Make, changes: dict[str, Any], code: str) -> None:
    shop = make()
    client = shop.arm()
    before = shop.guard.intake.path
    sealed = renewing(3, **changes)
    try:
        assert shop.ask(client, {"request": "table", "renew": True}, sealed)["code"] == code
    finally:
        os.close(sealed)
    assert shop.guard.intake.path is before
    assert shop.state == "ARMED"


def test_machine_that_starts_during_renewal_keeps_its_table(make: Make) -> None:
    shop = make()
    client = shop.arm()
    before = shop.guard.intake.path
    sealed = renewing(3)
    try:
        socket.send_fds(client, [b'{"request": "table", "renew": true}\n'], [sealed])
        shop.playing = True
        answer = shop.answer(client)
        assert answer.get("code") == "TableBusy" or shop.state == "ARMED"
        shop.run(250)
        assert shop.ask(client, {"request": "table", "renew": True}, sealed)["code"] == "TableBusy"
    finally:
        os.close(sealed)
    assert shop.state == "ACTIVE"
    assert shop.guard.intake.path is not None
    assert before is not None
    inside(shop.offsets())


def test_half_checked_renewal_is_refused_when_the_machine_starts(make: Make) -> None:
    shop = make()
    shop.arm()
    intake, state, closer = shop.guard.intake, shop.guard.state, DescriptorCloser()
    before = intake.path
    here, there = socket.socketpair()
    with here, there:
        intake.begin_table(GuardSocketClient(here, 0.0, closer, OWNER, descriptor=renewing(3)), {"renew": True}, state)
        assert intake.busy
        intake.check_next_rows(state._replace(mode=Mode.RAMPING))
        closer.finish_closing()
        assert json.loads(there.recv(10_000))["code"] == "TableBusy"
    assert intake.path is before
