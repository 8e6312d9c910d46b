"""Links the daemon to the guard process: finds it, tells it that the daemon lives, asks it to arm."""

import contextlib
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

from fdhil.arming.answers import ABANDONED
from fdhil.arming.checked_program import Piece
from fdhil.arming.guard_client import GuardClient
from fdhil.arming.preparing import Armament, Feeding
from fdhil.arming.standing import ABSENT, GONE, START_AND_ADOPT, Standing, landed, lost, standing
from fdhil.arming.standing_mark import StandingMark
from fdhil.errors import ConnectError, DeviceError
from fdhil.guard.protocol import AT_REST, CHARGED
from fdhil.records import Notice
from fdhil.system_clock import SYSTEM_CLOCK, Clock

SETTLING_TRIES = 25
SETTLING_S = 0.2
ORDERED = {"Disarmed", "Finished", "Stopped"}
TRIPPED = "GuardTripped"
RECORD_VOID = "RecordVoid"
VOIDING = {RECORD_VOID, "NodeRebooted"}


class GuardLink:
    """At most one connection, safe from several threads.

    ``state`` is the guard's; without one ``absent`` when nothing can be applied, ``lost`` when something may: also by
    what a daemon before this one left in the store.
    """

    def __init__(self, run_directory: Path, store_directory: Path, clock: Clock = SYSTEM_CLOCK) -> None:
        self._run_directory, self._clock = run_directory, clock
        self._lock = threading.Lock()
        self._client: GuardClient | None = None
        self._mark = StandingMark(store_directory)
        self._status: Mapping[str, Any] = self._mark.left or ABSENT
        self._missed = self._mark.left is None
        self._heard_s: float | None = None
        self._untold: list[Notice] = []
        self._ended = False

    @property
    def connected(self) -> bool:
        """Whether there is a connection."""
        return self._client is not None

    @property
    def status(self) -> Mapping[str, Any]:
        """What the guard said last, and how long ago; None: it never did."""
        age_s = None if self._heard_s is None else round(self._clock.now_s() - self._heard_s, 3)
        return {**self._status, "heard_s_ago": age_s}

    @property
    def standing(self) -> Standing:
        """What may still be applied, by what the guard said last."""
        return standing(self._status)

    @property
    def state(self) -> str:
        """The guard's state when it was asked last."""
        return str(self._status["state"])

    @property
    def disarms(self) -> int | None:
        """How often the guard had been disarmed when it was asked last; None where it does not say."""
        return self._status.get("disarms")

    @property
    def row(self) -> int:
        """The row of the path where the machine is, 0 before it has begun."""
        return int(self._status.get("row") or 0)

    def look(self) -> Mapping[str, Any]:
        """Connect where needed, ask for the status and return it (blocking); the next ``refresh`` tells the change."""
        with contextlib.suppress(DeviceError), self._asked():
            pass
        return self._status

    def refresh(self) -> list[Notice]:
        """Look at the status (blocking); return what changed since the last call."""
        self.look()
        return self.take_changes()

    def take_changes(self) -> list[Notice]:
        """Return what changed since the last call, as far as it was seen."""
        with self._lock:
            told, self._untold = self._untold, []
        return told

    @contextlib.contextmanager
    def _asked(self, arming: bool = False) -> Iterator[GuardClient]:
        """Give the connection, and look at the status afterwards; what changed is told by the next ``refresh``.

        A guard that does not answer is let go: what it may have armed it ramps down, and so it ends as it is told.
        """
        with self._lock:
            if self._ended:
                raise ConnectError("guard", "is not asked any more, since the daemon ends; start it again")
            before = self._status
            try:
                if self._client is None:
                    self._client = GuardClient(self._run_directory, clock=self._clock)
                if arming:
                    self._mark.keep(standing(lost(before, arming)))
                yield self._client
                self._status, self._heard_s = self._client.status(), self._clock.now_s()
                self._keep()
                self._untold += _changes(before, self._status)
            except DeviceError as error:
                reached = self._client is not None
                self._drop()
                self._status = lost(before, arming and reached)
                if not self._missed or before["state"] not in GONE or self._status["state"] != before["state"]:
                    self._untold.append(_gone(before, self._status, error))
                self._missed = True
                raise

    def _keep(self) -> None:
        stands = standing(self._status)
        if stands.nothing:
            self._mark.remove()
        elif stands.known:
            self._mark.keep(stands)

    def _drop(self) -> None:
        if self._client is not None:
            self._client.close()
        self._client = None

    def say_alive(self, facts: Mapping[str, bool] | None) -> None:
        """Tell the guard that the daemon is well (never blocks); a guard that is gone is found out by ``refresh``."""
        client = self._client
        if client is not None:
            try:
                client.alive(facts)
            except DeviceError:
                self._status = {**self._status, "text": "the connection is lost"}

    def arm(
        self, armament: Armament, token: str, given_up: Callable[[], bool], disarms: int | None
    ) -> Mapping[str, Any]:
        """Load the table and arm (blocking), unless it is ``given_up`` by then; return the guard's answer.

        A disarm that was answered while this waited for its turn was the operator's last word; so is one that the guard
        counted after the first ``disarms``, whoever asked for it. DeviceError when there is no guard.
        """
        with self._asked(arming=True) as client:
            if given_up():
                return ABANDONED
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
        """Hand on more rows of a running stream (blocking); DeviceError when there is no guard."""
        with self._asked() as client:
            return self._load(client, armament, piece)

    def renew(self, armament: Armament, piece: Piece) -> Mapping[str, Any]:
        """Put other offsets into the first rows of what has not begun (blocking); DeviceError without a guard."""
        with self._asked() as client:
            return self._load(client, armament, piece, renew=True)

    def feed_forward(
        self, feeding: Feeding, token: str, given_up: Callable[[], bool], disarms: int | None
    ) -> Mapping[str, Any]:
        """Switch the on-line feed-forward on (blocking), as ``arm`` does. DeviceError without a guard."""
        with self._asked(arming=True) as client:
            laws, facts = feeding.laws, feeding.facts
            return self._ask(client, lambda: client.feed_forward(token, laws, facts, disarms), given_up)

    def _ask(
        self, client: GuardClient, arm: Callable[[], Mapping[str, Any]], given_up: Callable[[], bool]
    ) -> Mapping[str, Any]:
        """Ask until the interlocks have been good for long enough, for a few seconds; any other no is final."""
        answer: Mapping[str, Any] = ABANDONED
        for _ in range(SETTLING_TRIES):
            if given_up():
                return ABANDONED
            client.alive(None)  # planning took its time: the guard must know us as alive when it is asked
            answer = arm()
            if answer["ok"] or [told["code"] for told in answer.get("refused", [])] != ["NotSettled"]:
                break
            self._clock.sleep(SETTLING_S)
        return answer

    def disarm(self) -> Mapping[str, Any]:
        """Ask for the ramp to zero and wait for its end (blocking); DeviceError when there is no guard."""
        with self._asked() as client:
            answer = client.disarm()
            if answer["ok"]:
                landed(client.status, clock=self._clock)
            return answer

    def close(self) -> None:
        """End the connection for good, and know what was heard last; what still runs is ramped down by the guard."""
        with self._lock:
            self._ended = True
            self._drop()


