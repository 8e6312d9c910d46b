"""Parameter trends by the API, over a store written by the daemon's own pipeline."""

from __future__ import annotations

import math
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from fdhil.config import MachineConfig
from fdhil.records import Notice
from fdhil.store.history_database import History
from fdhil.store.history_rows import TimeStamp
from fdhil.web.application import make_app
from tests.daemon.simulated_machine import config_of
from tests.web import stored_weeks
from tests.web.http_clients import make_client

RAPIDS = 26


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> MachineConfig:
    folder = tmp_path_factory.mktemp("history")
    stored_weeks.fill_store(config_of(folder, "X"), RAPIDS)
    return config_of(folder, "XY")


@pytest.fixture
async def client(machine: MachineConfig) -> AsyncIterator[httpx.AsyncClient]:
    async with make_client(make_app(machine)) as client:
        yield client


async def _get_document(client: httpx.AsyncClient, path: str) -> Any:
    answer = await client.get(f"/api/history{path}")
    assert answer.status_code == 200, answer.text
    return answer.json()


@pytest.mark.usefixtures("long_computation")
async def test_each_axis_is_summarised(client: httpx.AsyncClient) -> None:
    moved, never = (await _get_document(client, ""))["axes"]
    assert (moved["axis"], never["axis"]) == ("X", "Y")
    assert moved["state"] in ("warn", "bad")
    assert moved["rapids_seen"] == RAPIDS
    assert moved["rapids_believed"] + moved["rapids_refused"] == RAPIDS
    assert (never["state"], never["says"], never["newest_time"]) == ("none", ["Nothing has been identified yet."], None)


@pytest.mark.usefixtures("long_computation")
async def test_trends_have_intervals_limits_and_stored_figures(
    client: httpx.AsyncClient, machine: MachineConfig
) -> None:
    reported = await _get_document(client, "/X")
    courses = {course["parameter"]: course for course in reported["courses"]}
    assert {"R", "L", "K", "Jt", "ft", "Cd"} <= set(courses)
    with History.open_read_only(machine.store.directory) as history:
        newest = [window for window in history.read_windows("X") if window.accepted][-1]
    assert newest.parameters is not None
    shown = courses["R"]["estimates"][0]
    assert shown["window"] == newest.number
    assert shown["temperature_celsius"] == newest.temperature_c
    assert shown["value"] == pytest.approx(1e3 * newest.parameters["R"]["value"])  # milliohm
    assert shown["half_width_95"] == pytest.approx(1.959964e3 * newest.parameters["R"]["std"], rel=1e-5)
    points = next(t for t in courses["R"]["over_time"]["panels"][0]["traces"] if t["style"] == "points")
    assert all(low <= y <= high for low, y, high in zip(points["low"], points["y"], points["high"], strict=True))
    assert {trace["colour"] for trace in courses["R"]["over_time"]["panels"][0]["traces"]} <= {1, 2, 3}
    assert courses["Cd"]["over_temperature"] is not None  # it falls with warmth
    assert [change["cause"] for change in reported["changes"]] == ["a changed load"]
    assert reported["latest"][0]["parameter"] == "R"


async def test_every_number_is_finite_json(client: httpx.AsyncClient) -> None:
    def walk(value: Any) -> None:
        if isinstance(value, float):
            assert math.isfinite(value)
        for part in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
            walk(part)

    walk(await _get_document(client, "/X"))


async def test_unacknowledged_notices_of_axis_come_first(client: httpx.AsyncClient) -> None:
    notices = (await _get_document(client, "/X"))["notices"]
    assert {notice["axis"] for notice in notices} == {"X"}
    assert notices[0]["acknowledged"] is None
    assert "GuardTripped" in {notice["code"] for notice in notices}


async def test_unknown_axis_is_refused_with_known_ones(client: httpx.AsyncClient) -> None:
    answer = await client.get("/api/history/Q")
    assert answer.status_code == 404
    assert answer.json()["code"] == "NoSuchAxis"
    assert "X, Y" in answer.json()["advice"]


async def test_document_is_renewed_after_new_rows(tmp_path: Path) -> None:
    config = config_of(tmp_path, "X")
    History.open(config.store.directory).close()
    async with make_client(make_app(config)) as client:
        for count in range(3):
            assert len((await _get_document(client, "/X"))["notices"]) == count
            assert (await _get_document(client, "/X")) == (await _get_document(client, "/X"))
            with History.open(config.store.directory) as history:
                history.add_notice(Notice("PdoMissing", "minor", f"notice {count}", "X"), TimeStamp.now())


async def test_empty_history_is_reported(tmp_path: Path) -> None:
    async with make_client(make_app(config_of(tmp_path, "X"))) as client:
        answer = await client.get("/api/history")
    assert answer.status_code == 404
    assert answer.json()["code"] == "NoHistory"
