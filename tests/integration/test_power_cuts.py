"""Acknowledged records survive a power cut, and a store without fsync would be detected."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.integration.power_cuts import cut_power, prepare

pytestmark = [pytest.mark.debian, pytest.mark.fault("F2")]


@pytest.fixture(scope="module", autouse=True)
def _machine() -> None:
    prepare()


def test_power_cut_loses_no_acknowledged_record(tmp_path: Path) -> None:
    found = cut_power(3, tmp_path, pictures=2)
    assert (found.cuts, found.pictures, found.lost, found.damage) == (3, 6, [], [])
    assert all(found.acknowledged.values())
    assert found.checked > 0


def test_store_without_fsync_loses_acknowledged_records(tmp_path: Path) -> None:
    found = cut_power(2, tmp_path, "careless")
    assert found.lost or found.damage