def _gone(before: Mapping[str, Any], now: Mapping[str, Any], error: DeviceError) -> Notice:
    stands = standing(now)
    was = "" if before["state"] in GONE else f"it was in state {before['state']}; "
    text = f"{error}; {was}{stands}"
    if stands.nothing:
        return Notice("GuardLost", "minor", text)
    return Notice("GuardLost", "MAJOR", f"{text}; {START_AND_ADOPT}")


def _severity(state: str, stands: Standing) -> Literal["info", "minor", "MAJOR"]:
    """A guard that is off and has not read its drives yet is no alarm, what it knows or has left is one."""
    if state not in AT_REST or stands.nothing:
        return "info"
    return "MAJOR" if state == "FROZEN" or stands.known else "minor"


def _changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[Notice]:
    """Say when the guard came, changed its state, or saw a record void; what something ended is a trip."""
    return [*_voided(before, now), *_moved(before, now)]


def _voided(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[Notice]:
    known = {told["axis"] for told in before.get("not_good", []) if told["code"] == RECORD_VOID}
    void = [told for told in now.get("not_good", []) if told["code"] == RECORD_VOID and told["axis"] not in known]
    return [Notice(RECORD_VOID, "MAJOR", f"{told['text']}; {told['advice']}", told["axis"]) for told in void]


def _moved(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[Notice]:
    cause = now.get("cause") or {}
    why = f": {cause.get('code', '')}: {cause['text']}" if cause.get("text") else ""
    stands = standing(now)
    severity = _severity(now["state"], stands)
    left = f"; {stands}" if now["state"] in AT_REST else ""
    if before["state"] in GONE:
        return [Notice("GuardFound", severity, f"the guard runs, in state {now['state']}{why}{left}")]
    if before["state"] == now["state"]:
        known = not left or standing(before).nothing == stands.nothing
        return [] if known else [Notice("GuardState", severity, f"{now['state']}{left}")]
    notice = Notice("GuardState", severity, f"{before['state']} -> {now['state']}{why}{left}", cause.get("axis", ""))
    tripped = before["state"] in CHARGED and now["state"] not in CHARGED and cause.get("code") not in ORDERED
    if not tripped:
        return [notice]
    return [notice, Notice(TRIPPED, "MAJOR", f"{cause.get('code')}: {cause.get('text')}", cause.get("axis", ""))]
