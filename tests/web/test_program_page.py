"""Dropped programs: forecast in a child process, and returned in parts without loss."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import AsyncExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from fastapi import FastAPI
from numpy.testing import assert_allclose

from fdhil import correction
from fdhil.arming import pass_monitor
from fdhil.config import MachineConfig
from fdhil.correction.learned_offsets import LearnedOffset
from fdhil.errors import ProgramError
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.program import load_trajectory
from fdhil.records import Notice
from fdhil.store.history_database import History
from fdhil.store.history_rows import StoredNotice, TimeStamp
from fdhil.store.learned_offset_files import make_learned_path, write_learned
from fdhil.web.application import make_app
from fdhil.web.fault_responses import RequestRefused
from fdhil.web.forecast import forecast_process, forecast_queue
from fdhil.web.forecast.path_view import select_knots
from fdhil.web.forecast.program_passes import parse_stored_passes
from tests.bench import bench_config
from tests.store.sample_records import make_published

PROGRAM = Path(__file__).parents[2] / "configs" / "programs" / "bench_10m.ngc"
LONG_ENOUGH_S = 300.0
WRITES = {"X-Fdhil": "1"}


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> MachineConfig:
    return bench_config(folder=tmp_path_factory.mktemp("machine"))


class PageClient:
    """Asks the application in a loop that lives as long as a module's tests; forecasts go on meanwhile."""

    def __init__(self, app: FastAPI) -> None:
        self._runner = asyncio.Runner()
        self._open = AsyncExitStack()
        self._app = app
        transport = httpx.ASGITransport(app)
        self._http = httpx.AsyncClient(transport=transport, base_url="http://localhost")
        self._runner.run(self._enter_app())

    async def _enter_app(self) -> None:
        await self._open.enter_async_context(self._http)
        await self._open.enter_async_context(self._app.router.lifespan_context(self._app))

    def get(self, path: str, **options: Any) -> httpx.Response:
        return self._runner.run(self._http.get(path, **options))

    def post(self, path: str, **options: Any) -> httpx.Response:
        return self._runner.run(self._http.post(path, **options))

    def wait_until_over(self) -> None:
        self._runner.run(asyncio.sleep(0.05))

    def close(self) -> None:
        self._runner.run(self._open.aclose())
        self._runner.close()


@pytest.fixture(scope="module")
def client(machine: MachineConfig) -> Iterator[PageClient]:
    client = PageClient(make_app(machine))
    yield client
    client.close()


def drop_program(client: PageClient, name: str, content: bytes) -> str:
    answer = client.post("/api/program", params={"name": name}, content=content, headers=WRITES)
    assert answer.status_code == 202, answer.text
    return str(answer.json()["digest"])


def is_over(client: PageClient, digest: str, part: str = "") -> dict[str, Any]:
    end = time.monotonic() + LONG_ENOUGH_S
    while time.monotonic() < end:
        reported: dict[str, Any] = client.get(f"/api/program/{digest}").json()
        reported = reported[part] if part else reported
        if reported["state"] in ("done", "failed", "cancelled"):
            return reported
        client.wait_until_over()
    raise AssertionError("the forecast did not end")


@pytest.fixture(scope="module")
def judged(client: PageClient, processes: None) -> dict[str, Any]:
    reported = is_over(client, drop_program(client, "../shop\\bench.ngc", PROGRAM.read_bytes()))
    assert reported["state"] == "done", reported
    return reported


def get_document(client: PageClient, judged: dict[str, Any], path: str, **query: Any) -> Any:
    answer = client.get(f"/api/program/{judged['digest']}/{path}", params=query)
    assert answer.status_code == 200, answer.text
    return answer.json()


@pytest.fixture(scope="module")
def planned(machine: MachineConfig) -> Any:
    return correction.plan_correction(load_trajectory(PROGRAM, machine), build_nominal_models(machine), machine)


