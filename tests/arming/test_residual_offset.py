"""A residual offset is always reported: by the link, the daemon and its commands, also without a guard."""

from __future__ import annotations

import io
import json
import os
import socket
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from fdhil import config as machine_config
from fdhil.arming import residual_offset
from fdhil.arming.arming_service import ArmingService
from fdhil.arming.guard_link import GuardLink
from fdhil.arming.operator_token import ensure_token, read_token
from fdhil.arming.residual_offset_file import FILE_NAME, ResidualOffsetFile
from fdhil.config import MachineConfig
from fdhil.daemon.daemon_socket import ask_daemon
from fdhil.daemon.outcome_store import OutcomeStore
from fdhil.errors import ConnectError, DeviceError
from fdhil.store import audit_file
from tests.arming.guard_peer import GuardPeer
from tests.daemon.machine_rig import BENCH, fdhil
from tests.daemon.simulated_machine import SimulatedMachine, config_of
from tests.machine.virtual_time import ImpatientClock

OFF: Mapping[str, Any] = {"ok": True, "state": "OFF", "cause": None, "may_stand_um": {"X": 0.0, "Y": 0.0}}
ACTIVE = {**OFF, "state": "ACTIVE", "may_stand_um": {"X": -38.0, "Y": 0.0}}
CAUSE = {"code": "BusOff", "text": "the CAN controller is bus-off", "axis": ""}
FROZEN = {**OFF, "state": "FROZEN", "cause": CAUSE, "may_stand_um": {"X": -4.6, "Y": None}}
STANDS = "-4.6 um on axis X and an unknown offset on axis Y may still be applied"


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    path = tmp_path / "machine.toml"
    path.write_text(BENCH)
    run = tmp_path / "fdhil-data" / "run"
    run.mkdir(parents=True)
    ensure_token(run)
    return path


@pytest.fixture
def folder(machine: Path) -> Path:
    return machine.parent / "fdhil-data" / "run"


@pytest.fixture
def guard(folder: Path) -> Iterator[GuardPeer]:
    made = GuardPeer(folder)
    made.says = lambda _kind: OFF
    yield made
    made.close()


@pytest.fixture
def config(tmp_path: Path) -> MachineConfig:
    return config_of(tmp_path, ("X", "Y"))


@pytest.mark.parametrize(
    ("status", "nothing", "text"),
    [
        (residual_offset.ABSENT, True, "there was no guard, nothing was sent"),
        (OFF, True, "offset 0"),
        ({"state": "OFF"}, False, "an unknown offset may still be applied"),
        ({"state": "OFF", "may_stand_um": {}}, False, "an unknown offset may still be applied"),
        ({"state": "OFF", "may_stand_um": {"X": None}}, False, "an unknown offset on axis X may still be applied"),
        ({"state": "OFF", "may_stand_um": {"X": float("nan")}}, False, "an unknown offset on axis X"),
        ({"state": "OFF", "may_stand_um": {"X": False}}, False, "an unknown offset on axis X"),
        ({"state": "FROZEN", "may_stand_um": {"X": 0.04}}, False, "+0.04 um on axis X may still be applied"),
        (FROZEN, False, STANDS),
        ({**OFF, "state": "ACTIVE"}, False, "an unknown offset on axis X, Y may still be applied"),
        ({**OFF, "feedforward": {"state": "OFF", "applied": {"X": [0, 0]}, "cause": None}}, True, "offset 0"),
        ({**OFF, "feedforward": {"state": "ZEROING", "applied": {"X": [0, 0]}}}, False, "speed and torque offsets on"),
        (
            {**OFF, "feedforward": {"state": "OFF", "applied": {"X": [0, 3]}}},
            False,
            "speed and torque offsets on axis X",
        ),
        (
            {**OFF, "feedforward": {"state": "OFF", "applied": {"X": [0, 0]}, "confirmed": False}},
            False,
            "speed and torque offsets on axis X may still be applied",
        ),
    ],
)
def test_only_reported_zero_counts_as_no_offset(status: Mapping[str, Any], nothing: bool, text: str) -> None:
    stands = residual_offset.read_residual_offset(status)
    assert stands.is_zero is nothing
    assert text in str(stands)


