"""Implements error handling of CANopen devices: EMCY, error history, heartbeat producer and consumer, node guarding."""

from collections.abc import Callable

from fdhil.sim.drive.dictionary import AbortCode, Dictionary, Entry, TransferAbort
from fdhil.sim.drive.objects import ERROR_HISTORY, HEARTBEAT_CONSUMERS, INVALID
from fdhil.sim.frame import Frame

# error codes (CiA 301 table 26, CiA 402-2)
NO_ERROR = 0x0000
HEARTBEAT_LOST = 0x8130  # also when guarding ends
PDO_TOO_SHORT = 0x8210
SYNC_LENGTH = 0x8240
RPDO_TIMEOUT = 0x8250
FOLLOWING_ERROR = 0x8611

_GENERIC, _COMMUNICATION, _PROFILE = 0x01, 0x10, 0x20
_CLASS_BITS = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08}


def _register_bits(code: int) -> int:
    if code & 0xFF00 in (0x8100, 0x8200):
        return _GENERIC | _COMMUNICATION
    if code & 0xFF00 == 0x8600:
        return _GENERIC | _PROFILE
    return _GENERIC | _CLASS_BITS.get(code >> 12, 0x80 if code >> 12 == 0xF else 0)


class Emergencies:
    """Manages the error register, the history 0x1003, and the EMCY frames ``waiting`` to be sent."""

    def __init__(self, dictionary: Dictionary) -> None:
        self._dictionary = dictionary
        self.waiting: list[Frame] = []
        self._sent_s: float | None = None
        dictionary.read_hooks.update({0x1003 << 8 | n: self._field(n) for n in range(1, ERROR_HISTORY + 1)})

    def report(self, code: int, detail: bytes = b"") -> None:
        """Record an error and queue its frame, 8 bytes: code, error register, 5 bytes of ``detail``."""
        values = self._dictionary.numbers
        register = self._dictionary.number(0x1001) | _register_bits(code)
        values[0x1001 << 8] = register
        count = min(self._dictionary.number(0x1003) + 1, ERROR_HISTORY)
        for n in range(count, 1, -1):
            values[0x1003 << 8 | n] = values[0x1003 << 8 | n - 1]
        values[0x1003 << 8 | 1] = code | int.from_bytes(detail[:2], "little") << 16
        values[0x1003 << 8] = count
        self._queue(code, register, detail)

    def clear(self, *, in_fault: bool = False) -> None:
        """Clear all errors, or with ``in_fault`` the communication error alone.

        When the error register becomes 0, the frame "error reset" (code 0) is queued.
        """
        before = self._dictionary.number(0x1001)
        after = before & ~_COMMUNICATION if in_fault else 0
        self._dictionary.numbers[0x1001 << 8] = after
        if before and not after:
            self._queue(NO_ERROR, 0, b"")

    def take(self, now_s: float) -> list[Frame]:
        """Return the frames to send now: all, or with an inhibit time (0x1015) one at a time."""
        inhibit_s = self._dictionary.numbers.get(0x101500, 0) * 1e-4
        if not inhibit_s:
            frames, self.waiting = self.waiting, []
            return frames
        if not self.waiting or (self._sent_s is not None and now_s - self._sent_s < inhibit_s):
            return []
        self._sent_s = now_s
        return [self.waiting.pop(0)]

    def drop(self) -> None:
        self.waiting = []

    def _queue(self, code: int, register: int, detail: bytes) -> None:
        cob_id = self._dictionary.number(0x1014)
        if not cob_id & INVALID:
            data = code.to_bytes(2, "little") + bytes([register]) + detail[:5].ljust(5, b"\0")
            self.waiting.append((cob_id & 0x7FF, data))

    def _field(self, n: int) -> Callable[[], int]:
        def read() -> int:
            if n > self._dictionary.number(0x1003):
                raise TransferAbort(AbortCode.NO_DATA)
            return self._dictionary.number(0x1003, n)

        return read


