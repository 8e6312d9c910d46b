"""The rapids by the API, over a store written by the daemon's own pipeline."""

from __future__ import annotations

import asyncio
import json
import math
import os
import sqlite3
from collections.abc import AsyncIterator, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from fastapi import FastAPI

from fdhil.config import MachineConfig
from fdhil.daemon.kernel_warmup import simulate_nominal_rapid
from fdhil.daemon.outcome_store import WINDOWS_FOLDER
from fdhil.pipeline.model_overlay import ModelOverlay, overlay_model
from fdhil.records import Window, freeze_array
from fdhil.store.history_database import HISTORY_FILE_NAME, History
from fdhil.store.window_file import decode_window, read_window
from fdhil.web import file_response, rapid_replayer
from fdhil.web.application import make_app
from fdhil.web.fault_responses import RequestRefused
from fdhil.web.pages import rapid_list
from fdhil.web.pages.rapid_signals import MOST_POINTS, Signal, compute_spectrum, make_rapid_signals
from fdhil.web.pages.rapids_page import find_replayer
from fdhil.web.rapid_replay_process import ReplayServer
from fdhil.web.rapid_replayer import RapidReplayer
from tests.daemon.simulated_machine import config_of
from tests.store.sample_records import STAMP, make_outcome
from tests.web import stored_weeks

RAPIDS = 18  # of each axis; those of 6 and 15 are refused


