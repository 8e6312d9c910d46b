"""The fleet application: its routes behind the same gate, with answers of the test."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fdhil.config.user_file import write_users
from fdhil.config.web_section import Web
from fdhil.errors import ConnectError
from fdhil.web.app import STATIC
from fdhil.web.fleet_app import KEPT_S, MOST_KEPT, MOST_SETS, Answers, make_fleet_app
from tests.web.clients import OWN, client_of, log_in, user


class Asked:
    def __init__(self) -> None:
        self.questions: list[tuple[str, dict[str, str | None]]] = []

    def __call__(self, question: str, **given: str | None) -> dict[str, Any]:
        self.questions.append((question, given))
        if question == "trend":
            sets = [] if given["axis"] == "Q" else [{"value": float(k)} for k in range(MOST_SETS + 5)]
            return {"parameter": given["parameter"], "sets": sets}
        return {"answered": question}


async def test_each_question_is_asked_once_for_all_browsers() -> None:
    asked = Asked()
    async with client_of(make_fleet_app(Web(), asked)) as client:
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


def test_an_answer_grows_old_and_what_is_kept_is_bounded() -> None:
    asked, now_s = Asked(), [0.0]
    answers = Answers(asked, lambda: now_s[0])
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


async def test_an_axis_has_all_its_courses_and_no_more_than_a_page_can_show() -> None:
    async with client_of(make_fleet_app(Web(), Asked())) as client:
        told = (await client.get("/api/fleet/axis?machine=mill-1&axis=X")).json()
        assert [course["parameter"] for course in told["courses"]] == ["R", "L", "K", "Jt", "ft", "Cd"]
        assert [course["sets"][0]["value"] for course in told["courses"]] == [5.0] * 6
        missing = await client.get("/api/fleet/axis?machine=mill-1&axis=Q")
        assert (missing.status_code, missing.json()["code"]) == (404, "NoSuchAxis")
        for wrong in ("axis?machine=a%20b&axis=X", "axis?machine=a&axis=XY", "compare?parameter=q"):
            assert (await client.get(f"/api/fleet/{wrong}")).status_code == 422


async def test_a_database_that_is_away_is_one_sentence() -> None:
    def away(question: str, **given: str | None) -> dict[str, Any]:
        raise ConnectError("PostgreSQL", "it does not answer; check [database] connection, and whether it runs")

    async with client_of(make_fleet_app(Web(), away)) as client:
        answer = await client.get("/api/fleet")
    assert (answer.status_code, answer.json()["advice"]) == (503, "check [database] connection, and whether it runs")


async def test_it_has_nothing_of_a_machine_and_needs_the_login_that_is_set(tmp_path: Path) -> None:
    write_users(tmp_path / "users.json", {"watcher": user("watch")})
    app = make_fleet_app(Web(users_file=tmp_path / "users.json"), Asked())
    async with client_of(app) as client:
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
