"""The registries: every entry can be loaded, and the defaults are listed."""

from __future__ import annotations

from collections.abc import Mapping

import pytest

from fdhil import tables

TABLES: dict[str, Mapping[str, str]] = {
    name: table
    for name, table in vars(tables).items()
    if name.isupper() and isinstance(table, Mapping) and not name.endswith("_PROFILES")  # files of data, with a loader
}


@pytest.mark.parametrize(("table", "name"), [(table, name) for table in TABLES for name in TABLES[table]])
def test_listed_entries_exist(table: str, name: str) -> None:
    assert tables.load_entry(TABLES[table], name) is not None


def test_defaults_are_listed() -> None:
    assert tables.DEFAULT_ESTIMATOR in tables.ESTIMATORS
    assert tables.DEFAULT_CORRECTION in tables.CORRECTIONS


def test_unlisted_name_is_key_error() -> None:
    with pytest.raises(KeyError):
        tables.load_entry(tables.CORRECTIONS, "none")
