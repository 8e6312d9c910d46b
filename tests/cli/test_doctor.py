"""``fdhil doctor`` lists each planted problem first."""

from __future__ import annotations

import json
import socket
import sqlite3
import stat
import subprocess
import sys
import uuid
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from fdhil import config as machine_config
from fdhil.cli.demo.toml_writer import format_toml
from fdhil.cli.doctor import doctor
from fdhil.records import Notice
from fdhil.store.history_database import HISTORY_FILE_NAME, History
from fdhil.store.history_rows import TimeStamp
from tests.bench import bench_document
from tests.drivers.peer import DrivePeer
from tests.short_waits import shorten_waits
from tests.unprivileged_command import UNPRIVILEGED


@pytest.fixture(autouse=True)
def short_timeouts(virtual_threads: object, monkeypatch: pytest.MonkeyPatch) -> None:
    """Use shorter waits, and a PC without other load."""
    shorten_waits(monkeypatch, {"drivers.can.sdo_channel.RESPONSE_TIMEOUT_S": 0.2})
    monkeypatch.setattr("os.getloadavg", lambda: (0.1, 0.1, 0.1))
    monkeypatch.setattr("fdhil.cli.doctor.computer.GOVERNOR", Path("/none"))


class PcSetup:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.store = folder / "store"
        self.bus: dict[str, Any] = {"interface": "virtual", "channel": uuid.uuid4().hex}
        self.document = bench_document("X")
        del self.document["axis"]["X"]["correction"]
        self.document["store"] = {"directory": str(self.store)}

    @property
    def axis(self) -> dict[str, Any]:
        axis = self.document["axis"]["X"]
        assert isinstance(axis, dict)
        return axis

    @property
    def run_directory(self) -> Path:
        return self.store / "run"

    def write_config(self) -> Path:
        path = self.folder / "machine.toml"
        path.write_text(format_toml({**self.document, "bus": {"can0": self.bus}}), "utf-8")
        return path

    def start_peer(self) -> DrivePeer:
        return DrivePeer(machine_config.load_config(self.write_config()))

    def run_doctor(self, *options: str) -> tuple[int, list[dict[str, Any]]]:
        result = CliRunner().invoke(doctor, [str(self.write_config()), "--json", *options], standalone_mode=False)
        assert result.exception is None, result.exception
        document = json.loads(result.stdout)
        assert document["schema"] == "fdhil-doctor-1"
        return int(result.return_value), document["troubles"]


@pytest.fixture
def pc_setup(tmp_path: Path) -> PcSetup:
    made = PcSetup(tmp_path)
    made.run_directory.mkdir(parents=True, mode=0o700)
    return made


