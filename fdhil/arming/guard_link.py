"""Links the daemon to the guard process: connects, sends its sign of life, and asks it to arm."""

import contextlib
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

from fdhil.arming.arm_plan import ArmPlan, FeedforwardPlan
from fdhil.arming.checked_program import TablePiece
from fdhil.arming.guard_client import GuardClient
from fdhil.arming.refusals import CHECK_ABANDONED
from fdhil.arming.residual_offset import (
    ABSENT,
    GONE,
    START_AND_ADOPT,
    ResidualOffset,
    make_lost_status,
    read_residual_offset,
    wait_until_idle,
)
from fdhil.arming.residual_offset_file import ResidualOffsetFile
from fdhil.errors import ConnectError, DeviceError
from fdhil.guard import AT_REST, CHARGED_STATES
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
        self._mark = ResidualOffsetFile(store_directory)
        self._status: Mapping[str, Any] = self._mark.stored_status or ABSENT
        self._missed = self._mark.stored_status is None
        self._status_s: float | None = None
        self._unreported: list[Notice] = []
        self._ended = False

    @property
    def is_connected(self) -> bool:
        return self._client is not None

    @property
    def status(self) -> Mapping[str, Any]:
        """The guard's last status and its age in s (None if there never was one)."""
        age_s = None if self._status_s is None else round(self._clock.now_s() - self._status_s, 3)
        return {**self._status, "heard_s_ago": age_s}

    @property
    def residual_offset(self) -> ResidualOffset:
        """What may still be applied in the drives, by the guard's last status."""
        return read_residual_offset(self._status)

    @property
    def state(self) -> str:
        return str(self._status["state"])

    @property
    def disarm_count(self) -> int | None:
        """How often the guard had been disarmed by its last status; None if it does not report it."""
        return self._status.get("disarms")

    @property
    def path_row(self) -> int:
        """The row of the path where the machine is, 0 before it has begun."""
        return int(self._status.get("row") or 0)

    def read_status(self) -> Mapping[str, Any]:
        """Connect if needed, read the status and return it (blocking); the next ``refresh`` reports the changes."""
        with contextlib.suppress(DeviceError), self._use_connection():
            pass
        return self._status

    def poll_changes(self) -> list[Notice]:
        self.read_status()
        return self.take_changes()

    def take_changes(self) -> list[Notice]:
        """Return the changes since the last call, as far as they were seen."""
        with self._lock:
            changes, self._unreported = self._unreported, []
        return changes

    @contextlib.contextmanager
    def _use_connection(self, arming: bool = False) -> Iterator[GuardClient]:
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
                    self._mark.store(read_residual_offset(make_lost_status(before, arming)))
                yield self._client
                self._status, self._status_s = self._client.read_status(), self._clock.now_s()
                self._store_residual_offset()
                self._unreported += _report_changes(before, self._status)
            except DeviceError as error:
                reached = self._client is not None
                self._drop_connection()
                self._status = make_lost_status(before, arming and reached)
                if not self._missed or before["state"] not in GONE or self._status["state"] != before["state"]:
                    self._unreported.append(_report_guard_loss(before, self._status, error))
                self._missed = True
                raise

    def _store_residual_offset(self) -> None:
        residual = read_residual_offset(self._status)
        if residual.is_zero:
            self._mark.remove()
        elif residual.is_applied:
            self._mark.store(residual)

    def _drop_connection(self) -> None:
        if self._client is not None:
            self._client.close()
        self._client = None

    def send_alive(self, facts: Mapping[str, bool] | None) -> None:
        """Report to the guard that the daemon is well (never blocks); ``refresh`` finds out if the guard is gone."""
        client = self._client
        if client is not None:
            try:
                client.send_alive(facts)
            except DeviceError:
                self._status = {**self._status, "text": "the connection is lost"}

    def arm(
        self, armament: ArmPlan, token: str, given_up: Callable[[], bool], disarms: int | None
    ) -> Mapping[str, Any]:
        """Load the table and arm (blocking), unless ``cancel_itself`` by then; return the guard's answer.

        A disarm that was answered in the meantime takes precedence; so does one that the guard counted after the first
        ``disarms``. Raises DeviceError if there is no guard.
        """
        with self._use_connection(arming=True) as client:
            if given_up():
                return CHECK_ABANDONED
            answer = self._load_rows(client, armament, armament.first_piece)
            if not answer["ok"]:
                return answer
            digest, facts = armament.stream.program_digest, armament.facts
            return self._retry_until_settled(client, lambda: client.arm(token, digest, facts, disarms), given_up)

    @staticmethod
    def _load_rows(client: GuardClient, armament: ArmPlan, piece: TablePiece, renew: bool = False) -> Mapping[str, Any]:
        digest = armament.stream.program_digest
        return client.load_table(
            armament.stream.axes, piece.demand, piece.offset, digest, piece.first, piece.final, renew
        )

    def extend_stream(self, armament: ArmPlan, piece: TablePiece) -> Mapping[str, Any]:
        """Hand more rows of a running stream to the guard (blocking). Raises DeviceError if there is no guard."""
        with self._use_connection() as client:
            return self._load_rows(client, armament, piece)

    def replace_first_rows(self, armament: ArmPlan, piece: TablePiece) -> Mapping[str, Any]:
        """Replace the first rows of a program that has not begun (blocking). DeviceError if there is no guard."""
        with self._use_connection() as client:
            return self._load_rows(client, armament, piece, renew=True)

    def enable_feedforward(
        self, feeding: FeedforwardPlan, token: str, given_up: Callable[[], bool], disarms: int | None
    ) -> Mapping[str, Any]:
        """Enable the on-line feed-forward (blocking), like ``arm``. Raises DeviceError if there is no guard."""
        with self._use_connection(arming=True) as client:
            laws, facts = feeding.laws, feeding.facts
            return self._retry_until_settled(
                client, lambda: client.enable_feedforward(token, laws, facts, disarms), given_up
            )

    def _retry_until_settled(
        self, client: GuardClient, arm: Callable[[], Mapping[str, Any]], given_up: Callable[[], bool]
    ) -> Mapping[str, Any]:
        """Repeat the request for a few seconds while the interlocks settle; any other refusal is final."""
        answer: Mapping[str, Any] = CHECK_ABANDONED
        for _ in range(SETTLING_TRIES):
            if given_up():
                return CHECK_ABANDONED
            client.send_alive(None)  # planning took its time: the guard needs a recent sign of life
            answer = arm()
            if answer["ok"] or [reason["code"] for reason in answer.get("refused", [])] != ["NotSettled"]:
                break
            self._clock.sleep(SETTLING_S)
        return answer

    def disarm(self) -> Mapping[str, Any]:
        """Request the ramp to zero and wait for its end (blocking). Raises DeviceError if there is no guard."""
        with self._use_connection() as client:
            answer = client.disarm()
            if answer["ok"]:
                wait_until_idle(client.read_status, clock=self._clock)
            return answer

    def close(self) -> None:
        """End the connection for good; the guard ramps to zero what still runs."""
        with self._lock:
            self._ended = True
            self._drop_connection()


