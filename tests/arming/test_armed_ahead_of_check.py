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

from fdhil.arming.arm_plan import AHEAD_S, ArmPlan, may_arm_ahead
from fdhil.arming.arming_service import ArmingService
from fdhil.arming.checked_program import CheckedBlock, CheckedProgram, RowStream, TablePiece
from fdhil.arming.guard_link import GuardLink
from fdhil.arming.operator_token import read_token
from fdhil.arming.program_check import encode_rows
from fdhil.arming.standstill_monitor import StandstillMonitor
from fdhil.arming.stream_feeder import StreamFeeder
from fdhil.config import MachineConfig
from fdhil.daemon.outcome_store import OutcomeStore
from fdhil.records import Notice, Reason, Skill
from fdhil.store.history_rows import Revision, TimeStamp
from tests.arming.machine_peer import RESERVE_ROWS, MachinePeer
from tests.arming.test_arm_plan import make_model_states, save_records
from tests.arming.test_program_check import HEAD, SQUARE
from tests.bench import bench_config
from tests.daemon.simulated_machine import config_of
from tests.store.sample_records import make_published

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
def machine_peer(config: MachineConfig, monkeypatch: pytest.MonkeyPatch) -> Iterator[MachinePeer]:
    monkeypatch.setattr("fdhil.arming.arm_plan.AHEAD_S", NEAR_S)
    assert config.store.run_directory is not None
    config.store.run_directory.mkdir(parents=True)
    made = MachinePeer(config.store.run_directory)
    yield made
    made.close()


@dataclass
class ArmingRig:
    desk: ArmingService
    mill: MachinePeer
    token: str
    told: list[Notice]

    async def arm(self, program: Path, **options: Any) -> dict[str, Any]:
        return dict(await self.desk.arm({"request": "arm", "program": str(program), "token": self.token, **options}))

    async def wait_until(self, done: Callable[[], object]) -> None:
        async with asyncio.timeout(PATIENCE_S):
            while not done():  # noqa: ASYNC110 - what other processes do has no event
                await asyncio.sleep(0.02)

    async def wait_for_rows(self, row: int) -> None:
        self.mill.advance(row)
        await self.wait_until(lambda: len(self.mill.rows) - row >= 10_000)

    async def advance(self, to: int, end: int) -> None:
        for row in [*range(self.mill.row, to, 4_000), to]:
            wanted = min(row + 10_000, end)
            self.mill.advance(row)
            await self.wait_until(partial(self._holds_rows, wanted))

    def _holds_rows(self, rows: int) -> bool:
        return len(self.mill.rows) >= rows

    def list_trips(self) -> bool:
        return any(notice.code == "GuardTripped" for notice in self.told)

    def list_major_notices(self) -> list[Notice]:
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
async def open_service(config: MachineConfig, mill: MachinePeer) -> AsyncIterator[ArmingRig]:
    assert config.store.run_directory is not None
    service = ArmingService(config, OutcomeStore(config), config.store.run_directory)
    stamp = TimeStamp(0.0, "another boot", 0)
    newest = replace(make_published(), config_digest=config.digest, temperature_c=None)
    skills = [Skill(axis, 1, 0.5, 1.0, 0.0, 30.0) for axis in ("X", "Y")]
    service.start_from_history(
        {axis: Revision(1, replace(newest, axis=axis), (), stamp) for axis in ("X", "Y")}, skills
    )
    for axis in ("X", "Y"):
        service.knowledge.take_outcomes([replace(newest, axis=axis)])
    reported: list[Notice] = []
    tasks = [asyncio.create_task(work(reported.extend)) for work in (service.supervise_guard, service.stream_rows)]
    try:
        yield ArmingRig(service, mill, read_token(config.store.run_directory), reported)
        assert not any(task.done() for task in tasks)
    finally:
        await service.shut_down()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def write_program(folder: Path, text: str) -> Path:
    path = folder / "long.ngc"
    path.write_text(text)
    return path


