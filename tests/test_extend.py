"""The examples of the page on extending fdhil, inserted as described, pass the tests that it names."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from fdhil import tables

ROOT = Path(__file__).parents[1]
SECTIONS = (ROOT / "docs/how-to/extend.md").read_text("utf-8").split("\n## ")[1:]
HALF_WRITTEN = shutil.ignore_patterns("*.pyc.*", "*.tmp.*")  # what another process compiles just now
TABLES = ("DRIVE_PROFILES", "VOLTAGE_SOURCES", "ESTIMATORS", "CORRECTIONS", "EVENT_SOURCES")


def found(pattern: str, section: str) -> tuple[str, ...]:
    """Return the groups of the single match of the pattern in the section."""
    places = list(re.finditer(pattern, section, re.MULTILINE | re.DOTALL))
    assert len(places) == 1, f"{len(places)} places with {pattern}: {section[:60]}"
    return places[0].groups()


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A copy of the package and of its tests, as users have them."""
    for folder in ("fdhil", "tests", "studies", "configs"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=HALF_WRITTEN)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def test_each_table_of_things_to_add_has_a_section() -> None:
    assert [found(r"^Line in `(\w+)`", section) for section in SECTIONS] == [(table,) for table in TABLES]


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("section", SECTIONS, ids=TABLES)
def test_an_example_passes_the_tests_by_being_listed(section: str, copy: Path) -> None:
    table, line = found(r"^Line in `(\w+)`: `([^`]*)`", section)
    name, target = found(r'^Line in `\w+`: `"(\w+)": "(.*)",`', section)
    (command,) = found(r"^Test: `python (-m pytest [^`]*)`$", section)
    file, text = found(r"`(fdhil/[\w/.]+)`:\n\n```\w+\n(.*?)^```$", section)
    assert name not in getattr(tables, table)
    package, _, attribute = target.partition(":")
    assert f"{package.replace('.', '/')}{f'/{attribute}' if file.endswith('.toml') else '.py'}" == file
    (copy / file).write_text(text, "utf-8")
    listing = copy / "fdhil" / "tables.py"
    head, start, rest = listing.read_text("utf-8").partition(f"\n{table}: Mapping[str, str] = {{\n")
    assert start
    listing.write_text(f"{head}{start}    {line}\n{rest}", "utf-8")
    done = subprocess.run(
        [sys.executable, *shlex.split(command), "-k", name],
        cwd=copy,
        env={**os.environ, "PYTHONPATH": str(copy)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
