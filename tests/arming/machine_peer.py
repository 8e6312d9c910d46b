"""A guard peer that accepts its table and joins rows like the real guard; the test moves the machine along it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fdhil.guard import correction_table
from tests.arming.guard_peer import ZERO, GuardPeer

RESERVE_ROWS = 1000
Answer = Mapping[str, Any]


class MachinePeer:
    def __init__(self, folder: Path) -> None:
        self.state, self.row, self.cause = "OFF", 0, ""
        self.rows: list[tuple[int, ...]] = []
        self.final = False
        self._peer = GuardPeer(folder)
        self._peer.says = self._answer_request

    def _answer_request(self, kind: str) -> Answer:
        if kind == "table":
            return self._load_table()
        if kind == "arm":
            self.state = "ARMED"
        elif kind == "disarm":
            self.state, self.cause = "OFF", "Disarmed"
        cause = {"code": self.cause, "text": "", "axis": ""} if self.cause else None
        rows = [0, len(self.rows)] if self.rows else None
        known = {"cause": cause, "may_stand_um": ZERO}
        return {"ok": True, "state": self.state, "row": self.row or None, "rows": rows, **known}

    def _load_table(self) -> Answer:
        _, path = correction_table.decode_table(correction_table.read_sealed_memory(self._peer.descriptor))
        if path.first == 0:
            self.rows = []
        if path.first != len(self.rows):
            return {"ok": False, "code": "ProgramMismatch", "text": "these rows do not continue the table"}
        self.final = path.final  # first: a client that sees the rows may move
        self.rows += list(zip(*path.demand, *path.offset, strict=True))
        return {"ok": True, "rows": [0, len(self.rows)]}

    def advance(self, row: int) -> None:
        """Let the machine reach a row; with too few rows ahead, the correction is ramped down."""
        self.state, self.row = "ACTIVE", row
        if not self.final and len(self.rows) - row < RESERVE_ROWS:
            self.state, self.cause = "OFF", "TableStarved"

    def close(self) -> None:
        self._peer.close()
