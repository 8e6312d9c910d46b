"""Bounds the time at which a polled value was true. Pure."""

LEAST_ERROR_NS = 1000  # resolution of the computer's clock


def bound_value_time(asked_ns: int, answered_ns: int, renewed_s: float) -> tuple[int, int]:
    """Return the middle of the time in which a polled value was true, and half its length, in ns.

    It was read between request and answer, and was then up to ``renewed_s`` old.

    >>> bound_value_time(1_000_000, 3_000_000, 0.002)
    (1000000, 2000000)
    """
    earliest_ns = asked_ns - round(renewed_s * 1e9)
    return (earliest_ns + answered_ns) // 2, max(LEAST_ERROR_NS, (answered_ns - earliest_ns + 1) // 2)
