"""Links the daemon to the guard process: connects, sends its sign of life, and asks it to arm."""

import contextlib
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

from fdhil.arming.answers import CHECK_ABANDONED
from fdhil.arming.checked_program import Piece
from fdhil.arming.guard_client import GuardClient
from fdhil.arming.preparing import Armament, Feeding
from fdhil.arming.standing import ABSENT, GONE, START_AND_ADOPT, Standing, landed, lost, standing
from fdhil.arming.standing_mark import StandingMark
from fdhil.errors import ConnectError, DeviceError
from fdhil.guard.guard_protocol import AT_REST, CHARGED_STATES
from fdhil.records import Notice
from fdhil.system_clock import SYSTEM_CLOCK, Clock

SETTLING_TRIES = 25
SETTLING_S = 0.2
ORDERED_ENDS = {"Disarmed", "Finished", "Stopped"}
GUARD_TRIPPED = "GuardTripped"
RECORD_VOID = "RecordVoid"
RECORD_VOIDING_CODES = {RECORD_VOID, "NodeRebooted"}


class GuardLink:
    """Keeps at most one connection to the guard; safe from several threads.

    ``state`` is the guard's; without a connection it is ``absent`` if nothing can be applied, ``lost`` if something may
    be, also by what an earlier daemon left in the store.
    """

    def __init__(self, run_directory: Path, store_directory: Path, clock: Clock = SYSTEM_CLOCK) -> None:
        self._run_directory, self._clock = run_directory, clock
        self._lock = threading.Lock()
        self._client: GuardClient | None = None
        self._mark = StandingMark(store_directory)
        self._status: Mapping[str, Any] = self._mark.left or ABSENT
        self._missed = self._mark.left is None
        self._status_s: float | None = None
        self._unreported: list[Notice] = []
        self._ended = False

    @property
    def connected(self) -> bool:
        return self._client is not None

    @property
    def status(self) -> Mapping[str, Any]:
        """The guard's last status and its age in s (None if there never was one)."""
        age_s = None if self._status_s is None else round(self._clock.now_s() - self._status_s, 3)
        return {**self._status, "heard_s_ago": age_s}

    @property
    def standing(self) -> Standing:
        """What may still be applied in the drives, by the guard's last status."""
        return standing(self._status)

    @property
    def state(self) -> str:
        return str(self._status["state"])

    @property
    def disarms(self) -> int | None:
        """How often the guard had been disarmed by its last status; None if it does not report it."""
        return self._status.get("disarms")

    @property
    def row(self) -> int:
        """The row of the path where the machine is, 0 before it has begun."""
        return int(self._status.get("row") or 0)

    def look(self) -> Mapping[str, Any]:
        """Connect if needed, read the status and return it (blocking); the next ``refresh`` reports the changes."""
        with contextlib.suppress(DeviceError), self._asked():
            pass
        return self._status

    def refresh(self) -> list[Notice]:
        self.look()
        return self.take_changes()

    def take_changes(self) -> list[Notice]:
        """Return the changes since the last call, as far as they were seen."""
        with self._lock:
            changes, self._unreported = self._unreported, []
        return changes

    @contextlib.contextmanager
    def _asked(self, arming: bool = False) -> Iterator[GuardClient]:
        """Yield the connection, and read the status afterwards; the next ``refresh`` reports the changes.

        A guard that does not answer is disconnected: what it may have armed it then ramps to zero.
        """
        with self._lock:
            if self._ended:
                raise ConnectError("guard", "is disconnected: the daemon is shutting down; start it again")
            before = self._status
            try:
                if self._client is None:
                    self._client = GuardClient(self._run_directory, clock=self._clock)
                if arming:
                    self._mark.keep(standing(lost(before, arming)))
                yield self._client
                self._status, self._status_s = self._client.status(), self._clock.now_s()
                self._keep()
                self._unreported += _changes(before, self._status)
            except DeviceError as error:
                reached = self._client is not None
                self._drop()
                self._status = lost(before, arming and reached)
                if not self._missed or before["state"] not in GONE or self._status["state"] != before["state"]:
                    self._unreported.append(_gone(before, self._status, error))
                self._missed = True
                raise

    def _keep(self) -> None:
        residual = standing(self._status)
        if residual.nothing:
            self._mark.remove()
        elif residual.known:
            self._mark.keep(residual)

    def _drop(self) -> None:
        if self._client is not None:
            self._client.close()
        self._client = None

    def say_alive(self, facts: Mapping[str, bool] | None) -> None:
        """Report to the guard that the daemon is well (never blocks); ``refresh`` finds out if the guard is gone."""
        client = self._client
        if client is not None:
            try:
                client.alive(facts)
            except DeviceError:
                self._status = {**self._status, "text": "the connection is lost"}

    def arm(
        self, armament: Armament, token: str, given_up: Callable[[], bool], disarms: int | None
    ) -> Mapping[str, Any]:
        """Load the table and arm (blocking), unless ``cancel_itself`` by then; return the guard's answer.

        A disarm that was answered in the meantime takes precedence; so does one that the guard counted after the first
        ``disarms``. Raises DeviceError if there is no guard.
        """
        with self._asked(arming=True) as client:
            if given_up():
                return CHECK_ABANDONED
            answer = self._load(client, armament, armament.begin)
            if not answer["ok"]:
                return answer
            digest, facts = armament.stream.program_digest, armament.facts
            return self._ask(client, lambda: client.arm(token, digest, facts, disarms), given_up)

    @staticmethod
    def _load(client: GuardClient, armament: Armament, piece: Piece, renew: bool = False) -> Mapping[str, Any]:
        digest = armament.stream.program_digest
        return client.load(armament.stream.axes, piece.demand, piece.offset, digest, piece.first, piece.final, renew)

    def extend(self, armament: Armament, piece: Piece) -> Mapping[str, Any]:
        """Hand more rows of a running stream to the guard (blocking). Raises DeviceError if there is no guard."""
        with self._asked() as client:
            return self._load(client, armament, piece)

    def renew(self, armament: Armament, piece: Piece) -> Mapping[str, Any]:
        """Replace the first rows of a program that has not begun (blocking). DeviceError if there is no guard."""
        with self._asked() as client:
            return self._load(client, armament, piece, renew=True)

    def feed_forward(
        self, feeding: Feeding, token: str, given_up: Callable[[], bool], disarms: int | None
    ) -> Mapping[str, Any]:
        """Enable the on-line feed-forward (blocking), like ``arm``. Raises DeviceError if there is no guard."""
        with self._asked(arming=True) as client:
            laws, facts = feeding.laws, feeding.facts
            return self._ask(client, lambda: client.feed_forward(token, laws, facts, disarms), given_up)

    def _ask(
        self, client: GuardClient, arm: Callable[[], Mapping[str, Any]], given_up: Callable[[], bool]
    ) -> Mapping[str, Any]:
        """Repeat the request for a few seconds while the interlocks settle; any other refusal is final."""
        answer: Mapping[str, Any] = CHECK_ABANDONED
        for _ in range(SETTLING_TRIES):
            if given_up():
                return CHECK_ABANDONED
            client.alive(None)  # planning took its time: the guard needs a recent sign of life
            answer = arm()
            if answer["ok"] or [reason["code"] for reason in answer.get("refused", [])] != ["NotSettled"]:
                break
            self._clock.sleep(SETTLING_S)
        return answer

    def disarm(self) -> Mapping[str, Any]:
        """Request the ramp to zero and wait for its end (blocking). Raises DeviceError if there is no guard."""
        with self._asked() as client:
            answer = client.disarm()
            if answer["ok"]:
                landed(client.status, clock=self._clock)
            return answer

    def close(self) -> None:
        """End the connection for good; the guard ramps to zero what still runs."""
        with self._lock:
            self._ended = True
            self._drop()