def replace_store_by_file(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    (pc.folder / "occupied").write_text("x")
    pc.document["store"]["directory"] = str(pc.folder / "occupied" / "store")


def make_store_read_only(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    # root can write everywhere
    patch.setattr("fdhil.cli.doctor.storage.can_write", lambda _: False)


def fill_disk(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    patch.setattr("fdhil.cli.doctor.storage.LEAST_FREE_BYTES", 1 << 60)


def damage_history(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    (pc.store / HISTORY_FILE_NAME).write_bytes(b"no database" * 1000)


def write_newer_history(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    History.open(pc.store).close()
    with sqlite3.connect(pc.store / HISTORY_FILE_NAME) as db:
        db.execute("PRAGMA user_version = 99")
    db.close()


def reset_clock(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    patch.setattr("time.time", lambda: 0.0)


def set_clock_back(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    with History.open(pc.store) as history:
        now = TimeStamp.now()
        history.add_notice(Notice("SyncLost", "info", "SYNC is back."), replace(now, wall_s=now.wall_s + 86400))


def remove_port(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    pc.bus = {"interface": "socketcand", "port": 0}


def stop_hub(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        pc.bus = {"interface": "socketcand", "port": free.getsockname()[1]}


def disable_can_kernel(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    pc.bus = {"interface": "socketcan", "channel": "can9"}
    patch.setattr("fdhil.cli.doctor.computer._can_open_socket", lambda: False)


def fake_can_interface(
    pc: PcSetup, patch: pytest.MonkeyPatch, flags: str | None, details: dict[str, Any] | None = None
) -> None:
    """Fake a CAN interface of the kernel and ``ip``; ``flags`` None: no interface."""
    pc.bus = {"interface": "socketcan", "channel": "can9", "bitrate": 500_000}
    patch.setattr("fdhil.cli.doctor.computer._can_open_socket", lambda: True)
    patch.setattr("fdhil.cli.doctor.computer.INTERFACES", pc.folder)
    if flags is not None:
        (pc.folder / "can9").mkdir()
        (pc.folder / "can9" / "flags").write_text(flags)
    tool = pc.folder / "ip"
    tool.write_text(f"#!/bin/sh\ncat <<'END'\n{json.dumps([{'linkinfo': {'info_data': details or {}}}])}\nEND\n")
    tool.chmod(0o755)
    patch.setattr("shutil.which", lambda name: str(tool))


def remove_adapter(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    fake_can_interface(pc, patch, None)


def set_interface_down(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    fake_can_interface(pc, patch, "0x80\n")


def set_bus_off(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    fake_can_interface(pc, patch, "0x81\n", {"state": "BUS-OFF", "bittiming": {"bitrate": 500_000}, "restart_ms": 100})


def set_error_passive(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    fake_can_interface(pc, patch, "0x81\n", {"state": "ERROR-PASSIVE"})


def change_bit_rate(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    fake_can_interface(pc, patch, "0x81\n", {"state": "ERROR-ACTIVE", "bittiming": {"bitrate": 250_000}})


def remove_drive(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    pc.axis["drive"] = {"node_id": 9}


def change_rated_current(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    pc.axis["drive"] = {"rated_current_a": 10.0}


def change_scale(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    pc.axis["drive"] = {"increments_per_rev": 4096}


def remove_sensor(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    pc.axis["voltage"] = {"source": "modbus", "host": "127.0.0.1", "port": 9, "timeout_s": 0.2}


def lengthen_socket_path(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    pc.document["store"]["run_directory"] = str(pc.folder / ("x" * 120))


def open_run_directory(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    pc.run_directory.chmod(stat.S_IMODE(0o777))


def open_token(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    (pc.run_directory / "token").write_text("secret")
    (pc.run_directory / "token").chmod(0o644)


def configure_correction(pc: PcSetup) -> None:
    pc.axis["correction"] = {"max_offset_um": 50.0}


def damage_record(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    configure_correction(pc)
    (pc.store / "commissioning-X.json").write_text("{}")


def start_silent_guard(pc: PcSetup, patch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(pc.run_directory / "guard.sock"))


PLANTED: dict[Callable[[PcSetup, pytest.MonkeyPatch], None], str] = {
    replace_store_by_file: "StoreNoFolder",
    make_store_read_only: "StoreReadOnly",
    fill_disk: "DiskFull",
    damage_history: "CorruptFile",
    write_newer_history: "SchemaVersion",
    reset_clock: "ClockNotSet",
    set_clock_back: "ClockBehind",
    remove_port: "NoPort",
    stop_hub: "HubAway",
    disable_can_kernel: "NoKernelCan",
    remove_adapter: "InterfaceMissing",
    set_interface_down: "InterfaceDown",
    set_bus_off: "BusOff",
    set_error_passive: "BusPassive",
    change_bit_rate: "BitrateDiffers",
    remove_drive: "DriveDiffers",
    change_rated_current: "RatedCurrentDiffers",
    change_scale: "ScaleDiffers",
    remove_sensor: "VoltageDiffers",
    lengthen_socket_path: "SocketPathLong",
    open_run_directory: "RunDirectoryOpen",
    open_token: "TokenOpen",
    damage_record: "RecordBad",
    start_silent_guard: "GuardSilent",
}


def test_correct_machine_has_no_problems(pc_setup: PcSetup) -> None:
    with pc_setup.start_peer():
        assert pc_setup.run_doctor() == (0, [])


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("plant", PLANTED, ids=lambda plant: plant.__name__)
def test_planted_problem_is_listed_first(
    plant: Callable[..., None], pc_setup: PcSetup, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pc_setup.start_peer():
        plant(pc_setup, monkeypatch)
        code, troubles = pc_setup.run_doctor()
    assert troubles[0]["code"] == PLANTED[plant], troubles
    assert code == 1
    assert all(troubles[0][part] for part in ("place", "what", "means", "mend"))


def test_minor_problems_come_last_and_exit_0(pc_setup: PcSetup, monkeypatch: pytest.MonkeyPatch) -> None:
    configure_correction(pc_setup)
    monkeypatch.setattr("os.getloadavg", lambda: (99.0, 99.0, 99.0))
    code, troubles = pc_setup.run_doctor("--offline")
    assert (code, [t["code"] for t in troubles]) == (0, ["BusyHost", "NotCommissioned"])


@pytest.mark.usefixtures("processes")
def test_unreadable_store_is_reported_and_rest_is_examined(pc_setup: PcSetup) -> None:
    pc_setup.document["store"]["run_directory"] = str(pc_setup.folder / "run")
    History.open(pc_setup.store).close()
    command = [
        *UNPRIVILEGED,
        sys.executable,
        "-m",
        "fdhil",
        "doctor",
        str(pc_setup.write_config()),
        "--json",
        "--offline",
    ]
    pc_setup.store.chmod(0)
    try:
        done = subprocess.run(command, capture_output=True, text=True)
    finally:
        pc_setup.store.chmod(0o700)
    assert (done.returncode, done.stderr) == (1, "")
    troubles = json.loads(done.stdout)["troubles"]
    assert {"StoreReadOnly", "NotSeen"} <= {trouble["code"] for trouble in troubles}
    assert any(str(pc_setup.store) in trouble["what"] and "sudo" in trouble["mend"] for trouble in troubles)


def test_offline_does_not_contact_hub(pc_setup: PcSetup) -> None:
    with socket.create_server(("127.0.0.1", 0)) as hub:
        pc_setup.bus = {"interface": "socketcand", "port": hub.getsockname()[1]}
        pc_setup.run_doctor("--offline")
        hub.setblocking(False)
        with pytest.raises(BlockingIOError):
            hub.accept()


def test_doctor_prints_readable_text(pc_setup: PcSetup) -> None:
    pc_setup.document["store"]["run_directory"] = str(pc_setup.folder / ("x" * 120))
    result = CliRunner().invoke(doctor, [str(pc_setup.write_config()), "--offline"], standalone_mode=False)
    assert "1. sockets: " in result.stdout
    assert "   fix:   choose a shorter [store] run_directory" in result.stdout
    assert "1 to fix, 0 to improve" in result.stdout