class HeartbeatConsumer:
    """Monitors the nodes of 0x1016; monitoring of a node starts with its first heartbeat."""

    def __init__(self, dictionary: Dictionary) -> None:
        self._dictionary = dictionary
        self._heard: dict[int, float] = {}
        self._periods: dict[int, float] = {}
        for n in range(1, HEARTBEAT_CONSUMERS + 1):
            dictionary.check[0x1016 << 8 | n] = self._check
            dictionary.written[0x1016 << 8 | n] = lambda _: self.configure()
        self.lost: set[int] = set()

    def configure(self) -> None:
        """Apply 0x1016 and restart the monitoring."""
        words = [self._dictionary.number(0x1016, n) for n in range(1, HEARTBEAT_CONSUMERS + 1)]
        self._periods = {word >> 16 & 0x7F: (word & 0xFFFF) * 1e-3 for word in words if word & 0xFFFF and word >> 16}
        self._heard.clear()
        self.lost = set()

    def _check(self, entry: Entry, value: int) -> None:
        if value >> 16 > 127:
            raise TransferAbort(AbortCode.RANGE)
        for n in range(1, HEARTBEAT_CONSUMERS + 1):
            other = self._dictionary.number(0x1016, n)
            if n != entry.sub and value & 0xFFFF and other & 0xFFFF and other >> 16 == value >> 16:
                raise TransferAbort(AbortCode.INCOMPATIBLE)

    def receive(self, node_id: int, now_s: float) -> bool:
        """Record a heartbeat; return True when the last lost node is back."""
        if node_id not in self._periods:
            return False
        self._heard[node_id] = now_s
        was_lost = bool(self.lost)
        self.lost.discard(node_id)
        return was_lost and not self.lost

    def expired(self, now_s: float) -> list[int]:
        """Return the nodes whose heartbeat has just been missed."""
        silent = [node for node, heard in self._heard.items() if now_s - heard > self._periods[node]]
        for node in silent:
            del self._heard[node]
            self.lost.add(node)
        return silent


class HeartbeatProducer:
    """Sends the NMT state every 0x1017 milliseconds of wall time."""

    def __init__(self, dictionary: Dictionary, node_id: int) -> None:
        self._dictionary = dictionary
        self._cob_id = 0x700 + node_id
        self._next_s: float | None = None
        dictionary.written[0x1017 << 8] = lambda _: self.restart()

    def restart(self) -> None:
        """Make the next heartbeat due at once, after a boot or a change of the period."""
        self._next_s = None

    def due(self, now_s: float, state: int) -> list[Frame]:
        """Return the heartbeat if it is due."""
        period_s = self._dictionary.number(0x1017) * 1e-3
        if period_s == 0 or (self._next_s is not None and now_s < self._next_s):
            return []
        late = self._next_s is None or now_s - self._next_s > period_s
        self._next_s = now_s + period_s if late or self._next_s is None else self._next_s + period_s
        return [(self._cob_id, bytes([state]))]


class NodeGuarding:
    """Answers the guarding requests and monitors their life time: 0x100C milliseconds times 0x100D (CiA 301)."""

    def __init__(self, dictionary: Dictionary) -> None:
        self._dictionary = dictionary
        self.reset()

    def reset(self) -> None:
        """Reset the toggle bit; life guarding starts with the next request."""
        self._toggle = 0
        self._asked_s: float | None = None

    def request(self, state: int, now_s: float) -> bytes:
        self._asked_s = now_s
        answer = bytes([self._toggle | state])
        self._toggle ^= 0x80
        return answer

    def expired(self, now_s: float) -> bool:
        """Whether the life time has just expired."""
        life_s = self._number(0x100C) * self._number(0x100D) * 1e-3
        if not life_s or self._asked_s is None or now_s - self._asked_s <= life_s:
            return False
        self._asked_s = None
        return True

    def _number(self, index: int) -> int:
        return self._dictionary.numbers.get(index << 8, 0)
