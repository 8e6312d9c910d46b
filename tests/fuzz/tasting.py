"""What every way in must keep to, and the judge of it.

A target's ``taste`` lets through the errors that its way in declares, and nothing else; it also raises AssertionError
where an answer is none that may be given.
"""

from __future__ import annotations

import gc
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
LONGEST_S = 1.0  # of processor time
GIVEN_UP_S = 20.0
MOST_BYTES = 256 * 1024 * 1024


@dataclass(frozen=True)
class Target:
    """A way in: true examples, what any bytes do there, words that its inputs are made of, and how long one may be."""

    name: str
    seeds: Sequence[bytes]
    taste: Callable[[bytes], object]
    words: Sequence[bytes] = field(default=())
    longest: int = 4096


@dataclass(frozen=True)
class Finding:
    """An input that hurts: ``kind`` and ``place`` are the same for all that hurt in the same way."""

    kind: str
    place: str
    text: str


class TooLong(BaseException):
    """An input took so long that it was given up; no ``except Exception`` of the product keeps it."""


def judged(target: Target, data: bytes) -> Finding | None:
    """Taste an input; return what is wrong with the answer. What took too long once is tasted again to be sure."""
    found = _judged_once(target, data)
    if found is not None and found.kind in ("slow", "memory"):
        gc.collect()
        found = _judged_once(target, data)
    return found


def _judged_once(target: Target, data: bytes) -> Finding | None:
    begin_s, before = time.process_time(), _peak_bytes()
    try:
        with _given_up():
            target.taste(data)
    except TooLong:
        return Finding("slow", target.name, f"more than {GIVEN_UP_S:g} s of processor time")
    except Exception as error:  # noqa: BLE001 - whatever is not declared is what is looked for
        return Finding(type(error).__name__, _place(error), "".join(traceback.format_exception(error))[-3000:])
    took_s, grown = time.process_time() - begin_s, _peak_bytes() - before
    if took_s > LONGEST_S:
        return Finding("slow", target.name, f"{took_s:.1f} s of processor time, not {LONGEST_S:g}")
    if grown > MOST_BYTES:
        return Finding("memory", target.name, f"{grown >> 20} MiB, not {MOST_BYTES >> 20}")
    return None


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


def _peak_bytes() -> int:
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _place(error: BaseException) -> str:
    """Return the innermost line of fdhil that an error came through."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "/fdhil/" in f.filename]
    inside = frames or traceback.extract_tb(error.__traceback__)
    return f"{Path(inside[-1].filename).name}:{inside[-1].name}" if inside else "nowhere"


def found_inputs(name: str) -> list[Path]:
    """Return the inputs that once hurt a target."""
    return sorted((FOUND / name).glob("*")) if (FOUND / name).is_dir() else []
