"""Pytest plugin behind ``make near``: runs the tests nearest to the changes, for half a minute.

Changes are the differences from the last commit, or else those of the last commit. The distance of a test is the number
of imports between it and a changed module, or given by its name; a file that is not a module counts as its package. A
module named in a string, as in the tables and the command line, counts as imported.
"""

from __future__ import annotations

import re
import subprocess
import time
from collections.abc import Iterable
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).parents[1]
MOST_S = 30.0
NAMED = re.compile(r'"(fdhil(?:\.\w+)+)(?::\w+)?"')
PACKAGES = ("fdhil", "tests", "studies", "benchmarks")


def list_changed_files() -> list[Path]:
    """Return what differs from the last commit, untracked files included, or else what that commit changed."""

    def git(*words: str) -> list[Path]:
        done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True)
        return [Path(line) for line in done.stdout.splitlines()]

    pending = git("diff", "--name-only", "HEAD") + git("ls-files", "--others", "--exclude-standard")
    return pending or git("diff", "--name-only", "HEAD~1", "HEAD")


def name_module(path: Path, modules: Iterable[str]) -> str | None:
    """Return the module of a file, its package where it is no module itself, or None outside of the packages."""
    parts = [part for part in path.with_suffix("").parts if part != "__init__"]
    names = (".".join(parts[:length]) for length in range(len(parts), 0, -1))
    return next((name for name in names if name in modules), None)


def read_source(module: str) -> str:
    """Return the source of a module."""
    path = ROOT.joinpath(*module.split("."))
    return (path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text("utf-8")


def measure_distances(changed: Iterable[Path]) -> dict[str, int]:
    """Return the number of imports between each module and the nearest changed one; a module without is left out."""
    graph = grimp.build_graph(*PACKAGES)
    for importer in [name for name in graph.modules if name.startswith("fdhil.")]:
        for imported in NAMED.findall(read_source(importer)):
            if imported in graph.modules:
                graph.add_import(importer=importer, imported=imported)
    nearest = {name for path in changed if (name := name_module(path, graph.modules))}
    tests = {f"test_{name.rpartition('.')[2]}" for name in nearest}
    nearest |= {name for name in graph.modules if name.startswith("tests.") and name.rpartition(".")[2] in tests}
    distances: dict[str, int] = {}
    while nearest:
        distances |= dict.fromkeys(nearest, max(distances.values(), default=-1) + 1)
        importers = {importer for name in nearest for importer in graph.find_modules_that_directly_import(name)}
        nearest = importers - distances.keys()
    return distances


class NearTests:
    """Collects near tests only, nearest first, and ends the run in time."""

    def __init__(self) -> None:
        self._distances = measure_distances(list_changed_files())
        self._begun_s = time.monotonic()

    def _distance(self, path: Path) -> int | None:
        return self._distances.get(".".join(path.relative_to(ROOT).with_suffix("").parts))

    def pytest_ignore_collect(self, collection_path: Path) -> bool | None:
        """Skip modules that depend on nothing changed."""
        is_test = collection_path.name.startswith("test_") and collection_path.suffix == ".py"
        return True if is_test and self._distance(collection_path) is None else None

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Put the nearest first."""
        items.sort(key=lambda item: self._distance(item.path) or 0)

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        """End the run when its time is up."""
        if self._session is not None and time.monotonic() - self._begun_s > MOST_S:
            self._session.shouldstop = f"{MOST_S:g} s are over, the nearest tests were run; the last was {nodeid}"

    _session: pytest.Session | None = None

    def pytest_sessionstart(self, session: pytest.Session) -> None:
        self._session = session


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(NearTests())