def test_residual_offset_of_dead_guard_stays_until_adopted(guard: GuardPeer, folder: Path) -> None:
    guard.says = lambda _kind: ACTIVE
    link = GuardLink(folder, folder)
    link.poll_changes()
    guard.close()
    reported = link.poll_changes()
    expected = "-38 um on axis X and an unknown offset on axis Y may still be applied"
    assert [(n.code, n.severity, expected in n.text) for n in reported] == [("GuardLost", "MAJOR", True)]
    assert "run fdhil adopt" in reported[0].text
    assert (link.state, str(link.residual_offset), link.poll_changes()) == ("lost", expected, [])
    assert "nothing is sent" not in json.dumps(link.status)
    (folder / "guard.sock").unlink()
    back = GuardPeer(folder)
    back.says = lambda _kind: {**OFF, "may_stand_um": {"X": None, "Y": None}}
    assert [(n.code, n.severity) for n in link.poll_changes()] == [("GuardFound", "minor")]
    assert str(link.residual_offset) == "an unknown offset on axis X, Y may still be applied"
    back.says = lambda _kind: OFF
    assert [(n.code, n.severity, n.text) for n in link.poll_changes()] == [("GuardState", "info", "OFF; offset 0")]
    assert link.residual_offset.is_zero
    back.close()
    assert [(n.code, n.severity) for n in link.poll_changes()] == [("GuardLost", "minor")]
    assert (link.state, str(link.residual_offset)) == ("absent", "offset 0")
    link.close()


def test_guard_lost_while_arming_may_have_armed(guard: GuardPeer, folder: Path) -> None:
    link = GuardLink(folder, folder)
    link.poll_changes()

    def dies(kind: str) -> Mapping[str, Any]:
        if kind != "status":
            raise ConnectionError
        return OFF

    guard.says = dies
    with pytest.raises(DeviceError):
        link.enable_feedforward(LawOfAxis(), "token", lambda: False, None)  # type: ignore[arg-type]
    assert str(link.residual_offset) == "an unknown offset on axis X, Y may still be applied"
    link.close()


class LawOfAxis:
    laws: Mapping[str, Any] = {}
    facts: Mapping[str, bool] = {}


@pytest.mark.parametrize("kept", ["", "[1]", '{"X": [], "Y": NaN}', f'{{"X": 1{"0" * 400}}}', "{" * 100_000])
def test_next_daemon_reads_residual_offset_from_store(tmp_path: Path, folder: Path, kept: str) -> None:
    guard = GuardPeer(folder)
    guard.says = lambda kind: OFF if kind == "status" else {**OFF, "ok": True}
    link = GuardLink(folder, tmp_path)
    link.poll_changes()
    assert not (tmp_path / FILE_NAME).exists()
    guard.says = lambda _kind: {**ACTIVE, "ok": True}
    assert link.enable_feedforward(LawOfAxis(), "token", lambda: False, None)["ok"]  # type: ignore[arg-type]
    guard.close()
    link.close()  # as a kill does
    (folder / "guard.sock").unlink()
    if kept:
        (tmp_path / FILE_NAME).write_text(kept)
    after = GuardLink(folder, tmp_path)
    assert (after.state, after.residual_offset.is_zero) == ("lost", False)
    reported = after.poll_changes()
    assert [(n.code, n.severity, "an unknown offset" in n.text) for n in reported] == [("GuardLost", "MAJOR", True)]
    assert "start fdhil-guard, then run fdhil adopt" in reported[0].text
    assert after.poll_changes() == []
    assert "an unknown offset" in after.status["text"]
    found = GuardPeer(folder)
    found.says = lambda _kind: OFF
    assert [(n.code, n.severity) for n in after.poll_changes()] == [("GuardFound", "info")]
    assert after.residual_offset.is_zero
    found.close()
    (folder / "guard.sock").unlink()
    assert [(n.code, n.severity) for n in after.poll_changes()] == [("GuardLost", "minor")]
    assert GuardLink(folder, tmp_path).state == "absent"


@pytest.mark.timeout(60)
def test_pipe_in_place_of_file_does_not_block_start(tmp_path: Path, folder: Path) -> None:
    os.mkfifo(tmp_path / FILE_NAME)
    after = GuardLink(folder, tmp_path)
    assert (after.state, str(after.residual_offset)) == ("lost", "an unknown offset may still be applied")