def _gone(before: Mapping[str, Any], now: Mapping[str, Any], error: DeviceError) -> Notice:
    residual = standing(now)
    was = "" if before["state"] in GONE else f"it was in state {before['state']}; "
    text = f"{error}; {was}{residual}"
    if residual.nothing:
        return Notice("GuardLost", "minor", text)
    return Notice("GuardLost", "MAJOR", f"{text}; {START_AND_ADOPT}")


def _severity(state: str, residual: Standing) -> Literal["info", "minor", "MAJOR"]:
    """A guard that is off and has not read its drives yet is no alarm; a known or frozen offset is one."""
    if state not in AT_REST or residual.nothing:
        return "info"
    return "MAJOR" if state == "FROZEN" or residual.known else "minor"


def _changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[Notice]:
    return [*_voided(before, now), *_moved(before, now)]


def _voided(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[Notice]:
    known = {item["axis"] for item in before.get("not_good", []) if item["code"] == RECORD_VOID}
    void = [item for item in now.get("not_good", []) if item["code"] == RECORD_VOID and item["axis"] not in known]
    return [Notice(RECORD_VOID, "MAJOR", f"{item['text']}; {item['advice']}", item["axis"]) for item in void]


def _moved(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[Notice]:
    cause = now.get("cause") or {}
    why = f": {cause.get('code', '')}: {cause['text']}" if cause.get("text") else ""
    residual = standing(now)
    severity = _severity(now["state"], residual)
    left = f"; {residual}" if now["state"] in AT_REST else ""
    if before["state"] in GONE:
        return [Notice("GuardFound", severity, f"the guard is running, in state {now['state']}{why}{left}")]
    if before["state"] == now["state"]:
        known = not left or standing(before).nothing == residual.nothing
        return [] if known else [Notice("GuardState", severity, f"{now['state']}{left}")]
    notice = Notice("GuardState", severity, f"{before['state']} -> {now['state']}{why}{left}", cause.get("axis", ""))
    tripped = (
        before["state"] in CHARGED_STATES
        and now["state"] not in CHARGED_STATES
        and cause.get("code") not in ORDERED_ENDS
    )
    if not tripped:
        return [notice]
    return [notice, Notice(GUARD_TRIPPED, "MAJOR", f"{cause.get('code')}: {cause.get('text')}", cause.get("axis", ""))]
