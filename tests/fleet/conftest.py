"""One PostgreSQL for all tests, emptied before each."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.fleet.servers import Postgres, run_postgres


@pytest.fixture(scope="session")
def running_database() -> Iterator[Postgres]:
    with run_postgres() as server:
        yield server


@pytest.fixture
def database(running_database: Postgres) -> Postgres:
    running_database.execute_query("DROP SCHEMA IF EXISTS fleet CASCADE")
    return running_database