@pytest.mark.usefixtures("processes")
async def test_program_armed_ahead_of_check_ramps_down_when_check_stops(
    config: MachineConfig, machine_peer: MachinePeer, tmp_path: Path
) -> None:
    program = write_program(tmp_path, ENDLESS)
    async with open_service(config, machine_peer) as shop:
        answer = await shop.arm(program)
        assert answer["ok"], answer
        assert answer["check"]["whole"] is False
        assert answer["check"]["checked_s"] >= NEAR_S
        assert "the rest is checked ahead of the motion" in answer["text"]
        assert (machine_peer.state, len(machine_peer.rows), machine_peer.final) == ("ARMED", 10_000, False)
        await shop.wait_until(
            lambda: shop.checked.row_count >= 30_000
        )  # no busy host may have the check fall behind by itself
        for row in (500, 3_000, 8_000, 15_000):
            await shop.wait_for_rows(row)
        await _assert_other_request_keeps_check(shop, program)
        await _assert_starving_is_reported(shop)
        await _assert_death_is_reported(shop)
        passed = b"".join(shop.checked.read_block(k) for k in range(len(shop.checked.blocks)))
        assert np.array_equal(np.array(machine_peer.rows, dtype="<i4").ravel(), np.frombuffer(passed, "<i4"))
    assert not list(config.store.directory.glob("checked/*.json"))


async def _assert_other_request_keeps_check(shop: ArmingRig, program: Path) -> None:
    """A client that is refused because a check runs, and disconnects, does not end that check."""
    answer = await shop.arm(program)
    assert (answer["code"], answer["text"]) == ("NotOff", "the previous correction is still active, in state ACTIVE")
    assert not shop.desk.abandon_preparation()
    assert shop.desk.check_progress is not None


def stop_check(pid: int) -> None:
    os.kill(pid, signal.SIGSTOP)
    os.waitid(os.P_PID, pid, os.WSTOPPED | os.WNOWAIT)


async def _assert_starving_is_reported(shop: ArmingRig) -> None:
    """A check that stops is reported before the rows end; when it continues, so do the rows."""
    stop_check(shop.process)
    try:
        await asyncio.sleep(0.5)
        for _ in range(100):  # turns of the loop: what it had said is read
            await asyncio.sleep(0)
        end = shop.checked.row_count
        await shop.advance(end - 9_000, end)
        assert len(shop.mill.rows) == end
        assert shop.list_major_notices() == []
        shop.mill.advance(end - 5_500)
        await shop.wait_until(shop.list_major_notices)
    finally:
        os.kill(shop.process, signal.SIGCONT)
    (behind,) = shop.list_major_notices()
    assert behind.code == "CheckBehind"
    assert "the check of long.ngc is only 5.5 s ahead of the motion" in behind.text
    await shop.wait_until(lambda: len(shop.mill.rows) >= end + 4_000)
    await shop.wait_for_rows(end)
    assert shop.mill.state == "ACTIVE"


async def _assert_death_is_reported(shop: ArmingRig) -> None:
    """A killed check is reported at once; the rows that had passed are still sent."""
    os.kill(shop.process, signal.SIGKILL)
    await shop.wait_until(lambda: len(shop.list_major_notices()) == 2)
    died = shop.list_major_notices()[1]
    assert died.code == "InternalError"
    left = re.search(r"exit code -9 .* it is corrected for another (\d+\.\d) s, then ramped to zero", died.text)
    assert left, died.text
    end = shop.checked.row_count
    assert float(left[1]) == pytest.approx((end - shop.mill.row - RESERVE_ROWS) / 1000, abs=0.06)
    armed = shop.desk.armed
    assert armed is not None
    assert armed["check"]["refused"][0].startswith("InternalError: ")
    await shop.advance(end - RESERVE_ROWS, end)
    shop.mill.advance(end - RESERVE_ROWS + 1)
    assert (shop.mill.state, shop.mill.cause, len(shop.mill.rows)) == ("OFF", "TableStarved", end)
    await shop.wait_until(lambda: shop.desk.armed is None and shop.list_trips())
    assert [notice.text for notice in shop.told if notice.code == "GuardTripped"] == ["TableStarved: "]
    assert len(shop.list_major_notices()) == 2


