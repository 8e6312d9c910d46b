"""A long program is armed ahead of its check: only checked rows are sent, and its end is reported with the cause."""

from __future__ import annotations

import asyncio
import hashlib
import os
import re
import signal
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.arming.checked_program import Block, CheckedProgram, Piece, RowStream
from fdhil.arming.desk import ArmingDesk
from fdhil.arming.guard_link import GuardLink
from fdhil.arming.preparing import AHEAD_S, Armament, may_begin
from fdhil.arming.program_check import encoded
from fdhil.arming.standstill import Standstill
from fdhil.arming.stream_feeder import StreamFeeder
from fdhil.arming.token import read_token
from fdhil.config import MachineConfig
from fdhil.daemon.outcome_store import OutcomeStore
from fdhil.records import Notice, Reason, Skill
from fdhil.store.rows import Revision, Stamp
from tests.arming.mill import RESERVE_ROWS, Mill
from tests.arming.test_preparing import known, save_records
from tests.arming.test_program_check import HEAD, SQUARE
from tests.bench import bench_config
from tests.daemon.simulated_machine import config_of
from tests.store.made import published

NEAR_S = 12.0  # instead of AHEAD_S where a process really checks: the same, in a fifth of the processor time
ENDLESS = HEAD + SQUARE * 4000 + "M2\n"
HARD_LINE = 2 + 4 * 28 + 1  # some 40 s into the program
HARD = HEAD + SQUARE * 28 + "G1 X40 F30000\nG1 X0\nF6000\n" + SQUARE * 2 + "M2\n"
PATIENCE_S = 500.0  # another process computes, on a host that may be busy


@pytest.fixture
def config(tmp_path: Path) -> MachineConfig:
    """Two commissioned axes; the NC smooths little, so that a high feed exceeds the limits."""
    config = config_of(tmp_path, ("X", "Y"), nc={"smoothing_s": [0.02, 0.01]})
    save_records(config)
    return config


@pytest.fixture
def mill(config: MachineConfig, monkeypatch: pytest.MonkeyPatch) -> Iterator[Mill]:
    monkeypatch.setattr("fdhil.arming.preparing.AHEAD_S", NEAR_S)
    assert config.store.run_directory is not None
    config.store.run_directory.mkdir(parents=True)
    made = Mill(config.store.run_directory)
    yield made
    made.close()


@dataclass
class Shop:
    desk: ArmingDesk
    mill: Mill
    token: str
    told: list[Notice]

    async def arm(self, program: Path, **options: Any) -> dict[str, Any]:
        return dict(await self.desk.arm({"request": "arm", "program": str(program), "token": self.token, **options}))

    async def until(self, done: Callable[[], object]) -> None:
        async with asyncio.timeout(PATIENCE_S):
            while not done():  # noqa: ASYNC110 - what other processes do has no event
                await asyncio.sleep(0.02)

    async def fed(self, row: int) -> None:
        self.mill.move(row)
        await self.until(lambda: len(self.mill.rows) - row >= 10_000)

    async def walk(self, to: int, end: int) -> None:
        for row in [*range(self.mill.row, to, 4_000), to]:
            wanted = min(row + 10_000, end)
            self.mill.move(row)
            await self.until(partial(self._holds, wanted))

    def _holds(self, rows: int) -> bool:
        return len(self.mill.rows) >= rows

    def tripped(self) -> bool:
        return any(notice.code == "GuardTripped" for notice in self.told)

    def major(self) -> list[Notice]:
        return [notice for notice in self.told if notice.severity == "MAJOR" and notice.code != "GuardTripped"]

    @property
    def process(self) -> int:
        going = self.desk._check._going
        assert going is not None
        assert going._process.pid is not None
        return going._process.pid

    @property
    def checked(self) -> CheckedProgram:
        going = self.desk._check._going
        assert going is not None
        return going.checked


@asynccontextmanager
async def opened(config: MachineConfig, mill: Mill) -> AsyncIterator[Shop]:
    assert config.store.run_directory is not None
    desk = ArmingDesk(config, OutcomeStore(config), config.store.run_directory)
    stamp = Stamp(0.0, "another boot", 0)
    newest = replace(published(), config_digest=config.digest, temperature_c=None)
    skills = [Skill(axis, 1, 0.5, 1.0, 0.0, 30.0) for axis in ("X", "Y")]
    desk.begin({axis: Revision(1, replace(newest, axis=axis), (), stamp) for axis in ("X", "Y")}, skills)
    for axis in ("X", "Y"):
        desk.knowledge.note([replace(newest, axis=axis)])
    told: list[Notice] = []
    tasks = [asyncio.create_task(work(told.extend)) for work in (desk.attend, desk.stream)]
    try:
        yield Shop(desk, mill, read_token(config.store.run_directory), told)
        assert not any(task.done() for task in tasks)
    finally:
        await desk.stand_down()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def written(folder: Path, text: str) -> Path:
    path = folder / "long.ngc"
    path.write_text(text)
    return path


