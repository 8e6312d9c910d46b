"""Connects to the guard's control socket. Calls block for a short time; ``alive`` never blocks.

Call ``alive`` at least every 0.2 s from the loop that checks the daemon's own health, not from a thread of its own: a
daemon that hangs must look dead. When the connection that armed ends, the guard ramps to zero.
"""

import os
import socket
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from fdhil.errors import ConnectError, DeviceError, DeviceTimeout
from fdhil.guard import SOCKET_NAME, Column, encode_table, seal_table
from fdhil.json_lines import decode_line, encode_line
from fdhil.system_clock import SYSTEM_CLOCK, Clock

ANSWER_S = 13.0  # the guard answers a request at a SYNC, or when it has missed it for up to 10 s


class GuardLost(DeviceError):
    """The guard closed the connection: it has stopped, after ramping to zero if it could."""


class GuardClient:
    """A connection to the guard of a run directory. Raises ConnectError if no guard listens there.

    Answers are the guard's JSON documents: {"ok": true, ...}, or {"ok": false, "code", "axis", "text", "advice",
    "refused": [...]}; a refusal is a value, not an exception. Raises GuardLost when the connection ends, DeviceTimeout
    when no answer comes. Two threads may use it: ``alive`` may be called while another waits for an answer.
    """

    def __init__(self, run_directory: Path, timeout_s: float = ANSWER_S, clock: Clock = SYSTEM_CLOCK) -> None:
        self._timeout_s, self._clock = timeout_s, clock
        self._asking, self._sending = threading.Lock(), threading.Lock()
        self._number = 0
        self._inbox = b""
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        path = run_directory / SOCKET_NAME
        try:
            self._socket.settimeout(timeout_s)
            self._socket.connect(str(path))
        except OSError as error:
            self._socket.close()
            absent = f"no guard answers ({error.strerror or error}); start fdhil-guard with this machine's config"
            raise ConnectError.from_socket_error(str(path), error, absent) from None

    def read_status(self) -> dict[str, Any]:
        return self.send_request({"request": "status"})

    def load_table(
        self,
        axes: Sequence[str],
        demand: Mapping[str, Column],
        offset: Mapping[str, Column],
        program_digest: str,
        first: int = 0,
        final: bool = True,
        renew: bool = False,
    ) -> dict[str, Any]:
        """Load a table, or with ``first`` and ``final`` a piece of a streamed one, into the guard, which checks it.

        ``renew``: replace the first rows of an armed table that has not begun. Rows per axis: demand and offset in
        drive increments (sequences of int or numpy integer arrays). Raises StoreError if the table is too long or
        memory is short, ValueError if a value does not fit into 32 bits.
        """
        body = encode_table(axes, demand, offset, program_digest, first, final)
        descriptor = seal_table(body)
        try:
            return self.send_request(
                {"request": "table", "renew": renew}, self._timeout_s + len(body) / 2e5, descriptor
            )
        finally:
            os.close(descriptor)

    def arm(
        self, token: str, program_digest: str, facts: Mapping[str, bool], disarms: int | None = None
    ) -> dict[str, Any]:
        """Arm the loaded table; ``facts`` as in ``interlocks.FACTS``.

        ``disarms``: the count in the status before preparation began; the guard refuses if it was disarmed since.
        """
        request = {"request": "arm", "token": token, "program_digest": program_digest, "facts": dict(facts)}
        return self.send_request(_limit_to_disarms(disarms, request))

    def enable_feedforward(
        self,
        token: str,
        laws: Mapping[str, Mapping[str, Any]],
        facts: Mapping[str, bool],
        disarms: int | None = None,
    ) -> dict[str, Any]:
        """Enable the on-line feed-forward; ``laws`` per axis as in ``feedforward.Law``, facts as its interlocks."""
        laws = {axis: dict(law) for axis, law in laws.items()}
        request = {"request": "feedforward", "token": token, "laws": laws, "facts": dict(facts)}
        return self.send_request(_limit_to_disarms(disarms, request))

    def disarm(self) -> dict[str, Any]:
        """Ramp to zero; the answer comes at once, ``status`` shows when the state is OFF."""
        return self.send_request({"request": "disarm"})

    def adopt(self, token: str) -> dict[str, Any]:
        """Take over the offsets that the drives hold and ramp them to zero (after FROZEN, or a residual offset)."""
        return self.send_request({"request": "adopt", "token": token})

    def read_touch_counts(self, token: str) -> dict[str, int]:
        """Return how often each drive was written to so far; call it before comparing drives with their records."""
        self.report_comparison(token, {}, {})  # without SYNC the guard updates its counts only on a request
        return dict(self.read_status().get("touched", {}))

    def report_comparison(self, token: str, axes: Mapping[str, str], touched: Mapping[str, int]) -> dict[str, Any]:
        """Report which drives were compared with their records; another fingerprint voids the record.

        ``touched`` are the counts before the comparison: a drive that was written to since is refused.
        """
        return self.send_request({"request": "compared", "token": token, "axes": dict(axes), "touched": dict(touched)})

    def send_alive(self, facts: Mapping[str, bool] | None = None) -> None:
        """Report that the daemon is well, and the facts that still hold. Raises GuardLost if the guard is gone."""
        message: dict[str, Any] = {"request": "alive"}
        if facts is not None:
            message["facts"] = dict(facts)
        self._send_message(message)

    def send_request(
        self, request: Mapping[str, Any], timeout_s: float | None = None, descriptor: int | None = None
    ) -> dict[str, Any]:
        """Send one request, optionally with a file descriptor, and wait for the answer."""
        with self._asking:
            self._number += 1
            number = self._number
            self._send_message({**request, "id": number}, descriptor)
            deadline_s = self._clock.now_s() + (timeout_s or self._timeout_s)
            while True:
                answer = self._receive_line(deadline_s)
                if answer.pop("id", None) == number:
                    return answer

    def _send_message(self, message: Mapping[str, Any], descriptor: int | None = None) -> None:
        line = encode_line(message)
        try:
            with self._sending:
                if descriptor is not None:  # it goes with the first byte
                    line = line[socket.send_fds(self._socket, [line], [descriptor]) :]
                self._socket.sendall(line)
        except OSError as error:
            raise self._make_lost_error(error.strerror or str(error)) from None

    def _receive_line(self, deadline_s: float) -> dict[str, Any]:
        while b"\n" not in self._inbox:
            try:
                if not self._clock.wait_readable(self._socket, max(0.0, deadline_s - self._clock.now_s())):
                    raise DeviceTimeout("guard", "did not answer; check its journal, then restart it")
                chunk = self._socket.recv(1 << 16)
            except OSError as error:
                raise self._make_lost_error(error.strerror or str(error)) from None
            if not chunk:
                raise self._make_lost_error("connection closed")
            self._inbox += chunk
        line, self._inbox = self._inbox.split(b"\n", 1)
        return decode_line(line) or {}

    @staticmethod
    def _make_lost_error(why: str) -> GuardLost:
        return GuardLost("guard", f"is gone ({why}); check its journal, then start it again")

    def close(self) -> None:
        """Close the connection: an armed correction is ramped to zero (MainLost)."""
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _limit_to_disarms(disarms: int | None, request: dict[str, Any]) -> dict[str, Any]:
    """Add the condition that there was no other disarm since."""
    return request if disarms is None else {**request, "disarms": disarms}