@pytest.mark.usefixtures("processes")
async def test_later_refusal_is_reported_long_before_motion(
    config: MachineConfig, machine_peer: MachinePeer, tmp_path: Path
) -> None:
    async with open_service(config, machine_peer) as shop:
        answer = await shop.arm(write_program(tmp_path, HARD))
        assert answer["ok"], answer
        await shop.wait_for_rows(2_000)
        await shop.wait_until(shop.list_major_notices)
        refused = shop.list_major_notices()[0]
        assert refused.code == "DemandTooHigh"
        place = re.search(
            rf"line {HARD_LINE}, at (\d+\.\d+) s: axis X is at its current or voltage limit", refused.text
        )
        left = re.search(r"corrected for another (\d+\.\d) s, then ramped to zero before that line", refused.text)
        assert place, refused.text
        assert left, refused.text
        assert "lower the feed" in refused.text
        at = round(float(place[1]) * 1000)
        end = shop.checked.row_count
        assert at - 2_500 <= end <= at
        assert NEAR_S < float(left[1]) < (end - 2_000) / 1000
        await shop.advance(end - RESERVE_ROWS, end)
        machine_peer.advance(end - RESERVE_ROWS + 1)
        assert (machine_peer.state, machine_peer.cause, len(machine_peer.rows)) == ("OFF", "TableStarved", end)
        await shop.wait_until(
            lambda: shop.desk.check_progress is None and shop.desk.armed is None and shop.list_trips()
        )
        assert {notice.code for notice in shop.told} >= {"DemandTooHigh", "GuardTripped"}
        again = await shop.arm(tmp_path / "long.ngc", whole=True)  # now it is known, and nothing is armed
        assert (again["ok"], again["code"]) == (False, "DemandTooHigh")
        assert machine_peer.state == "OFF"


@pytest.mark.usefixtures("processes")
async def test_whole_check_is_awaited_on_request(
    config: MachineConfig, machine_peer: MachinePeer, tmp_path: Path
) -> None:
    async with open_service(config, machine_peer) as shop:
        answer = await shop.arm(write_program(tmp_path, HEAD + SQUARE * 10 + "M2\n"), whole=True)
        assert answer["ok"], answer
        assert answer["check"] == {"checked_s": answer["rows"] / 1000, "whole": True, "refused": []}
        assert answer["rows"] > 1000 * NEAR_S
        assert "ahead" not in answer["text"]
        assert shop.desk.check_progress is None
        await shop.advance(answer["rows"] - 1, answer["rows"])
        assert (len(machine_peer.rows), machine_peer.final, machine_peer.state) == (answer["rows"], True, "ACTIVE")


