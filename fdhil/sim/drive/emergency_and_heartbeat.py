"""Implements error handling of CANopen devices: EMCY, error history, heartbeat producer and consumer, node guarding."""

from collections.abc import Callable

from fdhil.sim.drive.drive_objects import ERROR_HISTORY, HEARTBEAT_CONSUMERS, INVALID
from fdhil.sim.drive.object_dictionary import AbortCode, Entry, ObjectDictionary, TransferAbort
from fdhil.sim.frame_types import Frame

# error codes (CiA 301 table 26, CiA 402-2)
NO_ERROR = 0x0000
HEARTBEAT_LOST = 0x8130  # also when guarding ends
PDO_TOO_SHORT = 0x8210
SYNC_LENGTH = 0x8240
RPDO_TIMEOUT = 0x8250
FOLLOWING_ERROR = 0x8611

_GENERIC, _COMMUNICATION, _PROFILE = 0x01, 0x10, 0x20
_CLASS_BITS = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08}


def _compute_error_register(code: int) -> int:
    if code & 0xFF00 in (0x8100, 0x8200):
        return _GENERIC | _COMMUNICATION
    if code & 0xFF00 == 0x8600:
        return _GENERIC | _PROFILE
    return _GENERIC | _CLASS_BITS.get(code >> 12, 0x80 if code >> 12 == 0xF else 0)


class EmergencyProducer:
    """Manages the error register, the history 0x1003, and the EMCY frames ``waiting`` to be sent."""

    def __init__(self, dictionary: ObjectDictionary) -> None:
        self._dictionary = dictionary
        self.waiting: list[Frame] = []
        self._sent_s: float | None = None
        dictionary.read_hooks.update(
            {0x1003 << 8 | n: self._create_history_reader(n) for n in range(1, ERROR_HISTORY + 1)}
        )

    def report_error(self, code: int, detail: bytes = b"") -> None:
        """Record an error and queue its frame, 8 bytes: code, error register, 5 bytes of ``detail``."""
        values = self._dictionary.numbers
        register = self._dictionary.get_number(0x1001) | _compute_error_register(code)
        values[0x1001 << 8] = register
        count = min(self._dictionary.get_number(0x1003) + 1, ERROR_HISTORY)
        for n in range(count, 1, -1):
            values[0x1003 << 8 | n] = values[0x1003 << 8 | n - 1]
        values[0x1003 << 8 | 1] = code | int.from_bytes(detail[:2], "little") << 16
        values[0x1003 << 8] = count
        self._queue_frame(code, register, detail)

    def clear_errors(self, *, in_fault: bool = False) -> None:
        """Clear all errors, or with ``in_fault`` the communication error alone.

        When the error register becomes 0, the frame "error reset" (code 0) is queued.
        """
        before = self._dictionary.get_number(0x1001)
        after = before & ~_COMMUNICATION if in_fault else 0
        self._dictionary.numbers[0x1001 << 8] = after
        if before and not after:
            self._queue_frame(NO_ERROR, 0, b"")

    def take_frames(self, now_s: float) -> list[Frame]:
        """Return the frames to send now: all, or with an inhibit time (0x1015) one at a time."""
        inhibit_s = self._dictionary.numbers.get(0x101500, 0) * 1e-4
        if not inhibit_s:
            frames, self.waiting = self.waiting, []
            return frames
        if not self.waiting or (self._sent_s is not None and now_s - self._sent_s < inhibit_s):
            return []
        self._sent_s = now_s
        return [self.waiting.pop(0)]

    def drop_frames(self) -> None:
        self.waiting = []

    def _queue_frame(self, code: int, register: int, detail: bytes) -> None:
        cob_id = self._dictionary.get_number(0x1014)
        if not cob_id & INVALID:
            data = code.to_bytes(2, "little") + bytes([register]) + detail[:5].ljust(5, b"\0")
            self.waiting.append((cob_id & 0x7FF, data))

    def _create_history_reader(self, n: int) -> Callable[[], int]:
        def read_history() -> int:
            if n > self._dictionary.get_number(0x1003):
                raise TransferAbort(AbortCode.NO_DATA)
            return self._dictionary.get_number(0x1003, n)

        return read_history


