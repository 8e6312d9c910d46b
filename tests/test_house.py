"""The size of the package: each room stays within its budget of lines in pyproject.toml."""

from __future__ import annotations

import ast
import importlib

import pytest

from studies.house_measure import PACKAGE, count_lines, find_doors, read_budget, room_of, split_name


def test_rooms_and_budgets_match() -> None:
    assert set(read_budget()) == set(count_lines())


@pytest.mark.parametrize("room", sorted(count_lines()))
def test_room_stays_within_its_budget_of_lines(room: str) -> None:
    lines, most = count_lines()[room], read_budget().get(room, 0)
    assert lines <= most, f"fdhil/{room} has {lines} lines, {most} are granted: delete as many as you add"


def test_room_is_entered_by_its_own_names_alone() -> None:
    """The command line, which is the top, and the bridges, which run elsewhere as files, are no rooms with a door."""
    past = {
        f"{path.relative_to(PACKAGE)} reaches into {other}"
        for path in PACKAGE.rglob("*.py")
        for other, is_inner in find_doors(ast.parse(path.read_text("utf-8")), room_of(path))
        if is_inner and other not in ("cli", "bridges")
    }
    assert past == set()


@pytest.mark.parametrize("room", sorted(path.parent.name for path in PACKAGE.glob("*/__init__.pyi")))
def test_exported_name_exists(room: str) -> None:
    package = importlib.import_module(f"fdhil.{room}")
    assert len(package.__all__) == len(set(package.__all__))
    assert [name for name in package.__all__ if not hasattr(package, name)] == []


def test_import_from_file_of_another_room_is_counted() -> None:
    tree = ast.parse(
        "from fdhil.config import MachineConfig, config_loader\n"
        "from fdhil.store.history_database import History\n"
        "from fdhil.errors import FdhilError\n"
        "from fdhil.cli.printable_console import show\n"
    )
    assert list(find_doors(tree, "cli")) == [("config", False), ("config", True), ("store", True)]


def test_name_is_split_into_its_words() -> None:
    assert split_name("__read_pdo_mapping") == ["read", "pdo", "mapping"]