@pytest.mark.usefixtures("processes")
def test_forecast_equals_command_output(judged: dict[str, Any], planned: Any) -> None:
    reported = judged["forecast"]
    assert judged["name"] == "bench.ngc"
    assert_allclose(reported["before"]["rms_um"], planned.before.rms_um)
    assert_allclose(reported["after"]["rms_um"], planned.after.rms_um)
    assert reported["parameters"]["X"]["revision"] == 0
    assert [zone["before_um"] for zone in reported["zones"]] == sorted(
        (zone.max_um for zone in planned.before.zones), reverse=True
    )
    assert {zone["place"] for zone in reported["zones"]} >= {1, 2, 3, 4}


def test_forecast_uses_the_loops_that_the_newest_set_was_validated_with(tmp_path: Path) -> None:
    own = bench_config(folder=tmp_path)
    with History.open(own.store.directory) as history:
        found = replace(make_published(), config_digest=own.digest, loops={"speed_filter_s": 0.002})
        history.add_revision(found, [], TimeStamp.now())
    models, reported, used = forecast_process.load_newest_models(load_trajectory(PROGRAM, own), own)
    assert models["X"] == found.parameters
    assert (reported["X"]["revision"], reported["Y"]["revision"]) == (1, 0)
    assert used.axis["X"].regulators.speed_filter_s == 0.002
    assert used.axis["Y"] == own.axis["Y"]


@pytest.mark.usefixtures("real_time")
def test_simplified_path_keeps_largest_error(client: PageClient, judged: dict[str, Any], planned: Any) -> None:
    (run,) = get_document(client, judged, "view", across="X", along="Y")["runs"]
    path = planned.before.reference.path_mm
    assert len(run["row"]) < len(path) / 2
    assert_allclose(max(run["before_um"]), planned.before.contour_um.max(), atol=1e-3)
    assert_allclose(max(run["after_um"]), planned.after.contour_um.max(), atol=1e-3)
    # between two points that are told the path is straight, as far as anyone sees
    rows = np.array(run["row"])
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    size_mm = np.ptp(path, axis=0).max()
    for k, name in enumerate(("x_mm", "y_mm")):
        drawn = np.interp(way, way[rows], run[name])
        assert np.abs(drawn - path[:, k]).max() < size_mm / 1000


def test_corner_view_has_all_rows_and_table_path(client: PageClient, judged: dict[str, Any], planned: Any) -> None:
    x, y = judged["forecast"]["zones"][0]["at_mm"]
    box = {"left": x - 1, "right": x + 1, "bottom": y - 1, "top": y + 1}
    (run,) = (view := get_document(client, judged, "view", across="X", along="Y", factor=1, **box))["runs"]
    assert view["whole"]
    assert run["row"] == list(range(run["row"][0], run["row"][-1] + 1))
    inside = slice(run["row"][0], run["row"][-1] + 1)
    for case, found in enumerate((planned.before, planned.after)):
        drawn = np.column_stack([run["table"][case]["x_mm"], run["table"][case]["y_mm"]])
        actual = np.column_stack([found.predicted_mm["X"], found.predicted_mm["Y"]])[inside]
        assert_allclose(drawn, actual, atol=2e-6)
    enlarged = get_document(client, judged, "view", across="X", along="Y", factor=10, **box)["runs"][0]["table"]
    plain = np.array(run["table"][0]["x_mm"])
    assert np.abs(np.array(enlarged[0]["x_mm"]) - plain).max() > 5 * planned.before.contour_um[inside].max() * 1e-3 / 2
    fitting = get_document(client, judged, "view", across="X", along="Y", **box)
    assert fitting["factor"] in (1, 2, 5)
    assert (
        get_document(client, judged, "view", across="X", along="Y", left=500, right=501, bottom=0, top=1)["runs"] == []
    )


