"""The data of the page Machine: from a running daemon, from the store, and while the daemon is silent."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fdhil.records import Parameters
from fdhil.store.history_database import History
from fdhil.web.application import make_app
from fdhil.web.pages.machine_state import classify_axis, classify_change, suggest_steps
from tests.daemon.simulated_machine import SimulatedMachine, rapids
from tests.daemon.test_daemon_service import serving, status_when
from tests.store.sample_records import BENCH, STAMP, make_published
from tests.web.http_clients import OWN, make_client, serve_daemon, write_machine

CALM: dict[str, Any] = {
    "samples_s_ago": 0.1, "drive_state": "Operation enabled", "parameters": {}, "last_window": None, "warnings": [],
    "refused_by": {},
}  # fmt: skip
STATUS: dict[str, Any] = {
    "ok": True, "machine": "bench", "state": "OFF", "guard": {"state": "OFF", "cause": None}, "armed": None,
    "may_stand": {"nothing": True, "text": "offset 0"}, "source": {"state": "listening"}, "store": {"fault": None},
    "troubles": [], "axes": {"X": CALM},
}  # fmt: skip


@pytest.fixture(autouse=True)
def _quick_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.daemon.daemon_service.compile_kernels", lambda config, method: None)


async def test_running_daemon_is_shown_with_axes_and_next_steps(tmp_path: Path) -> None:
    config = write_machine(tmp_path)
    async with (
        serving(config, SimulatedMachine(rapids(config, count=1))) as path,
        make_client(make_app(config), "watcher") as client,
    ):
        await status_when(path, lambda s: s["axes"]["X"]["accepted"] == 1)
        reported = (await client.get("/api/machine")).json()
        stored = (await client.get("/api/machine/parameters")).json()["axes"]["X"]
        text = (await client.get("/api/machine")).text
    assert reported["status"]["axes"]["X"]["revision"] == stored["revision"] == 1
    assert reported["status"]["axes"]["X"]["drive_state"] == "Not ready to switch on"  # its statusword is 0
    assert reported["next"]
    assert reported["axes"]["X"]["light"] in ("good", "warn", "none")  # nothing comes behind the only rapid
    shown = stored["parameters"]["R"]
    assert shown["low"] < shown["value"] < shown["high"]
    assert (shown["unit"], shown["change"], shown["limit"], shown["light"]) == ("ohm", 0.0, 0.3, "good")
    assert (config.run_directory / "token").read_text() not in text


async def test_silent_daemon_is_reported_and_stored_data_shown(tmp_path: Path) -> None:
    config = write_machine(tmp_path, users=False)
    with History.open(config.store.directory) as history:
        history.add_revision(make_published(1), (), STAMP)
        history.add_revision(make_published(2, parameters=Parameters(0.5, 0.005, 0.8, 0.5, 0.05, 5.0)), (), STAMP)
    async with make_client(make_app(config)) as client:
        answer = await client.get("/api/machine")
        stored = (await client.get("/api/machine/parameters")).json()
    reported = answer.json()
    assert (answer.status_code, reported["status"], reported["axes"]["X"]["light"]) == (200, None, "none")
    assert reported["fault"]["code"] == "ConnectError"
    assert "start it with fdhil run CONFIG" in reported["fault"]["advice"]
    assert reported["next"][0]["text"] == "The daemon does not answer."
    moved = stored["axes"]["X"]["parameters"]["Jt"]
    assert (moved["first"], moved["light"]) == (BENCH.Jt, "bad")


async def test_missing_store_is_reported(tmp_path: Path) -> None:
    async with make_client(make_app(write_machine(tmp_path, users=False))) as client:
        reported = (await client.get("/api/machine/parameters")).json()
    assert reported["axes"] == {}
    assert reported["fault"]["code"] == "NoHistory"
    assert reported["fault"]["advice"] == "run the daemon first"


async def test_many_browsers_cause_one_status_request(tmp_path: Path) -> None:
    config = write_machine(tmp_path, users=False)
    async with serve_daemon(config, lambda _: STATUS) as asked, make_client(make_app(config)) as client:
        for _ in range(20):
            assert (await client.get("/api/machine")).json()["machine"] == "bench"
    assert len(asked) < 20


async def test_surrogates_and_nan_do_not_break_responses(tmp_path: Path) -> None:
    config = write_machine(tmp_path)
    reported = {**STATUS, "text": "b\udcf6hlen.ngc", "ratio": math.nan}
    async with (
        serve_daemon(config, lambda request: {**reported, "ok": request["request"] == "status", "code": "NoTable"}),
        make_client(make_app(config), "operator", **OWN) as client,
    ):
        answer = await client.get("/api/machine")
        refused = await client.post("/api/machine/disarm")
    status = answer.json()["status"]
    assert (answer.status_code, status["text"], status["ratio"]) == (200, "b?hlen.ngc", None)
    assert (refused.status_code, refused.json()["text"]) == (409, "b?hlen.ngc")


@pytest.mark.parametrize(
    ("changes", "troubles", "light", "words"),
    [
        ({}, [], "good", "in order"),
        ({"drive_state": "Fault"}, [], "bad", "the drive is in state Fault"),
        ({}, ["NodeNeverHeard: it is silent"], "bad", "NodeNeverHeard"),
        ({"samples_s_ago": None}, [], "none", "no samples yet"),
        ({"samples_s_ago": 9.0}, [], "none", "no samples for 9 s"),
        ({"parameters": None}, [], "none", "run a few rapids"),
        ({"parameters": None, "refused_by": {"A": 1, "B": 2}}, [], "none", "2 rapids were refused because of B"),
        ({"last_window": {"accepted": False, "reasons": ["Low: no"]}}, [], "warn", "was refused: Low: no"),
        ({"warnings": ["W: w"]}, [], "warn", "W: w"),
    ],
)
def test_axis_state_has_colour_and_text(changes: dict[str, Any], troubles: list[str], light: str, words: str) -> None:
    found = classify_axis(CALM | changes, troubles)
    assert found.light == light
    assert words in found.text


def test_parameter_is_beyond_limit_only_with_certainty() -> None:
    assert classify_change(1.0, 0.01, 1.0, 0.3) == (0.0, "good")
    assert classify_change(1.2, 0.01, 1.0, 0.3)[1] == "warn"
    assert classify_change(1.31, 0.1, 1.0, 0.3)[1] == "warn"
    assert classify_change(0.6, 0.05, 1.0, 0.3)[1] == "bad"
    assert classify_change(1.0, None, 1.0, 0.3) == (None, "none")
    assert classify_change(1.0, 0.1, None, 0.3) == (None, "none")


def _make_lost_status() -> Iterator[tuple[dict[str, Any], str, bool]]:
    stands = {"may_stand": {"nothing": False, "text": "3 um on X may still be applied"}}
    yield {"state": "lost", **stands}, "start fdhil-guard, then run fdhil adopt", True
    yield {"state": "FROZEN", **stands}, "then run fdhil adopt", True
    yield {"guard": {"cause": {"code": "SyncLost", "text": "t", "advice": "a"}}}, "a", False
    yield {"source": {"state": "silent"}}, "switch the machine on", False
    yield {"source": {"state": "reconnecting"}}, "it is reopened automatically", False
    yield {"store": {"fault": "full"}}, "nothing can be armed meanwhile", False
    yield {"troubles": [{"axis": "X", "code": "C", "text": "what; then do"}]}, "then do", False
    yield {"axes": {"X": CALM | {"parameters": None}}}, "a few rapids (G0)", False
    yield {"unacknowledged": {"count": 2, "MAJOR": 1}}, "see the page Events", False
    yield {"alarms": {"active": 1}}, "see the page Events", False
    yield {"armed": {"program": "p"}}, "start the program at the NC", False
    yield {"state": "OFF(SHADOW)"}, "start fdhil-guard", False
    yield {}, "fdhil arm CONFIG PROGRAM", False


@pytest.mark.parametrize(("changes", "advice", "urgent"), list(_make_lost_status()))
def test_next_step_is_always_suggested(changes: dict[str, Any], advice: str, urgent: bool) -> None:
    first, *_ = suggest_steps(STATUS | changes, acting=False)
    assert advice in first.advice
    assert first.urgent is urgent


def test_ordered_stop_is_not_a_fault() -> None:
    ordered = {"guard": {"cause": {"code": "Disarmed", "text": "disarmed", "advice": "arm again"}}}
    assert [step.text for step in suggest_steps(STATUS | ordered, acting=True)] == ["Everything is in order."]