class HeartbeatConsumer:
    """Monitors the nodes of 0x1016; monitoring of a node starts with its first heartbeat."""

    def __init__(self, dictionary: ObjectDictionary) -> None:
        self._dictionary = dictionary
        self._last_heartbeat_s: dict[int, float] = {}
        self._periods: dict[int, float] = {}
        for n in range(1, HEARTBEAT_CONSUMERS + 1):
            dictionary.write_checks[0x1016 << 8 | n] = self._check_consumer
            dictionary.write_hooks[0x1016 << 8 | n] = lambda _: self.restart_monitoring()
        self.lost: set[int] = set()

    def restart_monitoring(self) -> None:
        """Apply 0x1016 and restart the monitoring."""
        words = [self._dictionary.get_number(0x1016, n) for n in range(1, HEARTBEAT_CONSUMERS + 1)]
        self._periods = {word >> 16 & 0x7F: (word & 0xFFFF) * 1e-3 for word in words if word & 0xFFFF and word >> 16}
        self._last_heartbeat_s.clear()
        self.lost = set()

    def _check_consumer(self, entry: Entry, value: int) -> None:
        if value >> 16 > 127:
            raise TransferAbort(AbortCode.RANGE)
        for n in range(1, HEARTBEAT_CONSUMERS + 1):
            other = self._dictionary.get_number(0x1016, n)
            if n != entry.sub and value & 0xFFFF and other & 0xFFFF and other >> 16 == value >> 16:
                raise TransferAbort(AbortCode.INCOMPATIBLE)

    def receive_heartbeat(self, node_id: int, now_s: float) -> bool:
        """Record a heartbeat; return True when the last lost node is back."""
        if node_id not in self._periods:
            return False
        self._last_heartbeat_s[node_id] = now_s
        was_lost = bool(self.lost)
        self.lost.discard(node_id)
        return was_lost and not self.lost

    def find_expired(self, now_s: float) -> list[int]:
        """Return the nodes whose heartbeat has just been missed."""
        silent = [node for node, heard in self._last_heartbeat_s.items() if now_s - heard > self._periods[node]]
        for node in silent:
            del self._last_heartbeat_s[node]
            self.lost.add(node)
        return silent


class HeartbeatProducer:
    """Sends the NMT state every 0x1017 milliseconds of wall time."""

    def __init__(self, dictionary: ObjectDictionary, node_id: int) -> None:
        self._dictionary = dictionary
        self._cob_id = 0x700 + node_id
        self._next_s: float | None = None
        dictionary.write_hooks[0x1017 << 8] = lambda _: self.restart_timer()

    def restart_timer(self) -> None:
        """Make the next heartbeat due at once, after a boot or a change of the period."""
        self._next_s = None

    def produce_heartbeat(self, now_s: float, state: int) -> list[Frame]:
        """Return the heartbeat if it is due."""
        period_s = self._dictionary.get_number(0x1017) * 1e-3
        if period_s == 0 or (self._next_s is not None and now_s < self._next_s):
            return []
        late = self._next_s is None or now_s - self._next_s > period_s
        self._next_s = now_s + period_s if late or self._next_s is None else self._next_s + period_s
        return [(self._cob_id, bytes([state]))]


class NodeGuarding:
    """Answers the guarding requests and monitors their life time: 0x100C milliseconds times 0x100D (CiA 301)."""

    def __init__(self, dictionary: ObjectDictionary) -> None:
        self._dictionary = dictionary
        self.reset_toggle()

    def reset_toggle(self) -> None:
        """Reset the toggle bit; life guarding starts with the next request."""
        self._toggle = 0
        self._requested_s: float | None = None

    def answer_guarding(self, state: int, now_s: float) -> bytes:
        self._requested_s = now_s
        answer = bytes([self._toggle | state])
        self._toggle ^= 0x80
        return answer

    def has_expired(self, now_s: float) -> bool:
        """Whether the life time has just expired."""
        life_s = self._get_number(0x100C) * self._get_number(0x100D) * 1e-3
        if not life_s or self._requested_s is None or now_s - self._requested_s <= life_s:
            return False
        self._requested_s = None
        return True

    def _get_number(self, index: int) -> int:
        return self._dictionary.numbers.get(index << 8, 0)