def test_error_curve_keeps_maxima(client: PageClient, judged: dict[str, Any], planned: Any) -> None:
    course = get_document(client, judged, "course")
    assert_allclose(max(course["before_um"]), planned.before.contour_um.max(), atol=1e-3)
    assert_allclose(max(course["feed_mm_min"]), 10000.0, rtol=0.01)
    assert len(get_document(client, judged, "course", start_s=1.0, end_s=1.1)["time_s"]) == 100
    assert get_document(client, judged, "course", start_s=1e300)["time_s"]


def test_line_is_located_with_worst_place_and_text(client: PageClient, judged: dict[str, Any], planned: Any) -> None:
    found = get_document(client, judged, "line/6")
    rows = np.flatnonzero(planned.before.reference.line == 6)
    assert_allclose(found["before_um"], planned.before.contour_um[rows].max(), atol=1e-3)
    text = get_document(client, judged, "text", first=5, count=2)
    assert [each["line"] for each in text["lines"]] == [5, 6]
    assert text["lines"][1]["text"] == PROGRAM.read_text().splitlines()[5]
    still = client.get(f"/api/program/{judged['digest']}/line/1")
    assert still.status_code == 404
    assert "orders no motion" in still.json()["text"]


@pytest.mark.usefixtures("processes")
def test_feeds_that_keep_tolerance_are_computed(client: PageClient, judged: dict[str, Any]) -> None:
    path = f"/api/program/{judged['digest']}"
    asked = client.post(f"{path}/advise", params={"tolerance_um": 60}, headers=WRITES)
    assert (asked.status_code, asked.json()["advice"]["state"]) == (202, "waiting")
    advice = is_over(client, judged["digest"], "advice")
    assert advice["state"] == "done"
    assert {each["line"] for each in advice["lines"]} >= {4, 6, 7}
    for each in advice["lines"]:
        assert each["run_feed_mm_min"] < each["feed_mm_min"] == 10000.0
    assert client.post(f"{path}/advise", params={"tolerance_um": 0}, headers=WRITES).status_code == 422


def test_invalid_request_is_refused(client: PageClient, judged: dict[str, Any]) -> None:
    view = f"/api/program/{judged['digest']}/view"
    for query in (
        {"across": "X", "along": "Q"},
        {"across": "X"},
        {"across": "X", "along": "Y", "left": 1, "right": 0, "bottom": 0, "top": 1},
        {"across": "X", "along": "Y", "factor": "nan"},
    ):
        answer = client.get(view, params=query)
        assert (answer.status_code, answer.json()["code"]) == (422, "BadRequest")
    assert client.get(f"/api/program/{'0' * 64}").status_code == 404
    assert client.get("/api/program/..%2f..%2fetc").status_code in (404, 422)
    assert client.post("/api/program", params={"name": "a"}, content=b"", headers=WRITES).status_code == 422


async def test_uploads_take_no_place_until_complete(machine: MachineConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    async def never(*_: Any) -> None:
        await asyncio.Event().wait()

    monkeypatch.setattr(forecast_queue.ForecastQueue, "_run_task", never)
    taking, sent, places = forecast_queue.ForecastQueue(machine), asyncio.Event(), forecast_queue.MOST_WAITING + 1

    async def pieces(content: bytes) -> AsyncIterator[bytes]:
        yield content
        await sent.wait()

    async def whole() -> AsyncIterator[bytes]:
        yield b"G0 Z1"

    empty = [asyncio.create_task(taking.add_program("empty.ngc", pieces(b""))) for _ in range(places)]
    await asyncio.sleep(0)
    sent.set()
    assert await asyncio.gather(*empty, return_exceptions=True) == [AnyRefusal("BadRequest")] * places
    sent.clear()
    programs = [asyncio.create_task(taking.add_program("a.ngc", pieces(b"G0 X%d" % k))) for k in range(places + 5)]
    await asyncio.sleep(0)
    sent.set()
    answers = await asyncio.gather(*programs, return_exceptions=True)
    assert [isinstance(answer, forecast_queue.ForecastJob) for answer in answers] == [True] * places + [False] * 5
    assert answers[places:] == [AnyRefusal("TooMany")] * 5
    for job in taking.jobs:
        await taking.cancel_job(job.digest)
    sent.clear()
    slow = [asyncio.create_task(taking.add_program("slow.ngc", pieces(b"G0 Y%d" % k))) for k in range(places + 5)]
    await asyncio.sleep(0)
    assert isinstance(await taking.add_program("a.ngc", whole()), forecast_queue.ForecastJob)
    sent.set()
    await asyncio.gather(*slow, return_exceptions=True)
    await taking.close()


class AnyRefusal:
    def __init__(self, code: str) -> None:
        self._code = code

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RequestRefused) and other.document["code"] == self._code

    __hash__ = None  # type: ignore[assignment]


