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
from fdhil.web import daemon as asking
from fdhil.web import live_feed
from fdhil.web.daemon import Daemon
from fdhil.web.forecast import desk
from fdhil.web.live_feed import LiveFeed, Viewer
from tests.web.clients import machine_of

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
async def listening(path: Path, *answers: str | None) -> AsyncIterator[list[str]]:
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
async def test_a_stream_of_nonsense_is_told_and_the_next_one_is_read(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_feed, "RETRY_S", 0.0)
    begin = json.dumps({"ok": True, "live": "begin"})
    warm = json.dumps({"live": "temperature", "axis": "X", "celsius": 41.0})
    feed = LiveFeed(tmp_path / "s", {"X": None}, 1e-3)
    async with listening(tmp_path / "s", f"{begin}\n{line}", f"{begin}\n{warm}") as asked:
        task = asyncio.create_task(feed.run())
        async with feed.watched(Viewer("", 0.0)), asyncio.timeout(WAIT_S):
            while len(asked) < 2 or feed.trouble:
                await asyncio.sleep(0.01)
                assert not task.done()
        task.cancel()
        await asyncio.wait([task])


@pytest.mark.parametrize("answer", ["no JSON", DEEP, "[1]", '{"progress": 1', '{"progress": 1}', '{"progress"}'])
async def test_an_answer_of_nonsense_is_none(answer: str, tmp_path: Path) -> None:
    heard: list[Any] = []
    async with listening(tmp_path / "s", answer + "\n{"):
        with pytest.raises(ConnectError, match="without an answer"):
            await Daemon(tmp_path / "s").ask({"request": "arm"}, WAIT_S, progress=heard.append)


async def test_nobody_waits_in_a_line_before_a_silent_daemon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(asking.Daemon.ask, "__defaults__", (0.5, None))
    path = tmp_path / "s"
    daemon = Daemon(path)
    async with listening(path, None, '{"ok": true, "state": "OFF"}') as asked:
        answers: list[Any] = await asyncio.gather(*(daemon.status() for _ in range(9)), return_exceptions=True)
        assert {type(answer) for answer in answers} == {DeviceTimeout}
        while not asked:  # noqa: ASYNC110 - it may be heard later than it was given up
            await asyncio.sleep(0.01)
        assert len(asked) == 1
        monkeypatch.setattr(asking.Daemon.ask, "__defaults__", (WAIT_S, None))
        assert (await daemon.status())["state"] == "OFF"  # a failure is not kept


@pytest.mark.usefixtures("processes")
async def test_a_forecast_that_says_nonsense_has_failed_and_keeps_no_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(desk, "MAKER", "this")  # Python's own words

    async def content() -> AsyncIterator[bytes]:
        yield b"G1 X1"

    found = desk.Desk(machine_of(tmp_path, users=False))
    job = await found.take("part.ngc", content())
    assert job.forecasting.task is not None
    await asyncio.wait([job.forecasting.task], timeout=WAIT_S)
    assert (job.forecasting.state, job.over) == ("failed", True)
    await found.close()
