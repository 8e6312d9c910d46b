"""The daemon's link to the guard process: found again when it was gone, told that the daemon lives, asked to arm."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from fdhil.daemon.arming import Armament, Feeding, StreamedArmament
from fdhil.daemon.streamed import Piece
from fdhil.errors import DeviceError
from fdhil.guard.client import GuardClient
from fdhil.records import Notice

ABSENT: Mapping[str, Any] = {"state": "absent", "text": "no guard runs: nothing can be armed, nothing is sent"}
SETTLING_TRIES = 25
SETTLING_S = 0.2
CHARGED = {"ARMED", "RAMPING", "ACTIVE", "HOLD", "FEEDFORWARD"}
ORDERED = {"Disarmed", "Finished", "Stopped"}
TRIPPED = "GuardTripped"
RECORD_VOID = "RecordVoid"
VOIDING = {RECORD_VOID, "NodeRebooted"}
REST = {"OFF", "FROZEN", "absent"}


class GuardLink:
    """At most one connection; ``state`` is the guard's, ``absent`` while there is none. Safe from several threads."""

    def __init__(self, run_directory: Path) -> None:
        self._run_directory = run_directory
        self._lock = threading.Lock()
        self._client: GuardClient | None = None
        self._status: Mapping[str, Any] = ABSENT
        self._untold: list[Notice] = []

    @property
    def connected(self) -> bool:
        """Whether there is a connection."""
        return self._client is not None

    @property
    def status(self) -> Mapping[str, Any]:
        """What the guard said last."""
        return self._status

    @property
    def state(self) -> str:
        """The guard's state when it was asked last."""
        return str(self._status["state"])

    @property
    def row(self) -> int:
        """The row of the path where the machine is, 0 before it has begun."""
        return int(self._status.get("row") or 0)

    def look(self) -> None:
        """Connect where needed and ask for the status (blocking); what changed is told by the next ``refresh``."""
        with contextlib.suppress(DeviceError), self._asked():
            pass

    def refresh(self) -> list[Notice]:
        """Look at the status (blocking); return what changed since the last call."""
        self.look()
        with self._lock:
            told, self._untold = self._untold, []
        return told

    @contextlib.contextmanager
    def _asked(self) -> Iterator[GuardClient]:
        """Give the connection, and look at the status afterwards; what changed is told by the next ``refresh``.

        A guard that does not answer is let go: what it may have armed it ramps down, and so it ends as it is told.
        """
        with self._lock:
            before = self._status
            try:
                if self._client is None:
                    self._client = GuardClient(self._run_directory)
                yield self._client
                status = self._client.status()
            except DeviceError as error:
                self._drop()
                self._untold += self._gone(before, error)
                raise
            self._untold += _changes(before, status)
            self._status = status

    def _drop(self) -> None:
        if self._client is not None:
            self._client.close()
        self._client, self._status = None, ABSENT

    @staticmethod
    def _gone(before: Mapping[str, Any], error: DeviceError) -> list[Notice]:
        if before["state"] == "absent":
            return []
        severity: Any = "minor" if before["state"] == "OFF" else "MAJOR"
        return [Notice("GuardLost", severity, f"{error}; it was in state {before['state']}")]

    def say_alive(self, facts: Mapping[str, bool] | None) -> None:
        """Tell the guard that the daemon is well (never blocks); a guard that is gone is found out by ``refresh``."""
        client = self._client
        if client is not None:
            try:
                client.alive(facts)
            except DeviceError:
                self._status = {**self._status, "text": "the connection is lost"}

    def arm(self, armament: Armament | StreamedArmament, token: str) -> Mapping[str, Any]:
        """Load the table and arm (blocking); return the guard's answer. DeviceError when there is no guard."""
        with self._asked() as client:
            answer = self._load(client, armament, armament.first())
            if not answer["ok"]:
                return answer
            return self._ask(client, lambda: client.arm(token, armament.program_digest, armament.facts))

    @staticmethod
    def _load(client: GuardClient, armament: Armament | StreamedArmament, piece: Piece) -> Mapping[str, Any]:
        return client.load(armament.axes, piece.demand, piece.offset, armament.program_digest, piece.first, piece.final)

    def extend(self, armament: StreamedArmament, piece: Piece) -> Mapping[str, Any]:
        """Hand on more rows of a running stream (blocking); DeviceError when there is no guard."""
        with self._asked() as client:
            return self._load(client, armament, piece)

    def feed_forward(self, feeding: Feeding, token: str) -> Mapping[str, Any]:
        """Switch the on-line feed-forward on (blocking); return the guard's answer. DeviceError without a guard."""
        with self._asked() as client:
            return self._ask(client, lambda: client.feed_forward(token, feeding.laws, feeding.facts))

    @staticmethod
    def _ask(client: GuardClient, arm: Callable[[], Mapping[str, Any]]) -> Mapping[str, Any]:
        """Ask until the interlocks have been good for long enough, for a few seconds; any other no is final."""
        for _ in range(SETTLING_TRIES):
            client.alive(None)  # planning took its time: the guard must know us as alive when it is asked
            answer = arm()
            if answer["ok"] or [told["code"] for told in answer.get("refused", [])] != ["NotSettled"]:
                break
            time.sleep(SETTLING_S)
        return answer

    def disarm(self) -> Mapping[str, Any]:
        """Ask for the ramp to zero (blocking); DeviceError when there is no guard."""
        with self._asked() as client:
            return client.disarm()

    def close(self) -> None:
        """End the connection; a correction that still runs is ramped down by the guard."""
        with self._lock:
            self._drop()


def _changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[Notice]:
    """Say when the guard came, changed its state, or saw a record void; what something ended is a trip."""
    return [*_voided(before, now), *_moved(before, now)]


def _voided(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[Notice]:
    """Say which records hold no longer."""
    known = {told["axis"] for told in before.get("not_good", []) if told["code"] == RECORD_VOID}
    void = [told for told in now.get("not_good", []) if told["code"] == RECORD_VOID and told["axis"] not in known]
    return [Notice(RECORD_VOID, "MAJOR", f"{told['text']}; {told['advice']}", told["axis"]) for told in void]


def _moved(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[Notice]:
    if before["state"] == now["state"]:
        return []
    cause = now.get("cause") or {}
    why = f": {cause.get('code', '')}: {cause['text']}" if cause.get("text") else ""
    if before["state"] == "absent":
        return [Notice("GuardFound", "info", f"the guard runs, in state {now['state']}{why}")]
    severity: Any = "MAJOR" if now["state"] == "FROZEN" else "info"
    notice = Notice("GuardState", severity, f"{before['state']} -> {now['state']}{why}", cause.get("axis", ""))
    tripped = before["state"] in CHARGED and now["state"] not in CHARGED and cause.get("code") not in ORDERED
    if not tripped:
        return [notice]
    return [notice, Notice(TRIPPED, "MAJOR", f"{cause.get('code')}: {cause.get('text')}", cause.get("axis", ""))]