async def test_ramp_down_in_progress_is_awaited(
    config: MachineConfig, machine_peer: MachinePeer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fdhil.arming.arming_service.LANDING_S", 300.0)
    program = write_program(tmp_path, "G21 G90 G94\nG1 X20 F6000\nG1 Y20\nG4 P0.2\nM2\n")
    async with open_service(config, machine_peer) as shop:
        machine_peer.state = "RAMP_DOWN"
        arming = asyncio.create_task(shop.arm(program))
        await asyncio.sleep(0.2)
        assert not arming.done()
        machine_peer.state = "OFF"
        answer = await arming
        assert answer["ok"], answer
        machine_peer.state = "HOLD"
        monkeypatch.setattr("fdhil.arming.arming_service.LANDING_S", 0.1)
        answer = await shop.arm(program)
        assert (answer["code"], answer["advice"]) == (
            "NotOff",
            "run fdhil disarm or wait for its end, then arm again",
        )


def make_checked_program(config: MachineConfig, folder: Path, seconds: float, after_um: float = 1.0) -> CheckedProgram:
    folder.mkdir(exist_ok=True)
    rows = {axis: np.zeros(round(seconds / 0.001)) for axis in config.axis}
    (folder / "rows").write_bytes(encode_rows(rows, rows, config))
    checked = CheckedProgram(folder / "rows", tuple(config.axis))
    add_block(checked, round(seconds / 0.001), after_um)
    return checked


def add_block(checked: CheckedProgram, end: int, after_um: float = 1.0, *, last: bool = False) -> None:
    digest = hashlib.sha256(bytes(16 * (end - checked.row_count))).hexdigest()
    before, after = ({"rms_um": rms, "max_um": 2 * rms} for rms in (30.0, after_um))
    checked.add_block(CheckedBlock(end, digest, last), {"before": before, "after": after})


def make_feeder(checked: CheckedProgram, mill: MachinePeer, folder: Path) -> tuple[StreamFeeder, GuardLink]:
    link = GuardLink(folder, folder)
    link.read_status()
    stream = RowStream(checked, "digest", 0.001)
    armed = ArmPlan("long.ngc", stream, TablePiece(0, {}, {}, False), {}, 29.0)
    return StreamFeeder(armed, link, StandstillMonitor(bench_config())), link


def test_program_refused_before_start_is_disarmed(
    config: MachineConfig, machine_peer: MachinePeer, tmp_path: Path
) -> None:
    checked = make_checked_program(config, tmp_path / "c", 62.0)
    assert config.store.run_directory is not None
    feeder, link = make_feeder(checked, machine_peer, config.store.run_directory)
    machine_peer.state = "ARMED"
    assert {notice.code for notice in feeder.feed_rows()} == {"GuardFound", "GuardState"}
    checked.refused = (Reason("DemandTooHigh", "line 7, at 63.00 s: axis X has", "lower the feed"),)
    (found,) = feeder.feed_rows()
    assert (found.code, found.severity, machine_peer.state) == ("DemandTooHigh", "MAJOR", "OFF")
    assert found.text == (
        "line 7, at 63.00 s: axis X has; lower the feed; long.ngc was armed ahead of its check: the program had not"
        " begun and was disarmed"
    )
    link.close()


def test_changed_block_is_not_sent(config: MachineConfig, machine_peer: MachinePeer, tmp_path: Path) -> None:
    checked = make_checked_program(config, tmp_path / "c", 62.0)
    with (tmp_path / "c" / "rows").open("r+b") as file:
        file.write(b"\1")
    assert config.store.run_directory is not None
    feeder, link = make_feeder(checked, machine_peer, config.store.run_directory)
    machine_peer.state, machine_peer.rows = "ACTIVE", [(0, 0, 0, 0)] * 5_000
    notices = [notice for _ in range(3) for notice in feeder.feed_rows()]
    assert [notice.code for notice in notices if notice.severity == "MAJOR"] == ["CorruptFile"]
    assert "the correction ends before these rows" in notices[-1].text
    assert len(machine_peer.rows) == 5_000
    link.close()


@pytest.mark.parametrize("refused", [True, False])
def test_last_block_waits_for_result_of_whole_check(refused: bool, config: MachineConfig, tmp_path: Path) -> None:
    """A changed file or a missing gain is found only at the end, so that no block is final before."""
    checked = make_checked_program(config, tmp_path / "c", 4.0)
    (tmp_path / "c" / "rows").write_bytes(bytes(16 * 5_000))
    add_block(checked, 5_000, last=True)
    stream = RowStream(checked, "digest", 0.001)
    piece = stream.take_rows(10.0)
    assert (stream.end, piece.final, stream.has_block, stream.is_finished, stream.checked_until_s) == (
        4_000,
        False,
        False,
        False,
        4.0,
    )
    if refused:
        checked.refused = (Reason("NoGain", "the path error would be larger", "try another method"),)
    else:
        checked.set_header({**checked.errors, "largest_um": 5.0})
    assert (stream.has_block, checked.is_complete, stream.checked_until_s) == (
        not refused,
        not refused,
        4.0 if refused else 5.0,
    )
    assert stream.has_too_few_rows({"rows": [0, 4_000], "row": 0})
    if not refused:
        assert stream.take_rows().final
        assert stream.is_finished


def test_check_falling_behind_twice_is_reported_twice(
    config: MachineConfig, machine_peer: MachinePeer, tmp_path: Path
) -> None:
    checked = make_checked_program(config, tmp_path / "c", 10.0)
    with (tmp_path / "c" / "rows").open("ab") as file:
        file.write(bytes(16 * 8_000))
    assert config.store.run_directory is not None
    feeder, link = make_feeder(checked, machine_peer, config.store.run_directory)
    machine_peer.state = "ACTIVE"
    reported = []
    for row, end in ((0, 10_000), (3_000, 10_000), (4_500, 10_000), (4_600, 10_000), (4_600, 14_000), (3_900, 14_000),
                     (7_500, 14_000), (8_500, 14_000)):  # fmt: skip
        if end > checked.row_count:
            add_block(checked, end)
        machine_peer.row = row
        if not machine_peer.rows:
            assert link.extend_stream(feeder._armed, feeder._armed.stream.take_rows())["ok"]
        reported.append([notice.code for notice in feeder.feed_rows() if notice.severity == "MAJOR"])
    behind = ["CheckBehind"]
    assert reported == [[], [], behind, [], [], [], [], behind]
    assert len(machine_peer.rows) == 14_000
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
def test_arming_starts_when_rest_of_check_cannot_change_facts(
    seconds: float, after_um: float, watchdog: str, changes: Any, may: bool, config: MachineConfig, tmp_path: Path
) -> None:
    save_records(config, watchdog=watchdog)
    checked = make_checked_program(config, tmp_path / "c", seconds, after_um)
    assert may_arm_ahead(checked, config, make_model_states(config, **changes)) is may
