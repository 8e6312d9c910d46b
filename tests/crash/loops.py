"""Makes every system call of a process that keeps records fail, return short or end it, and checks the result.

An acknowledged record that is missing is lost. One with other content was accepted half-written. The following start
must succeed, or report clearly what to do.
"""

from __future__ import annotations

import random
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from fdhil.store.history_database import History
from tests.crash.call_faults import (
    CommandChannel,
    Work,
    calls_of,
    faults_of,
    injection,
    keep_some,
    kept_under,
    looked_at,
    was_injected,
)
from tests.crash.daemon import FIRST_RAPID, Daemon, run_daemon
from tests.crash.stored_records import KEEPERS, Keeper

BEGUN_BEFORE = ("parameters", "notices", "the daemon")  # how a history is made is tried with the rapids
LIES = "lied of 3 bytes"  # the kernel told what it had not done: no record can be promised, but none may be half
MOST_TOLD = 20


@dataclass
class Found:
    calls: Counter[str] = field(default_factory=Counter)
    faults: int = 0  # that there are; ``tried`` of them
    tried: int = 0
    runs: Counter[str] = field(default_factory=Counter)
    acknowledged: int = 0
    refused: int = 0
    lost: int = 0
    wrong: list[str] = field(default_factory=list)
    lost_by_lies: int = 0


@dataclass(frozen=True)
class Kind:
    make: Callable[[Path], Keeper]
    work: Work
    later: int = 9


KINDS = {name: Kind(make, partial(keep_some, make)) for name, make in KEEPERS.items()}
KINDS["the daemon"] = Kind(Daemon, run_daemon, FIRST_RAPID)


def tried(name: str, folder: Path, most: int | None = None) -> Found:
    kind = KINDS[name]
    found, begun = Found(), _begun(kind, folder, name in BEGUN_BEFORE)
    for fault_at in _faults(begun, kind, folder, found, most):
        store, trace = folder / "store", folder / "trace"
        shutil.rmtree(store, ignore_errors=True)
        shutil.copytree(begun, store)
        result = kept_under(kind.work, store, injection(*fault_at), trace)
        if was_injected(trace):
            _judged(fault_at, result, looked_at(kind.make, store, kind.later), found)
    return found


def _begun(kind: Kind, folder: Path, before: bool) -> Path:
    used, begun = folder / "used", folder / "begun"
    for place in (used, begun):
        place.mkdir(parents=True)
    keeper = kind.make(used)
    keeper.keep(1)
    assert keeper.found()
    keeper.close()
    if before:
        History.open(begun).close()
    return begun


def _faults(begun: Path, kind: Kind, folder: Path, found: Found, most: int | None) -> Iterator[tuple[str, int, str]]:
    store, trace = folder / "first", folder / "first.trace"
    shutil.copytree(begun, store)
    result = kept_under(kind.work, store, None, trace)
    assert result.ended, result
    assert not result.refused, result
    threads = calls_of(trace)
    found.calls = sum(threads, Counter())
    every = [
        (call, nth, fault)
        for call in found.calls
        for nth in range(1, max(calls[call] for calls in threads) + 1)
        for fault in faults_of(call)
    ]
    chosen = every if most is None or most >= len(every) else random.Random(1).sample(every, most)
    found.faults, found.tried = len(every), len(chosen)
    yield from chosen


def _judged(at: tuple[str, int, str], told: CommandChannel, after: CommandChannel, found: Found) -> None:
    call, nth, fault = at
    found.runs[fault] += 1
    found.acknowledged += len(told.kept)
    found.refused += len(told.refused)
    lost = set(told.kept) - set(after.found)
    wrong = []
    if fault == LIES:
        found.lost_by_lies += len(lost)
    elif lost:
        found.lost += len(lost)
        wrong.append(f"{sorted(lost)} lost")
    if not told.ended and fault != "killed":
        wrong.append(f"it ended: {told.wrong}")
    wrong += [f"refused without a word: {text}" for text in told.refused if "; " not in text]
    if not after.ended and (fault != LIES or not _is_plain(after)):
        wrong.append(f"the next start: {after.wrong}")
    wrong += [f"the next start says no more than: {text}" for text in after.said if "; " not in text]
    found.wrong += [f"{call} {nth} {fault}: {text}" for text in wrong]


def _is_plain(after: CommandChannel) -> bool:
    return all(text.startswith("StoreError: ") and "; " in text for text in after.wrong)