def test_frozen_offset_is_reported_by_next_daemon(tmp_path: Path, folder: Path) -> None:
    guard = GuardPeer(folder)
    guard.says = lambda _kind: {**FROZEN, "feedforward": {"state": "ON", "applied": {"Z": [1, 0]}}}
    link = GuardLink(folder, tmp_path)
    link.poll_changes()
    guard.close()
    link.close()
    stands = "-4.6 um on axis X and an unknown offset on axis Y, Z may still be applied"
    assert str(GuardLink(folder, tmp_path).residual_offset) == stands


async def test_disarm_is_ok_only_at_zero(config: MachineConfig, guard: GuardPeer, folder: Path) -> None:
    ramp = iter([{**ACTIVE, "state": "RAMP_DOWN"}] * 3)
    guard.says = lambda kind: OFF if kind == "disarm" else next(ramp, OFF)
    service = ArmingService(config, OutcomeStore(config), folder)
    assert await service.disarm() == {
        "ok": True,
        "text": "guard: OFF, offset 0",
        "state": "OFF",
        "may_stand_um": {"X": 0.0, "Y": 0.0},
    }
    guard.says = lambda _kind: FROZEN
    answer = await service.disarm()
    assert (answer["ok"], answer["code"], answer["state"]) == (False, "OffsetStands", "FROZEN")
    assert answer["text"] == f"the guard is FROZEN (the CAN controller is bus-off): {STANDS}"
    assert "run fdhil adopt" in answer["advice"]
    service.guard.close()


async def test_disarm_without_zero_is_refused(config: MachineConfig, guard: GuardPeer, folder: Path) -> None:
    guard.says = lambda _kind: {**ACTIVE, "state": "RAMP_DOWN"}
    service = ArmingService(config, OutcomeStore(config), folder, ImpatientClock())
    answer = await service.disarm()
    assert (answer["ok"], answer["state"]) == (False, "RAMP_DOWN")
    assert "-38 um on axis X" in answer["text"]
    guard.close()
    answer = await service.disarm()
    assert (answer["ok"], answer["code"]) == (False, "OffsetStands")
    assert "-38 um on axis X" in answer["text"]
    assert "start fdhil-guard" in answer["advice"]


async def test_arming_frozen_guard_advises_adopt(
    config: MachineConfig, guard: GuardPeer, folder: Path, tmp_path: Path
) -> None:
    guard.says = lambda _kind: FROZEN
    service = ArmingService(config, OutcomeStore(config), folder)
    service.start_from_history({}, [])
    request = {"request": "arm", "program": str(tmp_path / "a.ngc"), "token": read_token(folder)}
    answer = await service.arm(request)
    assert (answer["ok"], answer["code"]) == (False, "OffsetStands")
    assert STANDS in answer["text"]
    assert answer["advice"] == "hold the feed, then run fdhil adopt, then arm again"
    service.guard.close()


def run_daemon(machine: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any, meanwhile: Any) -> tuple[int, str]:
    monkeypatch.setattr("fdhil.daemon.daemon_service.compile_kernels", lambda config, method: None)
    monkeypatch.setattr("fdhil.drivers.open_machine", SimulatedMachine().open)
    path = machine.parent / "fdhil-data" / "run" / "daemon.sock"

    def stop() -> None:
        reported: dict[str, Any] = {}
        while not reported:
            try:
                reported = ask_daemon(path, {"request": "status"})
            except ConnectError:
                threading.Event().wait(0.02)
        meanwhile(path)
        ask_daemon(path, {"request": "stop"})

    thread = threading.Thread(target=stop)
    thread.start()
    code, _, err = fdhil("run", machine, capsys=capsys)
    thread.join()
    return code, err


def wait_for_status(path: Path, ready: Any) -> dict[str, Any]:
    while not ready(reported := ask_daemon(path, {"request": "status"})):
        threading.Event().wait(0.02)
    return reported