@pytest.mark.usefixtures("processes")
async def test_it_is_armed_ahead_of_its_check_and_ends_gently_when_that_stops(
    config: MachineConfig, mill: Mill, tmp_path: Path
) -> None:
    program = written(tmp_path, ENDLESS)
    async with opened(config, mill) as shop:
        answer = await shop.arm(program)
        assert answer["ok"], answer
        assert answer["check"]["whole"] is False
        assert answer["check"]["checked_s"] >= NEAR_S
        assert "the rest is checked ahead of the motion" in answer["text"]
        assert (mill.state, len(mill.rows), mill.final) == ("ARMED", 10_000, False)
        await shop.until(lambda: shop.checked.rows >= 30_000)  # no busy host may have the check fall behind by itself
        for row in (500, 3_000, 8_000, 15_000):
            await shop.fed(row)
        await _is_not_abandoned_by_another(shop, program)
        await _starves_with_a_word(shop)
        await _dies_with_a_word(shop)
        passed = b"".join(shop.checked.content(k) for k in range(len(shop.checked.blocks)))
        assert np.array_equal(np.array(mill.rows, dtype="<i4").ravel(), np.frombuffer(passed, "<i4"))
    assert not list(config.store.directory.glob("checked/*.json"))


async def _is_not_abandoned_by_another(shop: Shop, program: Path) -> None:
    """A client that is refused because a check runs, and disconnects, does not end that check."""
    answer = await shop.arm(program)
    assert (answer["code"], answer["text"]) == ("NotOff", "the previous correction is still active, in state ACTIVE")
    assert not shop.desk.abandon()
    assert shop.desk.checking is not None


def stop(pid: int) -> None:
    os.kill(pid, signal.SIGSTOP)
    os.waitid(os.P_PID, pid, os.WSTOPPED | os.WNOWAIT)


async def _starves_with_a_word(shop: Shop) -> None:
    """A check that stops is reported before the rows end; when it continues, so do the rows."""
    stop(shop.process)
    try:
        await asyncio.sleep(0.5)
        for _ in range(100):  # turns of the loop: what it had said is read
            await asyncio.sleep(0)
        end = shop.checked.rows
        await shop.walk(end - 9_000, end)
        assert len(shop.mill.rows) == end
        assert shop.major() == []
        shop.mill.move(end - 5_500)
        await shop.until(shop.major)
    finally:
        os.kill(shop.process, signal.SIGCONT)
    (behind,) = shop.major()
    assert behind.code == "CheckBehind"
    assert "the check of long.ngc is only 5.5 s ahead of the motion" in behind.text
    await shop.until(lambda: len(shop.mill.rows) >= end + 4_000)
    await shop.fed(end)
    assert shop.mill.state == "ACTIVE"


async def _dies_with_a_word(shop: Shop) -> None:
    """A killed check is reported at once; the rows that had passed are still sent."""
    os.kill(shop.process, signal.SIGKILL)
    await shop.until(lambda: len(shop.major()) == 2)
    died = shop.major()[1]
    assert died.code == "InternalError"
    left = re.search(r"exit code -9 .* it is corrected for another (\d+\.\d) s, then ramped to zero", died.text)
    assert left, died.text
    end = shop.checked.rows
    assert float(left[1]) == pytest.approx((end - shop.mill.row - RESERVE_ROWS) / 1000, abs=0.06)
    armed = shop.desk.armed
    assert armed is not None
    assert armed["check"]["refused"][0].startswith("InternalError: ")
    await shop.walk(end - RESERVE_ROWS, end)
    shop.mill.move(end - RESERVE_ROWS + 1)
    assert (shop.mill.state, shop.mill.cause, len(shop.mill.rows)) == ("OFF", "TableStarved", end)
    await shop.until(lambda: shop.desk.armed is None and shop.tripped())
    assert [notice.text for notice in shop.told if notice.code == "GuardTripped"] == ["TableStarved: "]
    assert len(shop.major()) == 2


