"""Sorts tests into tiers by their fixtures, and fails a test that does more than its tier allows.

A test is of the *system* tier when it requests one of ``SYSTEM_FIXTURES``, itself or through another fixture, or needs
a Debian package or a CAN interface; all others are of the *fast* tier. ``make test`` runs the fast tier, ``make
test-system`` the system tier. A fast test starts no process, does not sleep and uses little processor time; otherwise
it fails with the name of the fixture to request.
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from _pytest.mark import ParameterSet

if TYPE_CHECKING:
    from xdist.remote import Producer  # type: ignore[import-untyped]
    from xdist.scheduler import LoadFileScheduling  # type: ignore[import-untyped]

SYSTEM_FIXTURES = frozenset({"processes", "long_computation", "real_time"})
SYSTEM_MARKS = ("debian", "socketcan")
MOST_SLEEP_S = 0.1
MOST_PROCESSOR_S = 5.0  # a guard against what grew by a factor: the slowest test needs a third of it
STARTS_PROCESS = frozenset({"subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn", "os.exec"})
LISTS_FONTS = frozenset({"fc-list"})  # matplotlib's, once on a computer
WHOLE_MODULE = re.compile(
    r"^pytestmark = .*(\"(processes|long_computation|real_time)\"|mark\.(debian|socketcan))", re.MULTILINE
)


def sampled(cases: Iterable[object], every: int) -> list[ParameterSet]:
    """Return the cases of a parametrised test; the fast tier runs each ``every``-th, the system tier the others.

    A case that is a tuple has a value for each argument.
    """
    values = [case if isinstance(case, tuple) else (case,) for case in cases]
    marks = [[pytest.mark.system] if number % every else [] for number in range(len(values))]
    return [pytest.param(*each, marks=tier) for each, tier in zip(values, marks, strict=True)]


class AuditTrail:
    """Counts processes started and seconds slept during a test, fixtures included, by Python's audit events."""

    def __init__(self) -> None:
        self.processes: list[str] = []
        self.slept_s = self.start_s = 0.0
        sys.addaudithook(self._record)

    def clear(self) -> None:
        self.processes.clear()
        self.slept_s, self.start_s = 0.0, time.process_time()

    def _record(self, event: str, arguments: tuple[object, ...]) -> None:
        if event in STARTS_PROCESS and not LISTS_FONTS.intersection(arguments[:1]):
            self.processes.append(f"{event}{arguments[:2]}"[:120])
        elif event == "time.sleep":
            self.slept_s += float(arguments[0])  # type: ignore[arg-type] # a number, by Python's table of audit events


TRAIL = AuditTrail()


@pytest.fixture(scope="session")
def processes() -> None:
    """Allow a test to start processes and to wait for them (system tier)."""


@pytest.fixture(scope="session")
def long_computation() -> None:
    """Allow a test to compute for longer than the fast tier permits (system tier)."""


@pytest.fixture(scope="session")
def real_time() -> None:
    """Allow a test to wait for a second or more, as for the silence of a bus (system tier)."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of the system tier before ``-m`` selects."""
    for item in items:
        requested = SYSTEM_FIXTURES.intersection(getattr(item, "fixturenames", ()))
        if requested or any(item.get_closest_marker(mark) for mark in SYSTEM_MARKS):
            item.add_marker("system")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> LoadFileScheduling:
    """Distribute tests by files as ``--dist loadfile`` does, those of the browser together.

    They share one machine of many processes, which every worker would otherwise start for each file.
    """
    from xdist.scheduler import LoadFileScheduling

    class FileScheduling(LoadFileScheduling):  # type: ignore[misc]
        def _split_scope(self, nodeid: str) -> str:
            return "browser" if nodeid.startswith("tests/web/test_browser") else super()._split_scope(nodeid)

    return FileScheduling(config, log)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Skip modules that are entirely of the system tier when that tier is not selected: imports are slow."""
    if config.option.markexpr != "not system" or collection_path.suffix != ".py":
        return None
    return True if WHOLE_MODULE.search(collection_path.read_text("utf-8")) else None


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Start observing before the first fixture: a module or session fixture counts for the first test that needs it."""
    TRAIL.clear()


@pytest.fixture(autouse=True)
def within_tier(request: pytest.FixtureRequest) -> Iterator[None]:
    """Fail a test of the fast tier that starts a process, sleeps, or computes for long."""
    yield
    if request.node.get_closest_marker("system"):
        return
    used_s = time.process_time() - TRAIL.start_s
    if TRAIL.processes and (reading := sys.modules.get("fdhil.store.reading_process")) is not None:
        reading._end()  # or it would serve the next test, which starts none then
    fast = "a test of the fast tier"
    assert not TRAIL.processes, f"{fast} starts a process, {TRAIL.processes[0]}: request the fixture 'processes'"
    assert TRAIL.slept_s <= MOST_SLEEP_S, f"{fast} sleeps {TRAIL.slept_s:.2f} s: wait for an event, on a virtual clock"
    assert used_s <= MOST_PROCESSOR_S, (
        f"{fast} used {used_s:.1f} s of processor time, more than {MOST_PROCESSOR_S:g}: share the result in the "
        "module, or request the fixture 'long_computation'"
    )
