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


def find_examples(pattern: str, section: str) -> tuple[str, ...]:
    """Return the groups of the single match of the pattern in the section."""
    places = list(re.finditer(pattern, section, re.MULTILINE | re.DOTALL))
    assert len(places) == 1, f"{len(places)} places with {pattern}: {section[:60]}"
    return places[0].groups()


@pytest.fixture
def package_copy(tmp_path: Path) -> Path:
    """A copy of the package and of its tests, as users have them."""
    for folder in ("fdhil", "tests", "studies", "configs"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=HALF_WRITTEN)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def test_each_extension_table_has_a_section() -> None:
    assert [find_examples(r"^Line in `(\w+)`", section) for section in SECTIONS] == [(table,) for table in TABLES]


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("section", SECTIONS, ids=TABLES)
def test_listed_example_passes_contract_tests(section: str, package_copy: Path) -> None:
    table, line = find_examples(r"^Line in `(\w+)`: `([^`]*)`", section)
    name, target = find_examples(r'^Line in `\w+`: `"(\w+)": "(.*)",`', section)
    (command,) = find_examples(r"^Test: `python (-m pytest [^`]*)`$", section)
    file, text = find_examples(r"`(fdhil/[\w/.]+)`:\n\n```\w+\n(.*?)^```$", section)
    assert name not in getattr(tables, table)
    package, _, attribute = target.partition(":")
    assert f"{package.replace('.', '/')}{f'/{attribute}' if file.endswith('.toml') else '.py'}" == file
    (package_copy / file).write_text(text, "utf-8")
    listing = package_copy / "fdhil" / "tables.py"
    head, start, rest = listing.read_text("utf-8").partition(f"\n{table}: Mapping[str, str] = {{\n")
    assert start
    listing.write_text(f"{head}{start}    {line}\n{rest}", "utf-8")
    done = subprocess.run(
        [sys.executable, *shlex.split(command), "-k", name],
        cwd=package_copy,
        env={**os.environ, "PYTHONPATH": str(package_copy)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