@pytest.mark.usefixtures("processes")
async def test_a_place_that_is_refused_later_is_told_long_before_the_motion_reaches_it(
    config: MachineConfig, mill: Mill, tmp_path: Path
) -> None:
    async with opened(config, mill) as shop:
        answer = await shop.arm(written(tmp_path, HARD))
        assert answer["ok"], answer
        await shop.fed(2_000)
        await shop.until(shop.major)
        refused = shop.major()[0]
        assert refused.code == "DemandTooHigh"
        place = re.search(rf"line {HARD_LINE}, at (\d+\.\d+) s: axis X has a current or voltage limit", refused.text)
        left = re.search(r"corrected for another (\d+\.\d) s, then ramped to zero before that line", refused.text)
        assert place, refused.text
        assert left, refused.text
        assert "lower the feed" in refused.text
        at = round(float(place[1]) * 1000)
        end = shop.checked.rows
        assert at - 2_500 <= end <= at
        assert NEAR_S < float(left[1]) < (end - 2_000) / 1000
        await shop.walk(end - RESERVE_ROWS, end)
        mill.move(end - RESERVE_ROWS + 1)
        assert (mill.state, mill.cause, len(mill.rows)) == ("OFF", "TableStarved", end)
        await shop.until(lambda: shop.desk.checking is None and shop.desk.armed is None and shop.tripped())
        assert {notice.code for notice in shop.told} >= {"DemandTooHigh", "GuardTripped"}
        again = await shop.arm(tmp_path / "long.ngc", whole=True)  # now it is known, and nothing is armed
        assert (again["ok"], again["code"]) == (False, "DemandTooHigh")
        assert mill.state == "OFF"


@pytest.mark.usefixtures("processes")
async def test_a_whole_check_is_waited_for_when_it_is_asked_for(
    config: MachineConfig, mill: Mill, tmp_path: Path
) -> None:
    async with opened(config, mill) as shop:
        answer = await shop.arm(written(tmp_path, HEAD + SQUARE * 10 + "M2\n"), whole=True)
        assert answer["ok"], answer
        assert answer["check"] == {"checked_s": answer["rows"] / 1000, "whole": True, "refused": []}
        assert answer["rows"] > 1000 * NEAR_S
        assert "ahead" not in answer["text"]
        assert shop.desk.checking is None
        await shop.walk(answer["rows"] - 1, answer["rows"])
        assert (len(mill.rows), mill.final, mill.state) == (answer["rows"], True, "ACTIVE")


