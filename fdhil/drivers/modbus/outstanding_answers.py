"""Tracks answers of RTU units that may still come after their requests were given up. Pure.

An RTU answer names its unit and function, not its request, so a late answer fits the next request of the same shape,
and every later answer is then taken for the one before. A unit answers in order: its answer to one request settles all
requests before it.
"""

from dataclasses import replace

from fdhil.drivers.modbus.modbus_line import ModbusRequest
from fdhil.drivers.modbus.rtu_frames import BIT_READS, READ_HOLDING, WRITE_REGISTER, count_data_bytes, find_answer

FORGOTTEN_S = 10.0  # later answers do not occur
_MOST_COUNT = 120
_END = 1 << 16


class OutstandingAnswers:
    """The requests that may still be answered, the oldest first; each is added as it is sent."""

    def __init__(self) -> None:
        self._requests: list[tuple[ModbusRequest, int]] = []

    def __bool__(self) -> bool:
        return bool(self._requests)

    def add_request(self, request: ModbusRequest, now_ns: int) -> None:
        self._requests.append((request, now_ns + round((FORGOTTEN_S + 2 * request.timeout_s) * 1e9)))

    def drop_expired(self, now_ns: int) -> None:
        """Drop requests whose answer can no longer come."""
        self._requests = [(request, until_ns) for request, until_ns in self._requests if until_ns > now_ns]

    def settle_answer(self, data: bytes) -> bool:
        """Drop the request that the bytes answer, and the same unit's earlier ones; return whether there was one."""
        for place, (request, _) in enumerate(self._requests):
            if find_answer(data, request.unit, request.function, request.count) is not None:
                kept = [owed for k, owed in enumerate(self._requests) if k > place or owed[0].unit != request.unit]
                self._requests = kept
                return True
        return False

    def settle_unit(self, unit: int, *, certain: bool = True) -> None:
        """Drop all requests of a unit, which answered the newest, or, if not ``certain``, the one before."""
        own = [owed for owed in self._requests if owed[0].unit == unit]
        kept = own[-1:] if not certain and len(own) > 1 else []
        self._requests = [owed for owed in self._requests if owed[0].unit != unit] + kept

    def is_ambiguous(self, request: ModbusRequest) -> bool:
        """Return whether an outstanding answer could be taken for the one to ``request``."""
        return any(_describe_shape(owed) == _describe_shape(request) for owed, _ in self._requests)

    def find_probe(self, request: ModbusRequest) -> ModbusRequest | None:
        """Return a request whose answer cannot be confused with an outstanding one; None if there is none.

        It reads from the same address, fewer registers where possible; its data are discarded.
        """
        count, step = request.count, 8 if request.function in BIT_READS else 1
        function = READ_HOLDING if request.function == WRITE_REGISTER else request.function
        for other in (count - step, count + step, count + 2 * step, count + 3 * step):
            probe = replace(request, function=function, value=other)
            fits = 1 <= other <= _MOST_COUNT * step and request.address + other <= _END
            if fits and not self.is_ambiguous(probe) and _describe_shape(probe) != _describe_shape(request):
                return probe
        return None


def _describe_shape(request: ModbusRequest) -> tuple[int, int, int]:
    return request.unit, request.function, count_data_bytes(request.function, request.count)
