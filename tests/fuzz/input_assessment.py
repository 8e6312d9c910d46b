"""The rules for every entry point, and their assessment.

A target's ``taste`` passes on the errors that its entry point declares, and no others; it also raises AssertionError on
an answer that is not permitted.
"""

from __future__ import annotations

import gc
import re
import resource
import signal
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

FOLDER = Path(__file__).parent
FOUND = FOLDER / "found"
LONGEST_S = 1.0  # in the time of a processor that counts to COUNT in COUNTED_S
COUNT, COUNTED_S = 1_000_000, 0.06
GIVEN_UP_S = 20.0
AGAIN = 4
MOST_BYTES = 256 * 1024 * 1024
_PEAK_KIB = re.compile(r"VmHWM:\s*(\d+)")


def find_worker() -> int | None:
    """Return None: no other process works for this one."""
    return None


@dataclass(frozen=True)
class Target:
    """An entry point: valid examples, its processing of any bytes, words of its inputs, and the largest length.

    ``worker`` returns the process that works for this one, whose time and memory count as well; ``ready`` starts it,
    which does not count for the input.
    """

    name: str
    seeds: Sequence[bytes]
    taste: Callable[[bytes], object]
    words: Sequence[bytes] = field(default=())
    longest: int = 4096
    worker: Callable[[], int | None] = find_worker
    ready: Callable[[], object] = find_worker


def measure_processor_s(target: Target) -> float:
    """Return the processor time so far of this process and of the target's workers, including ended ones."""
    if target.worker is find_worker:
        return time.process_time()
    ended, pid = resource.getrusage(resource.RUSAGE_CHILDREN), target.worker()
    # the kernel's clock of another process: clock_getcpuclockid(3)
    lives_s = 0.0 if pid is None else time.clock_gettime(~pid << 3 | 2)
    return time.process_time() + ended.ru_utime + ended.ru_stime + lives_s


def measure_peak_bytes(target: Target) -> tuple[int, int]:
    """Return the peak memory of this process and the target's worker."""
    own, pid = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, target.worker()
    if pid is None:
        return own, 0
    return own, 1024 * int(_PEAK_KIB.findall(Path(f"/proc/{pid}/status").read_text("ascii"))[0])


@dataclass(frozen=True)
class Finding:
    """A failing input: ``kind`` and ``place`` are equal for all inputs that fail in the same way."""

    kind: str
    place: str
    text: str


class TimeLimitExceeded(BaseException):
    """An input took too long and was aborted; no ``except Exception`` of the product catches it."""


def assess_input(target: Target, data: bytes) -> Finding | None:
    """Process an input; return what is wrong with the answer.

    A slow input is processed again, since a shared processor is half as fast.
    """
    found = _assess_once(target, data)
    for _ in range(AGAIN):
        if found is None or found.kind not in ("slow", "memory"):
            break
        gc.collect()
        found = _assess_once(target, data)
    return found


def _assess_once(target: Target, data: bytes) -> Finding | None:
    target.ready()
    begin_s, before = measure_processor_s(target), measure_peak_bytes(target)
    try:
        with _raise_on_timeout():
            target.taste(data)
    except TimeLimitExceeded:
        return Finding("slow", target.name, f"more than {GIVEN_UP_S:g} s of processor time")
    except Exception as error:  # noqa: BLE001 - whatever is not declared is what is looked for
        return Finding(
            type(error).__name__, _find_innermost_line(error), "".join(traceback.format_exception(error))[-3000:]
        )
    took_s = measure_processor_s(target) - begin_s
    grown = max(now - then for now, then in zip(measure_peak_bytes(target), before, strict=True))
    if took_s > LONGEST_S and took_s > LONGEST_S * _measure_reference_s() / COUNTED_S:
        return Finding("slow", target.name, f"{took_s:.1f} s of processor time, not {LONGEST_S:g}")
    if grown > MOST_BYTES:
        return Finding("memory", target.name, f"{grown >> 20} MiB, not {MOST_BYTES >> 20}")
    return None


def _measure_reference_s() -> float:
    """Return the present speed of this processor, which heat and other load reduce."""
    begin_s, number = time.process_time(), 0
    while number < COUNT:
        number += 1
    return time.process_time() - begin_s


@contextmanager
def _raise_on_timeout() -> Iterator[None]:
    """Raise TooLong in an endless input, by processor time and not by the clock."""

    def raise_timeout(_number: int, _frame: FrameType | None) -> None:
        raise TimeLimitExceeded

    before = signal.signal(signal.SIGVTALRM, raise_timeout)
    signal.setitimer(signal.ITIMER_VIRTUAL, GIVEN_UP_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


def _find_innermost_line(error: BaseException) -> str:
    """Return the innermost line of fdhil in an error's traceback."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "/fdhil/" in f.filename]
    inside = frames or traceback.extract_tb(error.__traceback__)
    return f"{Path(inside[-1].filename).name}:{inside[-1].name}" if inside else "nowhere"


def list_found_inputs(name: str) -> list[Path]:
    """Return the past findings of a target."""
    return sorted((FOUND / name).glob("*")) if (FOUND / name).is_dir() else []
