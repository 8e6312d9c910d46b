"""Invalid or missing answers of other processes are reported, and the web server continues."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from fdhil.errors import ConnectError, DeviceTimeout
from fdhil.web import daemon_client as asking
from fdhil.web import live_feed
from fdhil.web.daemon_client import DaemonClient
from fdhil.web.forecast import forecast_queue
from fdhil.web.live_feed import LiveFeed, LiveViewer
from tests.web.http_clients import write_machine

WAIT_S = 60.0
DEEP = "[" * 100_000
NONSENSE = [
    "no JSON", DEEP,
    *(json.dumps({"live": "samples", "axis": "X", **line}) for line in (
        {"tick": None, "values": ""}, {"tick": 0, "ticks": "", "values": ""}, {"tick": 1e400, "values": "AAAA"},
        {"tick": 10**30, "values": "AAAAAAAAAAAAAAAAAAAAAAAAAAA="}, {"axis": ["X"]},
    )),
    json.dumps({"live": "times", "tick": 5, "t_ns": 1}),
    json.dumps({"live": ["samples"]}),
]  # fmt: skip


@asynccontextmanager
async def serve_answers(path: Path, *answers: str | None) -> AsyncIterator[list[str]]:
    """Answer each connection with the next of these, the last forever; None is silence. Yields the requests."""
    asked: list[str] = []

    ended = asyncio.Event()

    async def attend(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        answer = answers[min(len(asked), len(answers) - 1)]
        try:
            asked.append((await reader.readline()).decode())
            if answer is not None:
                writer.write(answer.encode() + b"\n")
            await ended.wait()
        finally:
            writer.close()

    async with await asyncio.start_unix_server(attend, str(path)):
        yield asked
        ended.set()
        await asyncio.gather(*(task for task in asyncio.all_tasks() if task is not asyncio.current_task()))


@pytest.mark.parametrize("line", NONSENSE, ids=range(len(NONSENSE)))
async def test_invalid_stream_is_reported_and_next_one_read(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_feed, "RETRY_S", 0.0)
    begin = json.dumps({"ok": True, "live": "begin"})
    warm = json.dumps({"live": "temperature", "axis": "X", "celsius": 41.0})
    feed = LiveFeed(tmp_path / "s", {"X": None}, 1e-3)
    async with serve_answers(tmp_path / "s", f"{begin}\n{line}", f"{begin}\n{warm}") as asked:
        task = asyncio.create_task(feed.run())
        async with feed.register_viewer(LiveViewer("", 0.0)), asyncio.timeout(WAIT_S):
            while len(asked) < 2 or feed.fault_text:
                await asyncio.sleep(0.01)
                assert not task.done()
        task.cancel()
        await asyncio.wait([task])


@pytest.mark.parametrize("answer", ["no JSON", DEEP, "[1]", '{"progress": 1', '{"progress": 1}', '{"progress"}'])
async def test_invalid_answer_is_refused(answer: str, tmp_path: Path) -> None:
    received: list[Any] = []
    async with serve_answers(tmp_path / "s", answer + "\n{"):
        with pytest.raises(ConnectError, match="without an answer"):
            await DaemonClient(tmp_path / "s").send_request({"request": "arm"}, WAIT_S, progress=received.append)


async def test_requests_do_not_queue_for_silent_daemon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(asking.DaemonClient.send_request, "__defaults__", (0.5, None))
    path = tmp_path / "s"
    daemon = DaemonClient(path)
    async with serve_answers(path, None, '{"ok": true, "state": "OFF"}') as asked:
        answers: list[Any] = await asyncio.gather(*(daemon.read_status() for _ in range(9)), return_exceptions=True)
        assert {type(answer) for answer in answers} == {DeviceTimeout}
        while not asked:  # noqa: ASYNC110 - it may be heard later than it was given up
            await asyncio.sleep(0.01)
        assert len(asked) == 1
        monkeypatch.setattr(asking.DaemonClient.send_request, "__defaults__", (WAIT_S, None))
        assert (await daemon.read_status())["state"] == "OFF"  # a failure is not kept


@pytest.mark.usefixtures("processes")
async def test_invalid_forecast_output_fails_and_frees_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(forecast_queue, "MAKER", "this")  # Python's own words

    async def content() -> AsyncIterator[bytes]:
        yield b"G1 X1"

    found = forecast_queue.ForecastQueue(write_machine(tmp_path, users=False))
    job = await found.add_program("part.ngc", content())
    assert job.forecasting.task is not None
    await asyncio.wait([job.forecasting.task], timeout=WAIT_S)
    assert (job.forecasting.state, job.is_over) == ("failed", True)
    await found.close()