@pytest.mark.usefixtures("processes")
def test_faulty_program_is_refused_with_its_line(client: PageClient) -> None:
    reported = is_over(client, drop_program(client, "bad.ngc", b"G21 G90\nG1 X10 Y10 F1000\nG1 X1..5\nM2\n"))
    assert reported["state"] == "failed"
    assert reported["fault"]["code"] == "ProgramError"
    assert reported["fault"]["line"] == 3
    assert "drop it again" in reported["fault"]["advice"]
    early = client.get(f"/api/program/{reported['digest']}/view", params={"across": "X", "along": "Y"})
    assert (early.status_code, early.json()["code"]) == (409, "NotReady")


@pytest.mark.usefixtures("processes")
def test_cancelled_forecast_ends_its_process(client: PageClient) -> None:
    squares = "\n".join(["G21 G90 F300", *(f"G1 X{100 * (k % 2)} Y{k}" for k in range(40)), "M2"])
    digest = drop_program(client, "slow.ngc", squares.encode())
    reported = client.post(f"/api/program/{digest}/cancel", headers=WRITES).json()
    assert reported["state"] == "cancelled"
    assert is_over(client, digest)["state"] == "cancelled"
    assert client.post(f"/api/program/{digest}/cancel", headers=WRITES).json()["state"] == "cancelled"


def test_dropped_program_opens_no_other_file(tmp_path: Path, machine: MachineConfig) -> None:
    (tmp_path / "secret.ngc").write_text("o<secret> sub\nG1 X1 F100\no<secret> endsub\n")
    program = tmp_path / "program.ngc"
    for name in ("secret", "../secret", str(tmp_path / "secret")):
        program.write_text(f"G21 G90\no<{name}> call\nM2\n")
        with pytest.raises(ProgramError):
            forecast_process.load_reference(program, "program.ngc", machine)


def test_endless_program_is_limited(tmp_path: Path, machine: MachineConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forecast_process, "MOST_ROWS", 5000)
    program = tmp_path / "program.ngc"
    program.write_text("G21 G90 F100\no1 while [1]\nG1 X10\nG1 X0\no1 endwhile\nM2\n")
    with pytest.raises(ProgramError, match="last"):
        forecast_process.load_reference(program, "program.ngc", machine)
    demand = tmp_path / "demand.csv"
    rows = "\n".join(f"{k * 1e-3:.3f},{k * 1e-3:.4f},0" for k in range(5001))
    demand.write_text(f"time_s,X_mm,Y_mm\n{rows}\n")
    with pytest.raises(ProgramError, match="fdhil correct"):
        forecast_process.load_reference(demand, "demand.csv", machine)


def test_shown_name_is_printable() -> None:
    assert forecast_queue.clean_name("/tmp/a\x1b[31m/part\x07.ngc") == "part.ngc"
    assert forecast_queue.clean_name("C:\\jobs\\part.ngc") == "part.ngc"
    assert forecast_queue.clean_name("../..") == ".."
    assert forecast_queue.clean_name("\n") == "program"
    assert len(forecast_queue.clean_name("a" * 255)) == forecast_queue.LONGEST_NAME