def _report_guard_loss(before: Mapping[str, Any], now: Mapping[str, Any], error: DeviceError) -> Notice:
    residual = read_residual_offset(now)
    was = "" if before["state"] in GONE else f"it was in state {before['state']}; "
    text = f"{error}; {was}{residual}"
    if residual.is_zero:
        return Notice("GuardLost", "minor", text)
    return Notice("GuardLost", "MAJOR", f"{text}; {START_AND_ADOPT}")


def _choose_severity(state: str, residual: ResidualOffset) -> Literal["info", "minor", "MAJOR"]:
    """A guard that is off and has not read its drives yet is no alarm; a known or frozen offset is one."""
    if state not in AT_REST or residual.is_zero:
        return "info"
    return "MAJOR" if state == "FROZEN" or residual.is_applied else "minor"


def _report_changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[Notice]:
    return [*_report_void_records(before, now), *_report_state_change(before, now)]


def _report_void_records(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[Notice]:
    known = {item["axis"] for item in before.get("not_good", []) if item["code"] == RECORD_VOID}
    void = [item for item in now.get("not_good", []) if item["code"] == RECORD_VOID and item["axis"] not in known]
    return [Notice(RECORD_VOID, "MAJOR", f"{item['text']}; {item['advice']}", item["axis"]) for item in void]


def _report_state_change(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[Notice]:
    cause = now.get("cause") or {}
    why = f": {cause.get('code', '')}: {cause['text']}" if cause.get("text") else ""
    residual = read_residual_offset(now)
    severity = _choose_severity(now["state"], residual)
    left = f"; {residual}" if now["state"] in AT_REST else ""
    if before["state"] in GONE:
        return [Notice("GuardFound", severity, f"the guard is running, in state {now['state']}{why}{left}")]
    if before["state"] == now["state"]:
        known = not left or read_residual_offset(before).is_zero == residual.is_zero
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
