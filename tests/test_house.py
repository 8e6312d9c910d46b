"""The size of the package: each room stays within its budget of lines in pyproject.toml."""

from __future__ import annotations

import ast

import pytest

from studies.house_measure import count_lines, find_doors, read_budget, split_name


def test_rooms_and_budgets_match() -> None:
    assert set(read_budget()) == set(count_lines())


@pytest.mark.parametrize("room", sorted(count_lines()))
def test_room_stays_within_its_budget_of_lines(room: str) -> None:
    lines, most = count_lines()[room], read_budget().get(room, 0)
    assert lines <= most, f"fdhil/{room} has {lines} lines, {most} are granted: delete as many as you add"


def test_import_from_file_of_another_room_is_counted() -> None:
    tree = ast.parse(
        "from fdhil.config import MachineConfig, reading\n"
        "from fdhil.store.history_database import History\n"
        "from fdhil.errors import FdhilError\n"
        "from fdhil.cli.printable_console import show\n"
    )
    assert list(find_doors(tree, "cli")) == [("config", False), ("config", True), ("store", True)]


def test_name_is_split_into_its_words() -> None:
    assert split_name("__read_pdo_mapping") == ["read", "pdo", "mapping"]
