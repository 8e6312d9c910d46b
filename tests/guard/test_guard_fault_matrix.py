"""Faults of the fault matrix whose class or full reaction no other guard test shows."""

from __future__ import annotations

import hashlib
import itertools
import json
import struct
from dataclasses import replace
from pathlib import Path

import pytest

from fdhil.guard.guard_protocol import Mode
from fdhil.guard.guard_settings import encode_settings
from tests.guard.guard_rig import TOKEN, GuardRig
from tests.guard.simulated_bus import FACTS_GIVEN, Bench, arm_request, bench
from tests.guard.test_guard_faults import Tell


def cutting(machine: Bench) -> Bench:
    machine.settle()
    assert machine.arm() == ()
    machine.run(30)
    machine.play()
    while machine.offsets[0] < 150:
        machine.run_sync()
    machine.alarms.clear()
    return machine


def ends_at_zero_by(machine: Bench, code: str, since_tick: int, tell: Tell) -> None:
    assert machine.alarms[-1].code == code
    machine.run_until(Mode.OFF)
    tell("sync_to_zero", machine.to_zero(since_tick))
    assert [drive.offset for drive in machine.drives] == [0, 0]
    sent = [offsets[0] for _, offsets in machine.frames]
    assert max(abs(b - a) for a, b in itertools.pairwise(sent)) <= machine.settings.axes[0].limits.hard_rate
    machine.settle()
    assert machine.mode is Mode.OFF


@pytest.mark.fault("A18")
def test_second_node_with_the_drives_id_ends_the_correction(record_property: Tell) -> None:
    machine = cutting(bench())
    since = machine.tick
    while machine.mode is Mode.ACTIVE:
        machine.receive_frames(0x281, struct.pack("<Hhh", 0x1237, 0, 7))
        machine.run_sync()
    ends_at_zero_by(machine, "ForeignProducer", since, record_property)


@pytest.mark.fault("A22")
def test_lost_heartbeat_ends_the_correction(record_property: Tell) -> None:
    machine = bench()
    watched = tuple(replace(axis, heartbeat_timeout_s=0.1) for axis in machine.settings.axes)
    machine.settings = machine.listener.settings = replace(machine.settings, axes=watched)

    def beat() -> None:
        for drive in machine.drives:
            machine.receive_frames(0x700 + drive.node_id, b"\x05")

    for _ in range(130):
        beat()
        machine.run_sync()
    assert machine.arm() == ()
    machine.play()
    while machine.offsets[0] < 150:
        beat()
        machine.run_sync()
    machine.alarms.clear()
    since = machine.tick
    for _ in range(110):
        machine.run_sync()
    assert machine.alarms[0].code == "HeartbeatLost"
    machine.run_until(Mode.OFF)
    record_property("sync_to_zero", machine.to_zero(since))
    assert [drive.offset for drive in machine.drives] == [0, 0]


@pytest.mark.fault("E4", "E7", "E14", "E19", "F5")
@pytest.mark.parametrize(
    ("fact", "code"),
    [
        pytest.param("model_fresh", "ModelStale", id="E4"),
        pytest.param("gain_positive", "HarmPredicted", id="E7"),
        pytest.param("watchdog_proven", "WatchdogNotArmed", id="E14"),
        pytest.param("skill_enough", "PoorSkill", id="E19"),
        pytest.param("journal_writable", "ReadOnlyStore", id="F5"),
    ],
)
def test_missing_fact_prevents_arming(fact: str, code: str) -> None:
    machine = bench()
    machine.settle()
    refused = machine.run_sync(arm_request(facts={**FACTS_GIVEN, fact: False})).refused
    assert refused is not None
    assert [alarm.code for alarm in refused] == [code]
    machine.run(50)
    assert machine.frames == []
    assert machine.heartbeats == []


@pytest.mark.fault("A16")
def test_pdo_longer_than_its_mapping_prevents_arming() -> None:
    machine = bench()
    machine.settle()
    machine.receive_frames(0x281, struct.pack("<Hhh", 0x1237, 0, 0) + b"\0")
    machine.run_sync()
    assert "PdoMapping" in {alarm.code for alarm in machine.arm()}
    assert machine.frames == []


class LateSync(Bench):
    late_s = 0.0

    def delay(self) -> None:
        hear = self.listener.receive_at_sync
        self.listener.receive_at_sync = lambda data, stamp_s, now_s: hear(  # type: ignore[method-assign]
            data, stamp_s + self.late_s, now_s + self.late_s
        )


@pytest.mark.fault("A8")
def test_one_late_sync_is_bridged_and_a_wrong_period_ends_the_correction(record_property: Tell) -> None:
    made = bench(clock="monotonic")
    machine = LateSync(made.settings, made.path, made.demand)
    machine.delay()
    cutting(machine)
    machine.late_s += 0.0025
    machine.run_sync()
    assert machine.mode is Mode.HOLD
    machine.run_until(Mode.ACTIVE, 40)
    since = machine.tick
    for _ in range(60):
        machine.late_s += 0.00005  # 5 percent of the period with each
        machine.run_sync()
    assert machine.state.cause is not None
    assert machine.state.cause.code == "SyncJitter"
    ends_at_zero_by(machine, "SyncJitter", since, record_property)


@pytest.mark.fault("G10")
@pytest.mark.goal("R16")
def test_operator_token_appears_in_no_output(tmp_path: Path) -> None:
    shop = GuardRig(tmp_path)
    try:
        client = shop.into_the_cut()
        answers = [
            shop.ask(client, {"request": "arm", "token": TOKEN}),
            shop.ask(client, {"request": "adopt", "token": TOKEN, TOKEN: 1}),
            shop.ask(client, {"request": "status", "token": TOKEN}),
        ]
        written = json.dumps([answers, shop.events()]) + encode_settings(shop.settings)
        assert TOKEN not in written
        assert repr(TOKEN)[1:-1] not in written
        assert hashlib.sha256(TOKEN.encode()).hexdigest() in encode_settings(shop.settings)
    finally:
        shop.close()
