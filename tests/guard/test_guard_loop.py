"""The guard's loop, turn by turn: bus, clients, signals and systemd, independent of real clocks."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import select
import socket
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fdhil.errors import DeviceError
from fdhil.guard import correction_table, guard_process, table_intake
from fdhil.guard.can_socket import Frame
from fdhil.guard.emergency_ramp import ramp_to_zero
from fdhil.guard.event_journal import SYSTEM, EventJournal, SystemdNotifier
from fdhil.guard.guard_access import ClientProcess, GuardAccess
from fdhil.guard.guard_socket import MAX_CLIENTS, MAX_LINE_BYTES, DescriptorCloser, GuardSocketClient, GuardSocketServer
from tests.guard import guard_rig as shop_module
from tests.guard.feedforward_machine import FACTS, LAW, fed_settings
from tests.guard.guard_rig import OWNER, TOKEN, GuardRig
from tests.guard.simulated_bus import DIGEST, FACTS_GIVEN, LIMITS, RECORD

Make = Callable[..., GuardRig]


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    made: list[GuardRig] = []

    def build(*arguments: Any, **changes: Any) -> GuardRig:
        folder = tmp_path / str(len(made))
        folder.mkdir()
        made.append(GuardRig(folder, *arguments, **changes))
        return made[-1]

    yield build
    for shop in made:
        shop.close()


def inside(offsets: list[int]) -> None:
    values = [0, 0, *offsets]
    rates = [b - a for a, b in itertools.pairwise(values)]
    assert max(map(abs, values)) <= LIMITS.offset
    assert max(map(abs, rates)) <= LIMITS.hard_rate
    assert max(abs(b - a) for a, b in itertools.pairwise(rates)) <= LIMITS.hard_acceleration


def arm_line() -> bytes:
    return json.dumps({"request": "arm", "token": TOKEN, "program_digest": DIGEST, "facts": dict(FACTS_GIVEN)}).encode()


# --- signals and the end ---


def test_stop_ramps_to_zero_and_exits_with_0(make: Make) -> None:
    shop = make()
    shop.into_the_cut()
    shop.stop.send(b"\x0f\x01")
    shop.cycle()
    shop.stop.send(b"\x01")  # once more changes nothing
    while shop.guard.state.sending or shop.guard._requests:
        shop.cycle()
    assert shop.guard.run() == 0
    inside(shop.offsets())
    event = shop.events()[-1]
    assert (event["event"], event["may_stand_um"]) == ("stopped", {"X": 0.0, "Y": 0.0})
    assert "text" not in event


def test_frozen_guard_exits_with_3_and_reports_the_applied_offset(make: Make) -> None:
    shop = make()
    shop.into_the_cut()
    shop.wire.down = True
    shop.wire.feed([])
    shop.turn()
    assert shop.state == "FROZEN"
    shop.stop.send(b"\x0f")
    shop.guard._last_sync_s -= 10.0
    assert shop.guard.run() == 3
    result = shop.events()[-1]
    assert result["may_stand_um"]["X"] != 0.0
    assert "um on X" in result["text"]
    assert "may still be applied" in result["text"]
    assert "Network" not in result["text"]
    assert [event["text"] for event in shop.events() if event["event"] == "bus_down"] == ["the cable is cut"]


@pytest.mark.parametrize("where", ["client", "core", "listener"])
@pytest.mark.fault("F20")
def test_internal_error_ramps_to_zero_and_exits_with_3(make: Make, where: str, monkeypatch: pytest.MonkeyPatch) -> None:
    shop = make()
    client = shop.into_the_cut()
    before = len(shop.offsets())

    def fail(*_: object, **__: object) -> Any:
        raise RecursionError("too deep")

    if where == "client":
        monkeypatch.setattr(guard_process, "parse_request", fail)
        client.send(b'{"request": "adopt"}\n')
    else:
        broken = (
            "fdhil.guard.guard_step.step_guard"
            if where == "core"
            else "fdhil.guard.frame_monitor.FrameMonitor.receive_at_sync"
        )
        monkeypatch.setattr(broken, fail)

    def next_sync(*_: object) -> list[tuple[int, bytes, float]]:
        return [(0x080, b"", 0.0)] if len(shop.offsets()) % 3 else [(0x080, b"", 0.0), (0x181, b"", 0.0)]

    shop.wire.feed([(0x080, b"\x01", 0.0)])
    monkeypatch.setattr(shop.wire, "receive", next_sync)
    assert shop.guard.run() == 3
    assert shop.offsets()[-5:] == [0] * 5
    assert len(shop.offsets()) > before
    inside(shop.offsets())
    failed, stopped = shop.events()[-2:]
    assert (failed["code"], stopped["may_stand_um"]) == ("InternalError", {"X": None, "Y": None})
    assert "RecursionError: too deep" in failed["text"]
    assert "an unknown offset on X and an unknown offset on Y may still be applied" in stopped["text"]


def test_internal_error_while_idle_sends_nothing(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    shop = make()
    shop.run(60)
    monkeypatch.setattr(shop.guard, "_serve_sockets", lambda: [][0])
    assert shop.guard.run() == 3
    assert shop.wire.sent == []
    assert shop.events()[-1]["may_stand_um"] == {"X": 0.0, "Y": 0.0}


def test_emergency_ramp_stops_without_bus_or_sync_and_waits_on_a_full_queue(make: Make) -> None:
    shop = make()
    shop.into_the_cut()
    offset = shop.offsets()[-1]
    state, quick = shop.guard.state, replace(shop.settings, clock="monotonic", sync_period_s=1e-5)
    assert ramp_to_zero(state, (), quick, shop.wire, SYSTEM)[0] == offset  # no SYNC comes
    shop.wire.feed([(0x181, b"", 0.0)])
    assert ramp_to_zero(state, (), quick, shop.wire, SYSTEM)[0] == offset  # nor any that counts
    shop.wire.feed([(0x080, b"", 0.0)])
    shop.wire.full = True
    assert ramp_to_zero(state, (), quick, shop.wire, SYSTEM)[0] == offset
    shop.wire.down = True
    shop.wire.feed([])
    assert ramp_to_zero(state, (), shop.settings, shop.wire, SYSTEM)[0] == offset


def test_feedforward_is_reported_and_zeroed_by_a_fault(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    shop = make(fed_settings())
    client = shop.connect()
    law = LAW._asdict()
    shop.run(150)
    laws = {"X": law, "Y": law}
    answer = shop.ask(client, {"request": "feedforward", "token": TOKEN, "laws": laws, "facts": FACTS})
    assert answer["ok"], answer
    shop.playing = True
    shop.run(150)
    assert any(data != bytes(6) for cob_id, data in shop.wire.sent if cob_id == 0x401)
    status = shop.ask(client, {"request": "status"})
    assert (status["state"], status["feedforward"]["state"]) == ("FEEDFORWARD", "ON")
    shop.wire.feed([(0x080, b"", 0.0)])
    monkeypatch.setattr(shop.wire, "receive", lambda: [(0x080, b"", 0.0)])
    monkeypatch.setattr("fdhil.guard.guard_step.step_guard", lambda *_: [][0])
    sent = len(shop.wire.sent)
    assert shop.guard.run() == 3
    assert {(cob_id, data) for cob_id, data in shop.wire.sent[sent:]} == {(0x401, bytes(6)), (0x402, bytes(6))}


def test_disarm_ends_the_feedforward(make: Make) -> None:
    shop = make(fed_settings())
    client = shop.connect()
    shop.run(150)
    asked = {"request": "feedforward", "token": TOKEN, "laws": dict.fromkeys("XY", LAW._asdict()), "facts": FACTS}
    assert shop.ask(client, asked)["ok"]
    assert shop.ask(client, {"request": "disarm"})["ok"]
    shop.run(300)
    ended = [event for event in shop.events() if event["event"] == "feedforward"][-1]
    assert (ended["state"], ended["code"]) == ("OFF", "Disarmed")


# --- the bus ---


def test_send_error_sets_the_bus_down(make: Make) -> None:
    shop = make()
    shop.into_the_cut()
    shop.wire.down = True
    monkey = shop.wire.receive
    shop.wire.down = False
    frames = [(0x080, bytes([shop.tick % 240 + 1]), (shop.tick + 1) * 1e-3)]

    def then_down() -> Any:
        taken = monkey()
        shop.wire.down = True
        return taken

    shop.wire.receive = then_down  # type: ignore[method-assign] # it breaks after this SYNC
    shop.wire.feed(frames)
    shop.turn()
    assert [event["text"] for event in shop.events() if event["event"] == "bus_down"] == ["Network is down"]
    while shop.state != "FROZEN":  # and is not looked at any more
        shop.guard._last_sync_s -= 10.0
        shop.turn()


def test_restored_bus_is_received_and_the_offset_adopted(make: Make) -> None:
    shop = make()
    client = shop.into_the_cut()
    shop.wire.down = True
    shop.wire.feed([])
    shop.turn()
    assert shop.state == "FROZEN"
    sent = len(shop.wire.sent)
    for later_s in (0.0, 10.0):
        shop.guard._restore_bus(shop.guard._restore_s + later_s)  # still gone
    assert shop.guard._listener.bus_state == "down"
    shop.wire.down, shop.playing = False, False
    shop.guard._restore_bus(shop.guard._restore_s)
    assert [event["event"] for event in shop.events()].count("bus_restored") == 1
    shop.run(100)
    assert (shop.state, len(shop.wire.sent)) == ("FROZEN", sent)
    assert shop.ask(client, {"request": "adopt", "token": TOKEN})["ok"]
    shop.run(300)
    assert shop.state == "OFF"
    assert shop.offsets()[-1] == 0
    inside(shop.offsets())


def test_unsent_frames_are_not_counted_as_sent(make: Make) -> None:
    shop = make()
    shop.into_the_cut()
    shop.wire.full = True
    shop.run(20)
    assert shop.guard.state.cause is not None
    assert shop.guard.state.cause.code in ("TxQueueFull", "EchoMismatch")


def steep(rows: int) -> list[int]:
    rise = [6] * 10 + [0] * 2 + [-6] * 10
    rates = list(itertools.accumulate([0] * 200 + rise + [0] * 10 + [-change for change in rise] + [0] * rows))
    return list(itertools.accumulate(rates))[:rows]


@pytest.fixture
def steep_table(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shop_module, "OFFSET", [steep(len(column)) for column in shop_module.DEMAND])


@pytest.mark.usefixtures("steep_table")
@pytest.mark.parametrize("node", [1, 2])
@pytest.mark.parametrize("then", ["alive", "disarm"])
@pytest.mark.fault("A5")
def test_axis_whose_frame_left_continues_when_the_other_did_not(make: Make, node: int, then: str) -> None:
    shop = make()
    client = shop.arm()
    shop.playing = True
    while shop.offsets()[-1] < 250:
        shop.cycle()
    stood = len(shop.offsets(node)) - 1
    shop.wire.kept_back = (0x300 + node,)
    shop.cycle()
    shop.wire.kept_back = ()
    client.send(json.dumps({"request": then}).encode() + b"\n")
    shop.run(100)
    inside(shop.offsets(3 - node))
    inside([0] + [offset - shop.offsets(node)[stood] for offset in shop.offsets(node)[stood:]])
    assert shop.state == ("OFF" if then == "disarm" else "ACTIVE")


@pytest.mark.parametrize("ends_at", [0x302, 0x764])
@pytest.mark.fault("A1")
def test_offset_sent_before_the_bus_went_down_stays_applied(make: Make, ends_at: int) -> None:
    shop = make()
    client = shop.arm()
    shop.playing = True
    while not shop.wire.down:
        if shop.offsets()[-1]:
            shop.wire.ends_at = (ends_at,)
        shop.cycle()
        client.send(b'{"request": "alive"}\n')
    while shop.state != "FROZEN":
        shop.guard._last_sync_s -= 10.0
        shop.turn()
    shop.stop.send(b"\x0f")
    assert shop.guard.run() == 3
    event = shop.events()[-1]["may_stand_um"]
    per_um = shop.settings.axes[0].increments_per_mm / 1000
    assert event["X"] == pytest.approx(shop.offsets(1)[-1] / per_um, abs=0.06)
    assert event["X"] != 0.0


def test_internal_error_ramps_from_the_last_sent_offset(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    shop = make()
    shop.into_the_cut()
    shop.wire.kept_back = (0x301,)
    shop.cycle()
    shop.wire.kept_back = ()
    unsent: list[object] = []

    def landed(_state: object, missed: object, *_: object) -> tuple[int, ...]:
        unsent.append(missed)
        return (0, 0)

    monkeypatch.setattr(guard_process, "ramp_to_zero", landed)
    shop.guard._ramp_after_failure(RecursionError("too deep"))
    assert unsent == [(0,)]


def test_controller_states_and_lost_frames_raise_alarms(make: Make) -> None:
    shop = make()
    shop.into_the_cut()
    shop.wire.lost_frames = 3
    shop.cycle()
    assert shop.guard.state.cause is not None
    assert shop.guard.state.cause.code == "RxOverflow"
    shop.wire.feed([(-1, b"off", 0.0)])
    shop.turn()
    shop.cycle()
    assert shop.state == "FROZEN"


def test_local_timer_steps_without_sync_after_reading_frames(make: Make) -> None:
    shop = make()
    client = shop.into_the_cut()
    shop.guard._last_sync_s -= 10.0
    shop.wire.feed([])
    shop.guard._step_without_sync()  # frames wait: it was this process that slept
    assert shop.state == "ACTIVE"
    shop.turn()
    shop.turn()
    assert shop.state == "FROZEN"
    client.send(b'{"request": "status"}\n')
    status = shop.answer(client, syncing=False)
    assert (status["sync_heard"], status["not_good"][0]["code"]) == (False, "SyncLost")


def test_babbling_node_does_not_hide_missing_sync(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    shop = make()
    shop.into_the_cut()
    received = shop.wire.receive

    def babbling() -> list[Frame]:
        frames = received()
        shop.wire.feed([(0x701, b"\x05", 0.0)])
        return frames

    monkeypatch.setattr(shop.wire, "receive", babbling)
    shop.wire.feed([])
    shop.guard._last_sync_s -= 10.0
    shop.turn()
    assert shop.state == "ACTIVE"  # what had waited is read first
    for _ in range(2000):  # a step takes a SYNC period of time
        shop.turn()
    assert shop.state == "FROZEN"


def test_first_of_two_simultaneous_syncs_is_late(make: Make) -> None:
    shop = make()
    shop.into_the_cut()
    sent = len(shop.offsets())
    shop.wire.feed([(0x080, bytes([(shop.tick + k) % 240 + 1]), (shop.tick + k + 1) * 1e-3) for k in (0, 1)])
    shop.turn()
    assert len(shop.offsets()) == sent + 1
    assert shop.guard.state.missed == 1


# --- the clients ---


def test_status_shows_the_shadow_offsets(make: Make) -> None:
    shop = make()
    client = shop.connect()
    shop.load(client)
    shop.run(60)
    shop.playing = True
    shop.run(250)
    status = shop.ask(client, {"request": "status", "id": "mine"})
    assert status["id"] == "mine"
    assert status["shadow_um"]["X"] != 0.0
    assert status["may_stand_um"] == {"X": 0.0, "Y": 0.0}
    assert shop.wire.sent == []


@pytest.mark.fault("E4")
def test_withdrawn_fact_ends_the_correction(make: Make) -> None:
    shop = make()
    client = shop.into_the_cut()
    other = shop.connect()
    for sender, facts in ((other, {"model_fresh": False}), (client, "none"), (client, {"model_fresh": True})):
        sender.send(json.dumps({"request": "alive", "facts": facts}).encode() + b"\n")
        assert shop.ask(sender, {"request": "status"})["state"] == "ACTIVE"
    client.send(b'{"request": "alive", "facts": {"model_fresh": null}}\n')
    assert shop.ask(client, {"request": "status"})["ok"]
    shop.cycle()
    assert shop.guard.state.cause is not None
    assert shop.guard.state.cause.code == "ModelStale"


def test_disconnected_arm_request_does_not_end_another_correction(make: Make) -> None:
    shop = make()
    shop.into_the_cut()
    other = shop.connect()
    other.send(b'{"request": "arm"}\n')
    while not shop.guard._requests:
        shop.turn()
    other.close()
    while len(shop.guard.control.clients) > 1:
        shop.turn()
    shop.run(5)
    assert shop.state == "ACTIVE"


@pytest.mark.fault("G1")
def test_refusal_lists_all_its_reasons(make: Make) -> None:
    shop = make()
    client = shop.connect()
    shop.run(10)
    answer = shop.ask(client, {"request": "arm", "token": 5, "facts": [], "program_digest": "x" * 1000})
    codes = {refusal["code"] for refusal in answer["refused"]}
    assert {"AuthRequired", "ProgramMismatch", "NotCommissioned"} <= codes
    assert shop.ask(client, b"[1, 2]")["code"] == "BadRequest"
    assert "'sing'" in shop.ask(client, {"request": "sing"})["text"]
    assert "no name" in shop.ask(client, {"request": ["arm"]})["text"]


def test_disarm_replaces_the_pending_request_of_a_client(make: Make) -> None:
    shop = make()
    client = shop.connect()
    shop.run(5)
    client.send(b"".join(b'{"request": "%s", "id": %d}\n' % (kind, k) for k, kind in enumerate(
        [b"arm", b"adopt", b"disarm", b"disarm"])))  # fmt: skip
    reply = [shop.answer(client, syncing=False)]
    while len(reply) < 3:
        reply.append(shop.answer(client, syncing=False))
    codes = [(1, "GuardBusy"), (0, "DisarmedSince"), (3, "GuardBusy")]
    assert [(answer["id"], answer["code"]) for answer in reply] == codes
    assert shop.answer(client)["ok"]


def test_disarm_replaces_the_pending_requests_of_others(make: Make) -> None:
    shop = make()
    first, second = shop.connect(), shop.connect()
    shop.run(5)
    first.send(b'{"request": "arm"}\n')
    shop.serve()
    second.send(b'{"request": "disarm"}\n')
    assert shop.answer(first, syncing=False)["code"] == "DisarmedSince"
    assert shop.answer(second)["ok"]


def test_requests_of_disconnected_clients_do_not_accumulate(make: Make) -> None:
    shop = make()
    shop.run(130)
    for kind in [b"adopt"] * 20 + [b"disarm"] * 20:
        client = shop.connect()
        client.send(b'{"request": "%s"}\n' % kind)
        shop.serve()
        client.close()
        shop.serve()
    assert len(shop.guard._requests) <= 2
    disarms = shop.guard.build_status()["disarms"]
    for _ in range(3 * MAX_CLIENTS):
        shop.connect().send(b'{"request": "alive"}\n')
        for client in shop._clients[-2 * MAX_CLIENTS :]:
            with contextlib.suppress(OSError):
                client.send(b'{"request": "alive"}\n')
        shop.serve()
    assert len(shop.guard.control.clients) <= MAX_CLIENTS
    shop.cycle()
    assert not shop.guard._requests
    assert shop.guard.build_status()["disarms"] == disarms == 20


def test_request_from_before_the_last_disarm_is_refused(make: Make) -> None:
    """As of a daemon that was suspended between loading and arming, while another client disarmed."""
    shop = make()
    client, other = shop.connect(), shop.connect()
    shop.run(10)
    known = shop.ask(client, {"request": "status"})["disarms"]
    assert shop.ask(other, {"request": "disarm"})["ok"]
    for kind in ("arm", "feedforward"):
        answer = shop.ask(client, {"request": kind, "disarms": known})
        assert [refused["code"] for refused in answer["refused"]] == ["DisarmedSince"]
    newer = shop.ask(client, {"request": "status"})["disarms"]
    for request in ({"request": "arm", "disarms": newer}, {"request": "arm"}):
        answer = shop.ask(client, request)
        assert "AuthRequired" in {refused["code"] for refused in answer["refused"]}


def test_second_table_and_long_table_are_refused_as_busy(make: Make) -> None:
    shop = make()
    client, other = shop.into_the_cut(), shop.connect()
    zeros = dict.fromkeys("XY", [0] * 3000)
    pieces = [
        correction_table.seal_table(correction_table.encode_table("XY", zeros, zeros, "another", first))
        for first in (0, 600)
    ]
    long = correction_table.seal_table(bytes(1 << 19))
    try:
        assert shop.ask(other, {"request": "table"}, pieces[0])["code"] == "TableBusy"
        assert shop.ask(other, {"request": "table"}, pieces[1])["code"] == "ProgramMismatch"
        assert shop.ask(other, {"request": "table"}, long)["code"] == "TableBusy"
        assert shop.ask(other, {"request": "table"})["code"] == "CorruptFile"
        assert shop.ask(other, {"request": "table"})["code"] == "CorruptFile"
        assert shop.state == "ACTIVE"
        shop.ask(client, {"request": "disarm"})
        shop.run(200)
        for each in (client, other):
            socket.send_fds(each, [b'{"request": "table"}\n'], [pieces[0]])
        answers = [shop.answer(client, syncing=False), shop.answer(other, syncing=False)]
        assert sorted(answer.get("code", "") for answer in answers) == ["", "TableBusy"]
    finally:
        for descriptor in (*pieces, long):
            os.close(descriptor)
    assert sum(event["event"] == "table_refused" for event in shop.events()) == 5  # the same twice is told once


def test_table_received_before_arming_is_refused_after_it(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table_intake, "ROWS_PER_IDLE_TURN", 8)
    shop = make()
    client, other = shop.connect(), shop.connect()
    shop.load(client)
    shop.run(150)
    turned = {"X": [-value for value in shop_module.OFFSET[0]], "Y": [0] * len(shop_module.OFFSET[0])}
    sealed = correction_table.seal_table(
        correction_table.encode_table("XY", dict(zip("XY", shop_module.DEMAND, strict=True)), turned, DIGEST)
    )
    socket.send_fds(other, [b'{"request": "table"}\n'], [sealed])
    os.close(sealed)
    shop.serve()
    assert shop.guard.intake.busy
    assert shop.ask(client, arm_line())["ok"]
    assert shop.answer(other)["code"] == "TableBusy"
    path = shop.guard.intake.path
    assert path is not None
    assert list(path.offset[0]) == list(shop_module.OFFSET[0])


def test_stopping_guard_refuses_to_arm(make: Make) -> None:
    shop = make()
    client = shop.connect()
    shop.load(client)
    shop.run(150)
    shop.stop.send(b"\x0f")
    shop.serve()
    client.send(arm_line() + b"\n")
    shop.serve()
    assert shop.answer(client, syncing=False)["code"] == "Stopped"
    client.send(b'{"request": "disarm"}\n')
    shop.serve()
    assert shop.answer(client)["ok"]  # a disarm is heard, and the stop still waits before it
    assert (shop.state, shop.guard.run()) == ("OFF", 0)


@pytest.mark.usefixtures("real_time")
def test_pending_arm_request_is_refused_at_a_stop(make: Make) -> None:
    shop = make()
    arming, disarming = shop.connect(), shop.connect()
    shop.load(arming)
    shop.run(150)
    disarming.send(b'{"request": "disarm"}\n')
    shop.serve()
    arming.send(arm_line() + b"\n")
    shop.serve()
    shop.stop.send(b"x")
    assert shop.answer(arming, syncing=False)["code"] == "Stopped"
    assert shop.answer(disarming)["ok"]
    assert (shop.state, shop.guard.run()) == ("OFF", 0)
    assert "ARMED" not in {event.get("state") for event in shop.events()}


def test_journal_names_the_client_that_disarmed(make: Make) -> None:
    shop = make()
    client = shop.into_the_cut()
    assert shop.ask(client, {"request": "disarm"})["ok"]
    shop.run(200)
    states = [event for event in shop.events() if event["event"] == "state"]
    assert [(event["state"], event.get("pid")) for event in states[-2:]] == [("RAMP_DOWN", os.getpid()), ("OFF", None)]


@pytest.mark.fault("E2")
def test_rows_beyond_a_limit_are_refused_with_its_class(make: Make) -> None:
    shop = make()
    client = shop.connect()
    demand, steep = dict.fromkeys("XY", [0] * 100), {"X": [0] * 100, "Y": [0] * 50 + [800] * 50}
    sealed = correction_table.seal_table(correction_table.encode_table("XY", demand, steep, DIGEST))
    assert shop.ask(client, {"request": "table"}, sealed)["code"] == "OffsetRate"
    os.close(sealed)
    assert shop.ask(client, {"request": "status"})["rows"] is None


def test_boot_up_is_reported_and_needs_a_comparison(make: Make) -> None:
    shop = make()
    client = shop.connect()
    shop.run(60)
    shop.wire.feed([(0x701, b"\x00", 0.0)])
    shop.run(5)
    assert [event["axis"] for event in shop.events() if event["event"] == "record_void"] == ["X"]
    asked = {"request": "compared", "axes": {"X": ["no text"], "Z": "none of these"}}
    assert "AuthRequired" in str(shop.ask(client, asked))
    assert shop.ask(client, {"request": "status"})["touched"] == {"X": 1, "Y": 0}
    asked = {"request": "compared", "token": TOKEN, "axes": {"X": RECORD}, "touched": {"X": 0}}
    assert shop.ask(client, asked)["code"] == "RecordVoid"
    assert shop.ask(client, {**asked, "touched": {"X": 1}})["ok"]
    law = {**LAW._asdict(), "dry": 1.5}
    wrongs: list[dict[str, Any]] = [
        {"X": LAW._asdict()},
        {"X": law, "Y": law},
        {"X": 1, "Y": [law]},
        {"X": {"speed": []}, "Y": {}},
    ]
    for wrong in wrongs:
        answer = shop.ask(client, {"request": "feedforward", "token": TOKEN, "laws": wrong, "facts": FACTS})
        assert "FeedforwardOff" in str(answer["refused"])


# --- connections ---


@pytest.fixture
def client_rig(tmp_path: Path) -> Iterator[GuardSocketServer]:
    made = GuardSocketServer(tmp_path, GuardAccess(), assert_no_refusals)
    yield made
    made.close()


def assert_no_refusals(peer: ClientProcess, request: object) -> None:
    raise AssertionError(f"{peer} asked for {request}")


def connected(service: GuardSocketServer, now_s: float = 0.0) -> socket.socket:
    client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    client.connect(str(service.path))
    assert service.serve_one_client({service.fileno()}, now_s) is None
    return client


def serve(service: GuardSocketServer, now_s: float = 1.0) -> list[dict[str, Any]]:
    served = []
    for _ in range(50):
        found = service.serve_one_client({client.fileno() for client in service.clients}, now_s)
        if found is not None:
            served.append(found[1])
            found[0].close_unclaimed_descriptor()
        service.drop_gone()
    return served


def test_each_turn_serves_one_request_in_client_order(client_rig: GuardSocketServer) -> None:
    with connected(client_rig) as one, connected(client_rig) as other:
        one.send(b'{"n": 1}\n{"n": 2}\n{"n":')
        other.send(b'{"n": 10}\n')
        ready = {client.fileno() for client in client_rig.clients}
        found = [
            client_rig.serve_one_client(ready, 1.0),
            client_rig.serve_one_client(ready, 1.0),
            client_rig.serve_one_client(set(), 1.0),
            client_rig.serve_one_client(set(), 1.0),
        ]
        assert [None if each is None else each[1]["n"] for each in found] == [1, 10, 2, None]
        assert not client_rig.pending


def test_idle_connections_are_closed_except_the_one_that_armed(client_rig: GuardSocketServer) -> None:
    idle = [connected(client_rig, float(k)) for k in range(MAX_CLIENTS)]
    client_rig.clients[0].armed = True
    with connected(client_rig, 99.0):
        client_rig.drop_gone()
        assert len(client_rig.clients) == MAX_CLIENTS
        assert client_rig.clients[0].armed
        assert idle[1].recv(1) == b""  # silent for longest, but for the one that armed
    for each in idle:
        each.close()


def test_client_with_an_endless_line_or_a_hang_up_is_dropped(client_rig: GuardSocketServer) -> None:
    with connected(client_rig) as long:
        long.setblocking(False)
        for _ in range(2):
            long.send(b"x" * (MAX_LINE_BYTES // 2 + 10))
            serve(client_rig)
        assert client_rig.clients == []
    connected(client_rig).close()
    serve(client_rig)
    assert client_rig.clients == []


@pytest.mark.fault("F11")
def test_client_that_does_not_read_answers_is_not_served(client_rig: GuardSocketServer) -> None:
    with connected(client_rig) as client:
        client.send(b'{"n": 1}\n{"n": 2}\n')
        ready = {each.fileno() for each in client_rig.clients}
        found = client_rig.serve_one_client(ready, 1.0)
        assert found is not None
        found[0].queue_reply({"id": 1}, text="x" * 1_000_000)
        assert found[0].outbox
        assert not client_rig.pending
        assert [client_rig.serve_one_client(ready, 1.0) for _ in range(5)] == [None] * 5
        served: list[dict[str, Any]] = []
        while not served:
            client.recv(1 << 20)
            served = serve(client_rig)
        assert [document["n"] for document in served] == [2]
    client_rig.clients[0].outbox += b"x"
    client_rig.clients[0].flush_replies()
    assert client_rig.clients[0].gone


def test_unclaimed_descriptors_are_closed(client_rig: GuardSocketServer) -> None:
    def count() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    with connected(client_rig) as client:
        before = count()
        ends = os.pipe()
        socket.send_fds(client, [b'{"n": 1}\n{"n"'], [ends[0]] * 100)
        socket.send_fds(client, [b": 2}\n"], [ends[1]])
        assert [document["n"] for document in serve(client_rig)] == [1, 2]
        socket.send_fds(client, [b'{"n": 3'], [ends[0]])
        serve(client_rig)
        os.close(ends[0])
        os.close(ends[1])
        assert client_rig.clients[0].descriptor is not None
    serve(client_rig)
    client_rig._closer.finish_closing()
    assert client_rig._closer._thread is not None
    client_rig._closer._thread.join(60.0)  # end() waits a moment only
    assert count() == before - 2  # both ends of the client's connection


def test_unusable_run_directory_is_reported_in_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match="nothing is sent"):
        GuardSocketServer(tmp_path / "missing", GuardAccess(), assert_no_refusals)


def test_accept_after_a_hang_up_is_ignored(client_rig: GuardSocketServer) -> None:
    client_rig._accept_client(0.0)
    assert client_rig.clients == []


def test_answer_to_a_disconnected_client_is_dropped() -> None:
    near, far = socket.socketpair()
    far.close()
    closer = DescriptorCloser()
    client = GuardSocketClient(near, 0.0, closer, OWNER)
    client.queue_reply({}, ok=True)
    assert client.gone
    client.close()
    client._receive_bytes()  # its socket is no more
    assert client.gone
    closer.close_later(1 << 20)
    closer.finish_closing()


def test_lingering_socket_is_closed_at_once() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        near = socket.create_connection(server.getsockname())
        near.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 30_000))
        near.setblocking(False)
        while select.select((), [near], (), 0.0)[1]:
            near.send(bytes(1 << 16))
        here, there = os.pipe()
        closer = DescriptorCloser()
        closer.close_later(near.detach())
        closer.close_later(there)
        assert os.read(here, 1) == b""  # the pipe's other end is closed
        closer.finish_closing()
        os.close(here)


# --- journal and systemd ---


def test_full_notify_queue_does_not_stop_the_watchdog(tmp_path: Path) -> None:
    address = str(tmp_path / "notify")
    systemd = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    systemd.bind(address)
    systemd.setblocking(False)
    notifier = SystemdNotifier(address)
    sent = 0
    while not notifier._pending:
        notifier.notify_systemd(f"STATUS={sent}")
        sent += 1
    notifier.notify_systemd("READY=1")
    for now_s in (1.0, 1.2, 2.0, 3.0):
        notifier.feed_watchdog(now_s)
    got = [systemd.recv(100).decode() for _ in range(sent - 1)]
    assert got == [f"STATUS={k}" for k in range(sent - 1)]
    notifier.feed_watchdog(4.0)
    assert [systemd.recv(100).decode() for _ in range(3)] == [f"STATUS={sent - 1}", "READY=1", "WATCHDOG=1"]
    systemd.close()
    (tmp_path / "notify").unlink()
    notifier.feed_watchdog(5.0)
    again = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    again.bind(address)
    notifier.feed_watchdog(6.0)
    assert again.recv(100) == b"WATCHDOG=1"
    notifier.close()
    notifier.feed_watchdog(7.0)
    again.close()


def test_notifier_works_without_a_unit_and_with_an_abstract_address(tmp_path: Path) -> None:
    name = f"fdhil-test-{tmp_path.name}-{os.getpid()}"
    silent = SystemdNotifier(None)
    silent.feed_watchdog(10.0)
    silent.close()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(f"\0{name}")
        notifier = SystemdNotifier(f"@{name}")
        notifier.notify_systemd("STATUS=\ud800")
        assert systemd.recv(100) == b"STATUS=?"
        notifier.close()


def test_unread_journal_drops_lines_without_blocking() -> None:
    read, write = os.pipe()
    journal = EventJournal(write)
    for _ in range(100):
        journal.write("long", text="\u20ac" * 4000)
    assert 0 < journal.dropped < 100
    lines = os.read(read, 1 << 20).splitlines()
    assert all(json.loads(line)["text"] == "\u20ac" * 500 for line in lines)
    os.close(read)
    journal.write("gone")
    assert len(journal.recent) == 32
    os.close(write)