def test_run_exits_zero_only_if_guard_reports_zero(
    machine: Path, guard: GuardPeer, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    code, err = run_daemon(
        machine, monkeypatch, capsys, lambda p: wait_for_status(p, lambda s: s["guard"]["state"] == "OFF")
    )
    assert (code, err.splitlines()[-1].endswith("stopped, offset 0")) == (0, True)
    guard.says = lambda _kind: FROZEN
    code, err = run_daemon(
        machine, monkeypatch, capsys, lambda p: wait_for_status(p, lambda s: s["guard"]["state"] != "absent")
    )
    assert code == 3
    assert err.splitlines()[-1].endswith(f"stopped, {STANDS}; hold the feed, then run fdhil adopt")


def test_run_without_guard_exits_nonzero_with_residual_offset(
    machine: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    store = machine_config.load_config(machine).store.directory
    ResidualOffsetFile(store).store(residual_offset.read_residual_offset(FROZEN))
    reported: dict[str, Any] = {}
    code, err = run_daemon(
        machine, monkeypatch, capsys, lambda p: reported.update(wait_for_status(p, lambda s: s["notices"]))
    )
    assert code == 3
    assert (reported["state"], reported["may_stand"]) == ("lost", {"nothing": False, "text": STANDS})
    assert [(n["code"], n["severity"]) for n in reported["notices"]] == [("GuardLost", "MAJOR")]
    assert err.splitlines()[-1].endswith(f"stopped, {STANDS}; hold the feed, start fdhil-guard, then run fdhil adopt")


def test_run_after_guard_death_reports_residual_offset(
    machine: Path, guard: GuardPeer, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    guard.says = lambda _kind: ACTIVE
    reported: dict[str, Any] = {}

    def dies(path: Path) -> None:
        wait_for_status(path, lambda s: s["state"] == "ACTIVE")
        guard.close()
        reported.update(wait_for_status(path, lambda s: s["state"] == "lost"))
        reported["disarm"] = fdhil("disarm", machine, capsys=capsys)

    code, err = run_daemon(machine, monkeypatch, capsys, dies)
    stands = "-38 um on axis X and an unknown offset on axis Y may still be applied"
    assert code == 3
    assert reported["may_stand"] == {"nothing": False, "text": stands}
    assert "nothing is sent" not in json.dumps(reported["guard"])
    assert reported["disarm"][0] == 1
    assert stands in reported["disarm"][2]
    assert stands in err.splitlines()[-1]


def test_adopt_shows_offset_confirms_and_reaches_zero(
    machine: Path, guard: GuardPeer, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    now = [FROZEN, {**FROZEN, "state": "ADOPT"}, {**FROZEN, "state": "ADOPT"}, OFF]
    guard.says = lambda kind: {"ok": True} if kind == "adopt" else now.pop(0) if len(now) > 1 else now[0]
    for message in ("n\n", ""):  # no, and nobody who could say it
        monkeypatch.setattr("sys.stdin", io.StringIO(message))
        code, _, err = fdhil("adopt", machine, capsys=capsys)
        assert (code, guard.heard) == (3, ["status"])
        assert f"the guard is FROZEN: {STANDS}" in err
        assert f"not confirmed; nothing was sent; {STANDS}; hold the feed and run it again" in err
        guard.heard.clear()
        now.insert(0, FROZEN)
    monkeypatch.setattr("click.termui.visible_prompt_func", lambda _text: "y")
    code, out, _ = fdhil("adopt", machine, capsys=capsys)
    assert (code, out) == (0, "guard: OFF, offset 0\n")
    assert guard.heard[1] == "adopt"
    assert read_audit(machine) == [("adopt", None), ("adopt", "done")]
    code, out, _ = fdhil("adopt", machine, "--yes", capsys=capsys)
    assert (code, out) == (0, "guard: OFF, offset 0; there is nothing to adopt\n")
    assert guard.heard.count("adopt") == 1


def read_audit(machine: Path) -> list[tuple[str, str | None]]:
    found = audit_file.read_entries(machine_config.load_config(machine).store.directory)
    return [(entry.get("asked") or entry["answered"], entry.get("result")) for entry, wrong in found if wrong is None]


@pytest.mark.fault("F5")
def test_disk_error_does_not_prevent_adoption(machine: Path, guard: GuardPeer, capsys: Any) -> None:
    folder = machine_config.load_config(machine).store.directory
    (folder / audit_file.AUDIT_FILE_NAME).mkdir(parents=True)
    now = [FROZEN, OFF]
    guard.says = lambda kind: {"ok": True} if kind in ("adopt", "disarm") else now.pop(0) if len(now) > 1 else now[0]
    code, out, err = fdhil("adopt", machine, "--yes", capsys=capsys)
    assert (code, out) == (0, "guard: OFF, offset 0\n")
    assert err.count("adopt is not in the audit: ") == 2
    code, out, err = fdhil("disarm", machine, capsys=capsys)
    assert (code, "disarm at the guard is not in the audit" in err) == (0, True)
    (folder / audit_file.AUDIT_FILE_NAME).rmdir()
    assert fdhil("disarm", machine, capsys=capsys)[0] == 0
    assert read_audit(machine) == [("disarm at the guard", "done")]


@pytest.mark.fault("F5")
def test_hanging_disk_delays_adoption_only_briefly(
    machine: Path, guard: GuardPeer, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    answers = threading.Event()
    append = audit_file.append_entry

    def slow(folder: Path, entry: dict[str, Any]) -> None:
        if threading.current_thread() is not threading.main_thread():  # that before the adoption
            answers.wait()
        append(folder, entry)

    monkeypatch.setattr(audit_file, "append_entry", slow)
    monkeypatch.setattr("fdhil.cli.audit_hook.DISK_S", 0.05)
    now = [FROZEN, OFF]
    guard.says = lambda kind: {"ok": True} if kind == "adopt" else now.pop(0) if len(now) > 1 else now[0]
    code, out, err = fdhil("adopt", machine, "--yes", capsys=capsys)
    answers.set()
    assert (code, out) == (0, "guard: OFF, offset 0\n")
    assert "adopt is not in the audit: the disk does not answer" in err


def test_adopt_without_zero_exits_1_with_cause(machine: Path, guard: GuardPeer, capsys: Any) -> None:
    reason = {"code": "StaleData", "axis": "X", "text": "axis X: its offset was not read yet", "advice": "wait"}
    second = {**reason, "code": "RecordVoid", "text": "the record is void"}
    no = {"ok": False, "state": "FROZEN", **reason, "refused": [reason, second]}
    guard.says = lambda kind: no if kind == "adopt" else FROZEN
    code, out, err = fdhil("adopt", machine, "--yes", capsys=capsys)
    assert (code, out) == (1, "")
    assert "refused: StaleData: axis X: its offset was not read yet; wait" in err
    assert "also: RecordVoid: the record is void; wait" in err
    guard.says = lambda _kind: FROZEN
    code, out, _ = fdhil("adopt", machine, "--yes", "--json", capsys=capsys)
    assert (code, json.loads(out)["may_stand_um"]) == (1, {"X": -4.6, "Y": None})
    guard.says = lambda _kind: ACTIVE
    code, _, err = fdhil("adopt", machine, "--yes", capsys=capsys)
    assert (code, "run fdhil disarm" in err) == (1, True)
    assert fdhil("adopt", machine, "--json", capsys=capsys)[0] == 2


def test_adopt_without_guard_exits_3(machine: Path, capsys: Any) -> None:
    code, _, err = fdhil("adopt", machine, "--yes", capsys=capsys)
    assert (code, "start fdhil-guard" in err) == (3, True)


def test_guard_with_own_run_directory_is_found(machine: Path, capsys: Any) -> None:
    machine.write_text(machine.read_text().replace("[guard]", '[guard]\nrun_directory = "guards"'))
    (machine.parent / "guards").mkdir()
    guard = GuardPeer(machine.parent / "guards")
    guard.says = lambda _kind: OFF
    assert fdhil("disarm", machine, capsys=capsys)[0] == 0
    assert fdhil("adopt", machine, "--yes", capsys=capsys)[0] == 0
    guard.close()


def test_disarm_with_hanging_daemon_asks_the_guard(
    machine: Path, folder: Path, guard: GuardPeer, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setattr("fdhil.cli.daemon_commands.DISARM_S", 0.05)
    with socket.socket(socket.AF_UNIX) as hung:
        hung.bind(str(folder / "daemon.sock"))
        hung.listen()
        code, out, _ = fdhil("disarm", machine, "--json", capsys=capsys)
    assert (code, json.loads(out)["asked"], guard.heard) == (0, "guard", ["disarm", "status"])


def test_disarm_without_daemon_asks_the_guard(machine: Path, guard: GuardPeer, capsys: Any) -> None:
    code, out, _ = fdhil("disarm", machine, capsys=capsys)
    assert (code, out, guard.heard) == (0, "guard: OFF, offset 0\n", ["disarm", "status"])
    guard.says = lambda _kind: FROZEN
    code, _, err = fdhil("disarm", machine, capsys=capsys)
    assert (code, STANDS in err, "run fdhil adopt" in err) == (1, True, True)
    guard.close()
    code, _, err = fdhil("disarm", machine, capsys=capsys)
    assert (code, "the applied offset is unknown" in err) == (3, True)
