"""What every way in must keep to, and the judge of it.

A target's ``taste`` lets through the errors that its way in declares, and nothing else; it also raises AssertionError
where an answer is none that may be given.
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
LONGEST_S = 1.0  # of the time of a processor that counts to COUNT in COUNTED_S
COUNT, COUNTED_S = 1_000_000, 0.06
GIVEN_UP_S = 20.0
AGAIN = 4
MOST_BYTES = 256 * 1024 * 1024
_PEAK_KIB = re.compile(r"VmHWM:\s*(\d+)")


def nobody() -> int | None:
    """Return the process that works for this one where there is none."""
    return None


@dataclass(frozen=True)
class Target:
    """A way in: true examples, what any bytes do there, words that its inputs are made of, and how long one may be.

    ``worker`` tells the process that works for this one, whose time and memory count as well; ``ready`` begins it, and
    that is none of the input's time.
    """

    name: str
    seeds: Sequence[bytes]
    taste: Callable[[bytes], object]
    words: Sequence[bytes] = field(default=())
    longest: int = 4096
    worker: Callable[[], int | None] = nobody
    ready: Callable[[], object] = nobody


def processor_s(target: Target) -> float:
    """Return the processor time so far of this process and of the target's workers, those that ended included."""
    if target.worker is nobody:
        return time.process_time()
    ended, pid = resource.getrusage(resource.RUSAGE_CHILDREN), target.worker()
    # the kernel's clock of another process: clock_getcpuclockid(3)
    lives_s = 0.0 if pid is None else time.clock_gettime(~pid << 3 | 2)
    return time.process_time() + ended.ru_utime + ended.ru_stime + lives_s


def peaks_bytes(target: Target) -> tuple[int, int]:
    """Return the most memory that this process and the target's worker ever had."""
    own, pid = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, target.worker()
    if pid is None:
        return own, 0
    return own, 1024 * int(_PEAK_KIB.findall(Path(f"/proc/{pid}/status").read_text("ascii"))[0])


@dataclass(frozen=True)
class Finding:
    """An input that hurts: ``kind`` and ``place`` are the same for all that hurt in the same way."""

    kind: str
    place: str
    text: str


class TooLong(BaseException):
    """An input took so long that it was given up; no ``except Exception`` of the product keeps it."""


def judged(target: Target, data: bytes) -> Finding | None:
    """Taste an input; return what is wrong with the answer.

    What took too long is tasted again: a processor that others use as well is half as quick.
    """
    found = _judged_once(target, data)
    for _ in range(AGAIN):
        if found is None or found.kind not in ("slow", "memory"):
            break
        gc.collect()
        found = _judged_once(target, data)
    return found


def _judged_once(target: Target, data: bytes) -> Finding | None:
    target.ready()
    begin_s, before = processor_s(target), peaks_bytes(target)
    try:
        with _given_up():
            target.taste(data)
    except TooLong:
        return Finding("slow", target.name, f"more than {GIVEN_UP_S:g} s of processor time")
    except Exception as error:  # noqa: BLE001 - whatever is not declared is what is looked for
        return Finding(type(error).__name__, _place(error), "".join(traceback.format_exception(error))[-3000:])
    took_s = processor_s(target) - begin_s
    grown = max(now - then for now, then in zip(peaks_bytes(target), before, strict=True))
    if took_s > LONGEST_S and took_s > LONGEST_S * _counted_s() / COUNTED_S:
        return Finding("slow", target.name, f"{took_s:.1f} s of processor time, not {LONGEST_S:g}")
    if grown > MOST_BYTES:
        return Finding("memory", target.name, f"{grown >> 20} MiB, not {MOST_BYTES >> 20}")
    return None


def _counted_s() -> float:
    """Return how long this processor counts just now: one that others heat or share is slower."""
    begin_s, number = time.process_time(), 0
    while number < COUNT:
        number += 1
    return time.process_time() - begin_s


@contextmanager
def _given_up() -> Iterator[None]:
    """Raise TooLong in the middle of what takes for ever, by the processor's time and not by the clock."""

    def give_up(_number: int, _frame: FrameType | None) -> None:
        raise TooLong

    before = signal.signal(signal.SIGVTALRM, give_up)
    signal.setitimer(signal.ITIMER_VIRTUAL, GIVEN_UP_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


def _place(error: BaseException) -> str:
    """Return the innermost line of fdhil that an error came through."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "/fdhil/" in f.filename]
    inside = frames or traceback.extract_tb(error.__traceback__)
    return f"{Path(inside[-1].filename).name}:{inside[-1].name}" if inside else "nowhere"


def found_inputs(name: str) -> list[Path]:
    """Return the inputs that once hurt a target."""
    return sorted((FOUND / name).glob("*")) if (FOUND / name).is_dir() else []