async def test_what_ended_a_moment_ago_is_waited_for(
    config: MachineConfig, mill: Mill, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fdhil.arming.desk.LANDING_S", 300.0)
    program = written(tmp_path, "G21 G90 G94\nG1 X20 F6000\nG1 Y20\nG4 P0.2\nM2\n")
    async with opened(config, mill) as shop:
        mill.state = "RAMP_DOWN"
        arming = asyncio.create_task(shop.arm(program))
        await asyncio.sleep(0.2)
        assert not arming.done()
        mill.state = "OFF"
        answer = await arming
        assert answer["ok"], answer
        mill.state = "HOLD"
        monkeypatch.setattr("fdhil.arming.desk.LANDING_S", 0.1)
        answer = await shop.arm(program)
        assert (answer["code"], answer["advice"]) == (
            "NotOff",
            "run fdhil disarm or wait for its end, then arm again",
        )


def checked_of(config: MachineConfig, folder: Path, seconds: float, after_um: float = 1.0) -> CheckedProgram:
    folder.mkdir(exist_ok=True)
    rows = {axis: np.zeros(round(seconds / 0.001)) for axis in config.axis}
    (folder / "rows").write_bytes(encoded(rows, rows, config))
    checked = CheckedProgram(folder / "rows", tuple(config.axis))
    pass_on(checked, round(seconds / 0.001), after_um)
    return checked


def pass_on(checked: CheckedProgram, end: int, after_um: float = 1.0, *, last: bool = False) -> None:
    digest = hashlib.sha256(bytes(16 * (end - checked.rows))).hexdigest()
    before, after = ({"rms_um": rms, "max_um": 2 * rms} for rms in (30.0, after_um))
    checked.take(Block(end, digest, last), {"before": before, "after": after})


def feeder_of(checked: CheckedProgram, mill: Mill, folder: Path) -> tuple[StreamFeeder, GuardLink]:
    link = GuardLink(folder, folder)
    link.look()
    stream = RowStream(checked, "digest", 0.001)
    armed = Armament("long.ngc", stream, Piece(0, {}, {}, False), {}, 29.0)
    return StreamFeeder(armed, link, Standstill(bench_config())), link


def test_what_is_refused_before_it_begins_is_disarmed(config: MachineConfig, mill: Mill, tmp_path: Path) -> None:
    checked = checked_of(config, tmp_path / "c", 62.0)
    assert config.store.run_directory is not None
    feeder, link = feeder_of(checked, mill, config.store.run_directory)
    mill.state = "ARMED"
    assert {notice.code for notice in feeder.go_on()} == {"GuardFound", "GuardState"}
    checked.refused = (Reason("DemandTooHigh", "line 7, at 63.00 s: axis X has", "lower the feed"),)
    (found,) = feeder.go_on()
    assert (found.code, found.severity, mill.state) == ("DemandTooHigh", "MAJOR", "OFF")
    assert found.text == (
        "line 7, at 63.00 s: axis X has; lower the feed; long.ngc was armed ahead of its check: the program had not"
        " begun and was disarmed"
    )
    link.close()


def test_a_block_that_is_not_what_was_checked_is_not_sent(config: MachineConfig, mill: Mill, tmp_path: Path) -> None:
    checked = checked_of(config, tmp_path / "c", 62.0)
    with (tmp_path / "c" / "rows").open("r+b") as file:
        file.write(b"\1")
    assert config.store.run_directory is not None
    feeder, link = feeder_of(checked, mill, config.store.run_directory)
    mill.state, mill.rows = "ACTIVE", [(0, 0, 0, 0)] * 5_000
    notices = [notice for _ in range(3) for notice in feeder.go_on()]
    assert [notice.code for notice in notices if notice.severity == "MAJOR"] == ["CorruptFile"]
    assert "the correction ends before these rows" in notices[-1].text
    assert len(mill.rows) == 5_000
    link.close()


@pytest.mark.parametrize("refused", [True, False])
def test_the_last_block_waits_for_what_is_found_of_the_whole(
    refused: bool, config: MachineConfig, tmp_path: Path
) -> None:
    """A changed file or a missing gain is found only at the end, so that no block is final before."""
    checked = checked_of(config, tmp_path / "c", 4.0)
    (tmp_path / "c" / "rows").write_bytes(bytes(16 * 5_000))
    pass_on(checked, 5_000, last=True)
    stream = RowStream(checked, "digest", 0.001)
    piece = stream.take(10.0)
    assert (stream.end, piece.final, stream.ready, stream.done, stream.reach_s) == (4_000, False, False, False, 4.0)
    if refused:
        checked.refused = (Reason("NoGain", "the path error would be larger", "try another method"),)
    else:
        checked.conclude({**checked.errors, "largest_um": 5.0})
    assert (stream.ready, checked.whole, stream.reach_s) == (not refused, not refused, 4.0 if refused else 5.0)
    assert stream.lacks({"rows": [0, 4_000], "row": 0})
    if not refused:
        assert stream.take().final
        assert stream.done


def test_a_check_that_falls_behind_twice_is_told_twice(config: MachineConfig, mill: Mill, tmp_path: Path) -> None:
    checked = checked_of(config, tmp_path / "c", 10.0)
    with (tmp_path / "c" / "rows").open("ab") as file:
        file.write(bytes(16 * 8_000))
    assert config.store.run_directory is not None
    feeder, link = feeder_of(checked, mill, config.store.run_directory)
    mill.state = "ACTIVE"
    told = []
    for row, end in ((0, 10_000), (3_000, 10_000), (4_500, 10_000), (4_600, 10_000), (4_600, 14_000), (3_900, 14_000),
                     (7_500, 14_000), (8_500, 14_000)):  # fmt: skip
        if end > checked.rows:
            pass_on(checked, end)
        mill.row = row
        if not mill.rows:
            assert link.extend(feeder._armed, feeder._armed.stream.take())["ok"]
        told.append([notice.code for notice in feeder.go_on() if notice.severity == "MAJOR"])
    behind = ["CheckBehind"]
    assert told == [[], [], behind, [], [], [], [], behind]
    assert len(mill.rows) == 14_000
    link.close()


@pytest.mark.parametrize(
    ("seconds", "after_um", "watchdog", "changes", "may"),
    [
        (AHEAD_S, 1.0, "proven", {}, True),
        (AHEAD_S - 0.001, 1.0, "proven", {}, False),
        (AHEAD_S, 1.0, "none", {}, False),  # a larger offset may still come
        (AHEAD_S, 29.5, "proven", {}, False),  # the gate would let none pass
        (AHEAD_S, 28.0, "proven", {}, True),  # enough for predictions within 1 um
        (AHEAD_S, 28.0, "proven", {"skills": (Skill("X", 1, 1.5, 2.0, 0.0, 30.0),)}, False),
        (AHEAD_S, 1.0, "proven", {"age_s": 1e6}, True),  # nothing to wait for: it is refused at once
    ],
)
def test_it_begins_when_the_rest_can_change_nothing(
    seconds: float, after_um: float, watchdog: str, changes: Any, may: bool, config: MachineConfig, tmp_path: Path
) -> None:
    save_records(config, watchdog=watchdog)
    checked = checked_of(config, tmp_path / "c", seconds, after_um)
    assert may_begin(checked, config, known(config, **changes)) is may
