"""Judges mistakes by tests: a plugin of pytest that, in place of running the tests once, runs them for each mistake."""

from __future__ import annotations

import json
import os
import resource
import signal
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import pytest
from _pytest.runner import runtestprotocol
from coverage import Coverage

from studies.mutation import Mutant, apply_mutant

NOTICED, ENDLESS, UNNOTICED, UNCALLED = "noticed", "noticed: a test did not end", "not noticed", "no test comes there"
PROCESSOR_TIMES, PROCESSOR_S = 20, 3
"""A test that takes so much longer than without the mistake will not end."""
WAITS_S = 300.0
NO_PROGRAM, FAILED = 4, 5
OPTIONS = ["-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-p", "no:benchmark", "--assert=plain", "--tb=no"]
OPTIONS += ["--hypothesis-profile=quick", "-m", "not socketcan and not debian"]
Note = Callable[[Mutant, str, str], None]


class _Running(NamedTuple):
    mutant: Mutant
    begun_s: float
    out: int


class Trial:
    """``note`` is told of each mistake the result, and the test that noticed it."""

    def __init__(self, chosen: Sequence[Mutant], processes: int, most_s: float, note: Note) -> None:
        self._ahead = list(reversed(chosen))
        self._processes = processes
        self._most_s = most_s
        self._note = note
        self._running: dict[int, _Running] = {}
        self._noticed_by: dict[str, dict[str, int]] = defaultdict(lambda: defaultdict(int))

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """See which tests take which line, then judge the mistakes, ``processes`` at a time."""
        self._items = {item.nodeid: item for item in session.items}
        self._tests, self._took_s = _forked(self._watched)
        while self._ahead or self._running:
            while self._ahead and len(self._running) < self._processes:
                self._begin(self._ahead.pop())
            self._end_one()
        return True

    def _watched(self) -> tuple[dict[str, list[str]], dict[str, float]]:
        """Run all tests; return which of them take each line, the shortest first, and how long each takes."""
        wanted = {line for mutant in self._ahead for line in (*mutant.lines, *mutant.around)}
        cover = Coverage(
            data_file=None, include=sorted({file for file, _ in wanted}), config_file=False, messages=False
        )
        took_s = {}
        cover.start()
        for nodeid, item in self._items.items():
            cover.switch_context(nodeid)
            begin_s = time.process_time()
            if _fails(item):
                raise RuntimeError(f"{nodeid} fails without any mistake")
            took_s[nodeid] = time.process_time() - begin_s
        cover.stop()
        data = cover.get_data()
        tests = {}
        for file in data.measured_files():
            for line, names in data.contexts_by_lineno(file).items():
                tests[_key(file, line)] = sorted(set(names) & took_s.keys(), key=lambda name: took_s[name])
        return tests, took_s

    def _tests_of(self, mutant: Mutant) -> list[str]:
        """Return the tests that take a line of a mistake: those that noticed others there first, then its own."""
        known = self._noticed_by[mutant.key]
        for lines in (mutant.lines, mutant.around):
            found = {test for file, line in lines for test in self._tests.get(_key(file, line), ())}
            if found:
                own = f"test_{mutant.home}.py"
                return sorted(found, key=lambda test: (-known[test], own not in test, self._took_s[test]))
        return []

    def _begin(self, mutant: Mutant) -> None:
        tests = self._tests_of(mutant)
        out, into = os.pipe()
        child = os.fork()
        if child == 0:
            code = FAILED
            try:
                code = self._judge(mutant, tests, into)
            finally:
                os._exit(code)
        os.close(into)
        self._running[child] = _Running(mutant, time.monotonic(), out)

    def _judge(self, mutant: Mutant, tests: Sequence[str], into: int) -> int:
        try:
            apply_mutant(mutant)
        except SyntaxError:
            return NO_PROGRAM
        for test in tests:
            if time.process_time() > self._most_s:
                break
            os.write(into, f"{test}\n".encode())
            most_s = int(time.process_time() + PROCESSOR_S + PROCESSOR_TIMES * self._took_s[test])
            resource.setrlimit(resource.RLIMIT_CPU, (most_s, -1))
            signal.signal(signal.SIGXCPU, signal.SIG_DFL)
            if _fails(self._items[test]):
                return 1
        return 0

    def _end_one(self) -> None:
        """Wait until one is judged; one that waits for ever is ended."""
        child, status = os.waitpid(-1, os.WNOHANG)
        while not child:
            for pid, running in self._running.items():
                if time.monotonic() - running.begun_s > WAITS_S:
                    os.kill(pid, signal.SIGKILL)
            time.sleep(0.002)
            child, status = os.waitpid(-1, os.WNOHANG)
        mutant, _, out = self._running.pop(child)
        with os.fdopen(out) as file:
            tests = file.read().splitlines()
        code = os.waitstatus_to_exitcode(status)
        if code == NO_PROGRAM:
            return
        if code == FAILED:
            raise SystemExit(f"{mutant.name} could not be judged")
        result = ENDLESS if code < 0 else NOTICED if code else UNNOTICED
        by = tests[-1] if tests and code else ""
        self._noticed_by[mutant.key][by] += 1
        self._note(mutant, result if tests else UNCALLED, by)


def _key(file: str, line: int) -> str:
    return f"{file}:{line}"


def _fails(item: pytest.Item) -> bool:
    return any(report.failed for report in runtestprotocol(item, log=False, nextitem=None))


def _forked(measure: Callable[[], Any]) -> Any:
    """Return what a function says that runs in a process of its own, so that this one stays as it is."""
    out, into = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            with os.fdopen(into, "w") as file:
                json.dump(measure(), file)
        except RuntimeError as error:
            os.write(2, f"{error}\n".encode())
        finally:
            os._exit(0)
    os.close(into)
    with os.fdopen(out) as file:
        text = file.read()
    os.waitpid(child, 0)
    if not text:
        raise SystemExit("the tests do not pass as they are: nothing can be judged by them")
    return json.loads(text)


def judge(chosen: Sequence[Mutant], tests: Sequence[str], processes: int, most_s: float, note: Note) -> None:
    """Judge mistakes by tests, which are given as to pytest, for ``most_s`` of processor time each."""
    code = pytest.main([*OPTIONS, *tests], plugins=[Trial(chosen, processes, most_s, note)])
    if code not in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED):
        raise SystemExit(f"pytest ended with {code}")