@pytest.fixture(scope="module", autouse=True)
def _allow_busy_host() -> Iterator[None]:
    """The time limit of a replay is for hanging replays, not for a busy host."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rapid_replayer, "LONGEST_S", 500.0)
        yield


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> MachineConfig:
    config = config_of(tmp_path_factory.mktemp("rapids"), "XY")
    stored_weeks.fill_store(config, RAPIDS)
    return config


@pytest.fixture(scope="module")
def app(machine: MachineConfig) -> FastAPI:
    return make_app(machine)


@pytest.fixture
async def client(app: FastAPI) -> AsyncIterator[httpx.AsyncClient]:
    async with _make_client(app) as client:
        yield client
    await find_replayer(app).close()


def _make_client(app: FastAPI) -> httpx.AsyncClient:
    return httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://localhost")


async def _get_document(client: httpx.AsyncClient, path: str, **wanted: Any) -> Any:
    answer = await client.get(f"/api/rapids{path}", params=wanted)
    assert answer.status_code == 200, answer.text
    return answer.json()


@pytest.mark.usefixtures("long_computation")
async def test_rapids_are_listed_newest_first_in_pages(client: httpx.AsyncClient) -> None:
    page = await _get_document(client, "", limit=7)
    ids = [rapid["id"] for rapid in page["rapids"]]
    while page["older_before"] is not None:
        page = await _get_document(client, "", limit=7, before=page["older_before"])
        ids += [rapid["id"] for rapid in page["rapids"]]
    assert ids == list(range(2 * RAPIDS, 0, -1))


@pytest.mark.usefixtures("long_computation")
async def test_rapids_are_filtered_by_axis_verdict_and_reason(client: httpx.AsyncClient) -> None:
    counts = await _get_document(client, "/counts")
    assert counts["axes"] == ["X", "Y"]
    assert (counts["searched"], counts["accepted"], counts["refused"]) == (36, 32, 4)
    assert {"code": "StuckValue", "rapids": 2} in counts["by_reason"]
    refused = (await _get_document(client, "", verdict="refused"))["rapids"]
    assert [rapid["id"] for rapid in refused] == [32, 31, 14, 13]
    assert all(rapid["reasons"] and rapid["kept"] for rapid in refused)
    stuck = (await _get_document(client, "", axis="X", code="StuckValue"))["rapids"]
    assert [rapid["id"] for rapid in stuck] == [31]
    assert stuck[0]["reasons"][0]["text"].startswith("voltage repeats")
    assert (await _get_document(client, "", code="Stuck"))["rapids"] == []
    assert (await _get_document(client, "/counts", axis="Y"))["refused"] == 2


async def test_rare_reason_is_searched_in_sections(client: httpx.AsyncClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rapid_list, "SEARCHED", 10)
    page = await _get_document(client, "", code="LoadDetected")
    assert page == {"rapids": [], "older_before": 27}
    page = await _get_document(client, "", code="LoadDetected", before=page["older_before"])
    page = await _get_document(client, "", code="LoadDetected", before=page["older_before"])
    assert ([rapid["id"] for rapid in page["rapids"]], page["older_before"]) == ([14, 13], 7)


async def test_rapid_details_equal_the_history(client: httpx.AsyncClient, machine: MachineConfig) -> None:
    reported = await _get_document(client, "/X/31")
    with History.open_read_only(machine.store.directory) as history:
        stored = next(window for window in history.read_windows("X") if window.number == 31)
    assert (reported["older_id"], reported["newer_id"], reported["alike_id"]) == (29, 33, 27)
    assert reported["rapid"]["fit_percent"] == stored.fit_percent
    assert stored.parameters is not None
    for figure in reported["parameters"]:
        known = stored.parameters[figure["name"]]
        assert (figure["value"], figure["std"]) == (known["value"], known["std"])
        assert figure["low"] < figure["value"] < figure["high"]
    assert next(f for f in reported["parameters"] if f["name"] == "R")["shown_unit"] == "mΩ"
    first = await _get_document(client, "/X/1")
    assert (first["older_id"], first["alike_id"]) == (None, None)


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("path", ["/Y/31", "/X/999", "/X/31/signals/more", "/Y/31/signals", "/Q/1"])
async def test_missing_rapid_is_reported(client: httpx.AsyncClient, path: str) -> None:
    answer = await client.get(f"/api/rapids{path}")
    assert answer.status_code == 404
    assert answer.json()["ok"] is False
    assert answer.json()["advice"]


@pytest.mark.usefixtures("processes")
async def test_overlaid_model_is_the_judged_one(client: httpx.AsyncClient) -> None:
    for number in (1, 13, 31, 36):  # one process replays them all
        await _check_overlay(client, number)


async def _check_overlay(client: httpx.AsyncClient, number: int) -> None:
    axis = "X" if number % 2 else "Y"
    rapid = (await _get_document(client, f"/{axis}/{number}"))["rapid"]
    reported = await _get_document(client, f"/{axis}/{number}/signals")
    signals = {signal["name"]: Signal(**signal) for signal in reported["signals"]}
    assert list(signals) == ["voltage_v", "current_a", "speed_rad_s", "following_error_um"]
    assert reported["replayed"]["accepted"] == rapid["accepted"]
    assert reported["replayed"]["unexplained_um"] == rapid["unexplained_um"]
    assert [said["code"] for said in reported["replayed"]["reasons"]] == [said["code"] for said in rapid["reasons"]]
    assert all(said["advice"] for said in reported["replayed"]["reasons"])

    speed, error = signals["speed_rad_s"], signals["following_error_um"]
    assert (speed.model, error.model, signals["voltage_v"].model) == ("voltage", "loop", None)
    assert error.residual_rms == pytest.approx(rapid["unexplained_um"], rel=0.01)  # without the encoder's steps
    measured, modelled = _list_numbers(speed.measured), _list_numbers(speed.modelled)
    apart = np.linalg.norm(measured - modelled) / np.linalg.norm(measured - measured.mean())
    assert 100.0 * (1.0 - apart) == pytest.approx(rapid["fit_percent"], abs=1e-3)
    assert np.allclose(_list_numbers(speed.residual), measured - modelled, atol=1e-3)
    assert (error.unit, error.shown_unit) == ("um", "µm")
    assert [stage["name"] for stage in reported["stages"]] == ["accelerate", "cruise", "brake"]
    assert len(reported["time_s"]) == measured.size
    assert len(reported["frequency_hz"]) == len(speed.measured_spectrum) == measured.size // 2 + 1


def _list_numbers(points: list[float | None] | None) -> Any:
    assert points is not None
    return np.array(points, dtype=np.float64)


async def test_recording_is_downloaded_unchanged(client: httpx.AsyncClient, machine: MachineConfig) -> None:
    name = (await _get_document(client, "/Y/2"))["rapid"]["file"]
    answer = await client.get(f"/api/rapids/recordings/{name}")
    assert answer.status_code == 200
    assert f'filename="{name}"' in answer.headers["content-disposition"]
    assert decode_window(answer.content).axis == "Y"
    assert answer.content == (machine.store.directory / WINDOWS_FOLDER / name).read_bytes()


async def test_recording_is_sent_in_pieces(machine: MachineConfig) -> None:
    path, asked, sent = machine.store.directory / WINDOWS_FOLDER / "large", iter([True]), list[int]()
    path.touch()
    os.truncate(path, 40 * file_response.PIECE)

    async def receive() -> Any:
        if not next(asked, False):
            await asyncio.Event().wait()
        return {"type": "http.request", "body": b"", "more_body": False}

    async def send(message: Any) -> None:
        sent.append(len(message.get("body", b"")))

    scope = {
        "type": "http", "method": "GET", "path": f"/api/rapids/recordings/{path.name}", "query_string": b"",
        "headers": [(b"host", b"localhost")], "scheme": "http", "root_path": "",
    }  # fmt: skip
    await make_app(machine)(scope, receive, send)
    path.unlink()
    assert (sum(sent), max(sent)) == (40 * file_response.PIECE, file_response.PIECE)


@pytest.mark.fault("G4")
@pytest.mark.parametrize(
    "name",
    [
        "..%2f..%2fhistory.sqlite", "..%2Fhistory.sqlite", "%2Fetc%2Fpasswd", "..%5Chistory.sqlite", "..%00", "%00",
        "w00000001-X.parquet%00.txt", "a%0d%0aX-Fdhil:%201", "%2e%2e%2f%2e%2e%2fmachine.toml", "x%2F..%2Flink", "link",
        "%2Fdev%2Fzero", "..%252fhistory.sqlite", "x" * 65, ".hidden", "%C3%A4.parquet", "//etc/passwd",
    ],
)  # fmt: skip
async def test_no_name_leads_out_of_the_recordings_folder(
    client: httpx.AsyncClient, machine: MachineConfig, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    folder = machine.store.directory / WINDOWS_FOLDER
    if not (folder / "link").is_symlink():
        (folder / "link").symlink_to(machine.store.directory / HISTORY_FILE_NAME)
    answer = await client.get(f"/api/rapids/recordings/{name}")
    refused = {(400, "BadName"), (404, "NotFound"), (422, "BadRequest")}  # the last two: of no such route
    assert (answer.status_code, answer.json()["code"]) in refused
    assert str(machine.store.directory) not in answer.text
    assert b"SQLite" not in answer.content
    assert ("BadName" in caplog.text) == (answer.status_code == 400)
    assert "\0" not in caplog.text


async def test_missing_or_damaged_recording_is_reported(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    stored_weeks.fill_store(config, 2)
    folder = config.store.directory / WINDOWS_FOLDER
    (folder / "w00000001-X.parquet").unlink()
    damaged = folder / "w00000002-X.parquet"
    damaged.write_bytes(damaged.read_bytes()[:-100])
    async with _make_client(make_app(config)) as client:
        assert [rapid["kept"] for rapid in (await _get_document(client, ""))["rapids"]] == [True, False]
    replays = ReplayServer(config, config.digest)
    for number, status, code in ((1, 404, "NotKept"), (2, 422, "RecordingError"), (3, 404, "NoSuchRapid")):
        answer = replays.answer_request({"axis": "X", "number": number})
        fault = json.loads(answer[1:])
        assert (answer[0], fault["status"], fault["code"]) == ("-", status, code)
        assert fault["advice"]


@pytest.mark.usefixtures("processes")
async def test_hanging_replay_is_killed_and_ended_one_restarted(
    machine: MachineConfig, app: FastAPI, monkeypatch: pytest.MonkeyPatch
) -> None:
    hung = RapidReplayer(machine)
    monkeypatch.setattr(rapid_replayer, "LONGEST_S", 0.0)
    with pytest.raises(RequestRefused) as refused:
        await hung.replay_signals("X", 1)
    assert refused.value.document["code"] == "ReplayFailed"
    monkeypatch.undo()
    running = find_replayer(app)
    before = await running.replay_signals("X", 1)
    process = running._process
    assert process is not None
    await process.kill_and_wait()
    assert await running.replay_signals("X", 1) == before
    assert running._process is not process
    await running.close()


async def test_replay_queue_is_limited(machine: MachineConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    app, replayed = make_app(machine), asyncio.Event()

    async def answer(*_: object) -> bytes:
        await replayed.wait()
        return b"+{}\n"

    monkeypatch.setattr(find_replayer(app), "_exchange", answer)
    more = 3
    async with _make_client(app) as client:
        asked = [
            asyncio.create_task(client.get("/api/rapids/X/1/signals")) for _ in range(rapid_replayer.MOST_ASKING + more)
        ]
        try:
            async with asyncio.timeout(60):
                refused = [await first for first in islice(asyncio.as_completed(asked), more)]
        finally:
            replayed.set()
            answers = [answer.status_code for answer in await asyncio.gather(*asked)]
    assert [(answer.status_code, answer.json()["code"]) for answer in refused] == [(503, "Busy")] * more
    assert answers.count(200) == rapid_replayer.MOST_ASKING


def test_rapid_without_stored_recording_is_reported(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    with History.open(config.store.directory) as history:
        history.add_window(make_outcome(), "", STAMP)
    fault = json.loads(ReplayServer(config, config.digest).answer_request({"axis": "X", "number": 1})[1:])
    assert (fault["status"], fault["code"]) == (404, "NotKept")
    assert "was not stored" in fault["text"]


async def test_damaged_row_is_left_out(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    stored_weeks.fill_store(config, 3)
    with sqlite3.connect(config.store.directory / HISTORY_FILE_NAME) as database:
        database.execute("UPDATE windows SET fit_percent = 12, reasons = 'no JSON' WHERE id = 2")
    database.close()
    async with _make_client(make_app(config)) as client:
        assert [rapid["id"] for rapid in (await _get_document(client, ""))["rapids"]] == [3, 1]
        assert (await client.get("/api/rapids/X/2")).status_code == 404
        assert (await _get_document(client, "/counts"))["by_reason"] == []


async def test_empty_history_is_reported(tmp_path: Path) -> None:
    async with _make_client(make_app(config_of(tmp_path))) as client:
        answer = await client.get("/api/rapids")
    assert (answer.status_code, answer.json()["code"]) == (404, "NoHistory")


@pytest.fixture(scope="module")
def rapid(machine: MachineConfig) -> Window:
    return simulate_nominal_rapid("X", machine.axis["X"], machine.machine.sync_period_s)


def _get_signals(window: Window, config: MachineConfig) -> dict[str, Signal]:
    return {signal.name: signal for signal in make_rapid_signals(overlay_model(window, config)).signals}


def test_closed_loop_is_overlaid_without_voltage(rapid: Window, machine: MachineConfig) -> None:
    reported = _get_signals(replace(rapid, voltage_v=None, torque_constant_nm_per_a=0.8), machine)
    assert "voltage_v" not in reported
    for name, limit in (("speed_rad_s", 0.01), ("current_a", 0.02)):
        signal = reported[name]
        assert signal.model == "loop"
        assert signal.residual_rms is not None
        assert signal.residual_rms < limit * np.nanmax(np.abs(_list_numbers(signal.measured)))


def test_unknown_axis_is_shown_without_loop(rapid: Window, machine: MachineConfig) -> None:
    reported = _get_signals(replace(rapid, axis="Z"), machine)
    assert reported["speed_rad_s"].model == "voltage"
    assert reported["following_error_um"].model is None


def test_recorded_offsets_and_table_encoder_are_shown(rapid: Window, machine: MachineConfig) -> None:
    moved = replace(
        rapid, offset_mm=freeze_array(np.full(rapid.n, 2e-3)), table_mm=freeze_array(rapid.demand_mm + 5e-3)
    )
    reported = _get_signals(moved, machine)
    assert set(reported["offset_um"].measured) == {2.0}
    assert reported["table_error_um"].measured == pytest.approx([5.0] * rapid.n, abs=1e-6)


@pytest.mark.parametrize("value", [math.nan, 0.0, 1e300])
def test_implausible_signals_are_shown_without_model(value: float, rapid: Window, machine: MachineConfig) -> None:
    reported = _get_signals(replace(rapid, speed_rad_s=freeze_array(np.full(rapid.n, value))), machine)
    measured = reported["speed_rad_s"].measured
    assert len(measured) == rapid.n
    assert all(v is None or v == value for v in measured)


def test_lost_samples_are_null(rapid: Window, machine: MachineConfig) -> None:
    speed = rapid.speed_rad_s.copy()
    speed[400:402] = math.nan
    reported = _get_signals(replace(rapid, speed_rad_s=freeze_array(speed), gaps=((400, 402),)), machine)["speed_rad_s"]
    assert [k for k, v in enumerate(reported.measured) if v is None] == [400, 401]
    assert all(v is not None for v in reported.measured_spectrum)


@pytest.mark.parametrize("rows", [1000, 1001])
def test_spectrum_peak_of_sine_is_its_amplitude(rows: int) -> None:
    time_s = np.arange(rows) * 1e-3
    amplitude = compute_spectrum(2.0 + 3.0 * np.sin(2 * math.pi * 50.0 * time_s))
    frequency = np.fft.rfftfreq(rows, 1e-3)
    assert frequency[amplitude.argmax()] == pytest.approx(50.0, abs=0.1)
    assert amplitude.max() == pytest.approx(3.0, rel=0.01)
    assert amplitude[0] < 1e-2  # the mean is no signal


def test_long_recording_is_thinned_and_keeps_peaks(rapid: Window, machine: MachineConfig) -> None:
    rows = 2 * MOST_POINTS + 500
    longer: dict[str, Any] = {
        name: freeze_array(np.append(getattr(rapid, name), np.full(rows - rapid.n, getattr(rapid, name)[-1])))
        for name in ("demand_mm", "position_mm", "speed_rad_s", "current_a", "voltage_v")
    }
    reported = make_rapid_signals(ModelOverlay(replace(rapid, **longer), overlay_model(rapid, machine).outcome))
    assert reported.every == 3
    assert len(reported.time_s) == len(reported.signals[0].measured) <= MOST_POINTS
    assert len(reported.frequency_hz) == len(reported.signals[0].measured_spectrum) <= MOST_POINTS
    hum = np.sin(2 * math.pi * 100.0 * np.arange(rows) * 1e-3)
    assert compute_spectrum(hum).max() == pytest.approx(1.0, rel=0.05)


async def test_downloaded_recording_is_replayed(client: httpx.AsyncClient, tmp_path: Path) -> None:
    file = tmp_path / "w00000001-X.parquet"
    file.write_bytes((await client.get("/api/rapids/recordings/w00000001-X.parquet")).content)
    assert read_window(file).start_tick == 0
