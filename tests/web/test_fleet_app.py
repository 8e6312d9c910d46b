"""The fleet application: its routes behind the same gate, with answers of the test."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fdhil.config.user_file import write_users
from fdhil.config.web_section import Web
from fdhil.errors import ConnectError
from fdhil.web.application import STATIC
from fdhil.web.fleet_app import KEPT_S, MOST_KEPT, MOST_SETS, AnswerCache, make_fleet_app
from tests.web.http_clients import OWN, log_in, make_client, make_user


class RecordedQueries:
    def __init__(self) -> None:
        self.questions: list[tuple[str, dict[str, str | None]]] = []

    def __call__(self, question: str, **given: str | None) -> dict[str, Any]:
        self.questions.append((question, given))
        if question == "trend":
            sets = [] if given["axis"] == "Q" else [{"value": float(k)} for k in range(MOST_SETS + 5)]
            return {"parameter": given["parameter"], "sets": sets}
        return {"answered": question}


async def test_each_query_runs_once_for_all_browsers() -> None:
    asked = RecordedQueries()
    async with make_client(make_fleet_app(Web(), asked)) as client:
        for _ in range(2):
            assert (await client.get("/api/fleet")).json() == {"answered": "status"}
            assert (await client.get("/api/fleet/outliers?by=screw")).json() == {"answered": "outliers"}
            assert (await client.get("/api/fleet/compare?parameter=ft&axis=X")).json() == {"answered": "compare"}
            assert (await client.get("/api/fleet/services?machine=mill-1")).json() == {"answered": "services"}
    assert asked.questions == [
        ("status", {}),
        ("outliers", {"by": "screw", "axis": None}),
        ("compare", {"parameter": "ft", "by": "type", "axis": "X"}),
        ("services", {"machine": "mill-1"}),
    ]


def test_cached_answer_expires_and_cache_is_limited() -> None:
    asked, now_s = RecordedQueries(), [0.0]
    answers = AnswerCache(asked, lambda: now_s[0])
    answers("status")
    now_s[0] = KEPT_S - 1
    answers("status")
    assert len(asked.questions) == 1
    now_s[0] = KEPT_S
    answers("status")
    assert len(asked.questions) == 2
    for k in range(MOST_KEPT):
        answers("services", machine=str(k))
    answers("status")
    assert [question for question, _ in asked.questions].count("status") == 3


async def test_axis_has_all_trends_up_to_page_limit() -> None:
    async with make_client(make_fleet_app(Web(), RecordedQueries())) as client:
        reported = (await client.get("/api/fleet/axis?machine=mill-1&axis=X")).json()
        assert [course["parameter"] for course in reported["courses"]] == ["R", "L", "K", "Jt", "ft", "Cd"]
        assert [course["sets"][0]["value"] for course in reported["courses"]] == [5.0] * 6
        missing = await client.get("/api/fleet/axis?machine=mill-1&axis=Q")
        assert (missing.status_code, missing.json()["code"]) == (404, "NoSuchAxis")
        for wrong in ("axis?machine=a%20b&axis=X", "axis?machine=a&axis=XY", "compare?parameter=q"):
            assert (await client.get(f"/api/fleet/{wrong}")).status_code == 422


async def test_missing_database_is_reported_in_one_sentence() -> None:
    def away(question: str, **given: str | None) -> dict[str, Any]:
        raise ConnectError("PostgreSQL", "it does not answer; check [database] connection, and whether it runs")

    async with make_client(make_fleet_app(Web(), away)) as client:
        answer = await client.get("/api/fleet")
    assert (answer.status_code, answer.json()["advice"]) == (503, "check [database] connection, and whether it runs")


async def test_fleet_app_has_no_machine_routes_and_needs_login(tmp_path: Path) -> None:
    write_users(tmp_path / "users.json", {"watcher": make_user("watch")})
    app = make_fleet_app(Web(users_file=tmp_path / "users.json"), RecordedQueries())
    async with make_client(app) as client:
        assert (await client.get("/api/fleet")).status_code == 401
        client.headers["Authorization"] = f"Bearer {await log_in(client, 'watcher')}"
        assert (await client.get("/api/fleet")).status_code == 200
        for path in ("/api/machine", "/api/history", "/machine", "/api/machine/arm"):
            assert (await client.get(path)).status_code == 404, path
        assert (await client.post("/api/machine/disarm", headers=OWN)).status_code == 404
        for path in ("/", "/fleet", "/fleet/mill-1/X"):
            document = (await client.get(path)).text
            assert 'data-pages="fleet"' in document
            assert "<code>fdhil fleet status FLEET</code>" in document
    assert (STATIC / "pages" / "fleet.js").is_file()