def test_learning_curves_are_of_this_machine_only(client: PageClient, machine: MachineConfig) -> None:
    folder = machine.store.directory / "lessons"
    offsets = LearnedOffset({"X": np.zeros(3)}, without_um=9.0, curve_um=(9.0, 3.0, 1.0))
    write_learned(make_learned_path(folder, "ab" * 32, machine.digest), offsets)
    write_learned(make_learned_path(folder, "cd" * 32, "ef" * 32), offsets)
    reported = client.get("/api/program/learning").json()
    assert reported["daemon"] is False
    (learned,) = reported["lessons"]
    assert learned["program"] == "ab" * 16
    assert learned["curve_um"] == [9.0, 3.0, 1.0]


PASS = {
    "program": "/srv/part 1.ngc",
    "pass": 3,
    "ended_by": "Finished",
    "late": "",
    "measured": {"rms_um": 0.92, "max_um": 2.1},
    "predicted": {"rms_um": 0.6, "uncertainty_um": 0.4},
    "predicted_without": {"rms_um": 41.2},
    "gain": {"measured": 44.8, "predicted": 68.7},
}


@pytest.mark.parametrize(("ended_by", "shown"), [("Finished", None), ("SyncLost", "SyncLost")])
def test_stored_passes_have_predicted_and_measured_errors(ended_by: str, shown: str | None) -> None:
    texts = [pass_monitor._format_report({**PASS, "ended_by": ended_by}), "pass 4 of a: nothing that is known here"]
    notices = [
        StoredNotice(k, Notice("PassMeasured", "info", text), TimeStamp(1.7e9, "boot", k))
        for k, text in enumerate(texts)
    ]
    (job,) = parse_stored_passes(notices)
    assert (job["program"], job["pass"], job["ended_by"]) == ("part 1.ngc", 3, shown)
    assert (job["measured_um"], job["max_um"], job["predicted_um"], job["without_um"]) == (0.92, 2.1, 0.6, 41.2)


@pytest.mark.usefixtures("processes")
def test_program_of_the_folder_is_forecast_by_its_name(machine: MachineConfig, tmp_path: Path) -> None:
    (tmp_path / "part.ngc").write_text("G21 G90 G94\nG1 X5 F1000\nM2\n")
    web = machine.web.model_copy(update={"programs_directory": tmp_path})
    client = PageClient(make_app(machine.model_copy(update={"web": web})))
    try:
        reported = client.post("/api/program/named?name=part.ngc", headers=WRITES).json()
        while reported["state"] in ("waiting", "computing"):
            client.wait_until_over()
            reported = client.get(f"/api/program/{reported['digest']}").json()
        assert (reported["state"], reported["name"]) == ("done", "part.ngc")
        assert client.post("/api/program/named?name=other.ngc", headers=WRITES).status_code == 404
        assert client.post("/api/program/named?name=../machine.toml", headers=WRITES).status_code == 422
        assert client.get("/api/program/jobs").json() == {"jobs": []}
    finally:
        client.close()


def test_knots_are_optimal_for_few_points() -> None:
    corner = np.zeros((2001, 4))
    corner[:, 0] = np.minimum(np.arange(2001), 1000) * 0.1
    corner[:, 1] = np.maximum(np.arange(2001) - 1000, 0) * 0.1
    assert select_knots(corner, 100).tolist() == [0, 1000, 2000]
    corner[1500, 2] = 50.0  # a peak of error in one row
    found = select_knots(corner, 100).tolist()
    assert {0, 1000, 1499, 1500, 1501, 2000} <= set(found)
    assert len(select_knots(np.random.default_rng(1).normal(size=(5000, 4)) * 100, 200)) == 200
    still = np.zeros((10, 4))
    assert select_knots(still, 5).tolist() == [0, 9]
