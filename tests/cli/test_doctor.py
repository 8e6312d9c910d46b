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
from fdhil.cli.demo.toml import to_toml
from fdhil.cli.doctor import doctor
from fdhil.records import Notice
from fdhil.store.history_database import HISTORY_FILE_NAME, History
from fdhil.store.history_rows import TimeStamp
from tests.bench import bench_document
from tests.drivers.peer import DrivePeer
from tests.short_waits import shorten_waits
from tests.unprivileged_command import UNPRIVILEGED


@pytest.fixture(autouse=True)
def quick(virtual_threads: object, monkeypatch: pytest.MonkeyPatch) -> None:
    """Use shorter waits, and a PC without other load."""
    shorten_waits(monkeypatch, {"drivers.can.sdo_channel.RESPONSE_TIMEOUT_S": 0.2})
    monkeypatch.setattr("os.getloadavg", lambda: (0.1, 0.1, 0.1))
    monkeypatch.setattr("fdhil.cli.doctor.computer.GOVERNOR", Path("/none"))


class Pc:
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

    def write(self) -> Path:
        path = self.folder / "machine.toml"
        path.write_text(to_toml({**self.document, "bus": {"can0": self.bus}}), "utf-8")
        return path

    def peer(self) -> DrivePeer:
        return DrivePeer(machine_config.load_config(self.write()))

    def examined(self, *options: str) -> tuple[int, list[dict[str, Any]]]:
        result = CliRunner().invoke(doctor, [str(self.write()), "--json", *options], standalone_mode=False)
        assert result.exception is None, result.exception
        document = json.loads(result.stdout)
        assert document["schema"] == "fdhil-doctor-1"
        return int(result.return_value), document["troubles"]


@pytest.fixture
def pc(tmp_path: Path) -> Pc:
    made = Pc(tmp_path)
    made.run_directory.mkdir(parents=True, mode=0o700)
    return made


def store_is_a_file(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    (pc.folder / "occupied").write_text("x")
    pc.document["store"]["directory"] = str(pc.folder / "occupied" / "store")


def store_may_not_be_written(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    # root can write everywhere
    patch.setattr("fdhil.cli.doctor.storage.may_write", lambda _: False)


def little_room(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    patch.setattr("fdhil.cli.doctor.storage.LEAST_FREE_BYTES", 1 << 60)


def damaged_history(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    (pc.store / HISTORY_FILE_NAME).write_bytes(b"no database" * 1000)


def newer_history(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    History.open(pc.store).close()
    with sqlite3.connect(pc.store / HISTORY_FILE_NAME) as db:
        db.execute("PRAGMA user_version = 99")
    db.close()


def clock_never_set(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    patch.setattr("time.time", lambda: 0.0)


def clock_set_back(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    with History.open(pc.store) as history:
        now = TimeStamp.now()
        history.add_notice(Notice("SyncLost", "info", "SYNC is back."), replace(now, wall_s=now.wall_s + 86400))


def no_port(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    pc.bus = {"interface": "socketcand", "port": 0}


def hub_is_away(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        pc.bus = {"interface": "socketcand", "port": free.getsockname()[1]}


def kernel_without_can(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    pc.bus = {"interface": "socketcan", "channel": "can9"}
    patch.setattr("fdhil.cli.doctor.computer._opens_can", lambda: False)


def adapter(pc: Pc, patch: pytest.MonkeyPatch, flags: str | None, details: dict[str, Any] | None = None) -> None:
    """Fake a CAN interface of the kernel and ``ip``; ``flags`` None: no interface."""
    pc.bus = {"interface": "socketcan", "channel": "can9", "bitrate": 500_000}
    patch.setattr("fdhil.cli.doctor.computer._opens_can", lambda: True)
    patch.setattr("fdhil.cli.doctor.computer.INTERFACES", pc.folder)
    if flags is not None:
        (pc.folder / "can9").mkdir()
        (pc.folder / "can9" / "flags").write_text(flags)
    tool = pc.folder / "ip"
    tool.write_text(f"#!/bin/sh\ncat <<'END'\n{json.dumps([{'linkinfo': {'info_data': details or {}}}])}\nEND\n")
    tool.chmod(0o755)
    patch.setattr("shutil.which", lambda name: str(tool))


def no_adapter(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    adapter(pc, patch, None)


def interface_down(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    adapter(pc, patch, "0x80\n")


def bus_off(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    adapter(pc, patch, "0x81\n", {"state": "BUS-OFF", "bittiming": {"bitrate": 500_000}, "restart_ms": 100})


def error_passive(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    adapter(pc, patch, "0x81\n", {"state": "ERROR-PASSIVE"})


def other_bit_rate(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    adapter(pc, patch, "0x81\n", {"state": "ERROR-ACTIVE", "bittiming": {"bitrate": 250_000}})


def drive_is_away(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    pc.axis["drive"] = {"node_id": 9}


def other_rated_current(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    pc.axis["drive"] = {"rated_current_a": 10.0}


def other_scale(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    pc.axis["drive"] = {"increments_per_rev": 4096}


def sensor_is_away(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    pc.axis["voltage"] = {"source": "modbus", "host": "127.0.0.1", "port": 9, "timeout_s": 0.2}


def socket_path_too_long(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    pc.document["store"]["run_directory"] = str(pc.folder / ("x" * 120))


def anybody_may_write(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    pc.run_directory.chmod(stat.S_IMODE(0o777))


def token_can_be_read(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    (pc.run_directory / "token").write_text("secret")
    (pc.run_directory / "token").chmod(0o644)


def corrected(pc: Pc) -> None:
    pc.axis["correction"] = {"max_offset_um": 50.0}


def damaged_record(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    corrected(pc)
    (pc.store / "commissioning-X.json").write_text("{}")


def guard_is_silent(pc: Pc, patch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(pc.run_directory / "guard.sock"))


PLANTED: dict[Callable[[Pc, pytest.MonkeyPatch], None], str] = {
    store_is_a_file: "StoreNoFolder",
    store_may_not_be_written: "StoreReadOnly",
    little_room: "DiskFull",
    damaged_history: "CorruptFile",
    newer_history: "SchemaVersion",
    clock_never_set: "ClockNotSet",
    clock_set_back: "ClockBehind",
    no_port: "NoPort",
    hub_is_away: "HubAway",
    kernel_without_can: "NoKernelCan",
    no_adapter: "InterfaceMissing",
    interface_down: "InterfaceDown",
    bus_off: "BusOff",
    error_passive: "BusPassive",
    other_bit_rate: "BitrateDiffers",
    drive_is_away: "DriveDiffers",
    other_rated_current: "RatedCurrentDiffers",
    other_scale: "ScaleDiffers",
    sensor_is_away: "VoltageDiffers",
    socket_path_too_long: "SocketPathLong",
    anybody_may_write: "RunDirectoryOpen",
    token_can_be_read: "TokenOpen",
    damaged_record: "RecordBad",
    guard_is_silent: "GuardSilent",
}


def test_nothing_is_wrong_with_a_machine_as_it_must_be(pc: Pc) -> None:
    with pc.peer():
        assert pc.examined() == (0, [])


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("plant", PLANTED, ids=lambda plant: plant.__name__)
def test_a_planted_trouble_is_named_first(plant: Callable[..., None], pc: Pc, monkeypatch: pytest.MonkeyPatch) -> None:
    with pc.peer():
        plant(pc, monkeypatch)
        code, troubles = pc.examined()
    assert troubles[0]["code"] == PLANTED[plant], troubles
    assert code == 1
    assert all(troubles[0][part] for part in ("place", "what", "means", "mend"))


def test_what_could_be_better_comes_last_and_is_no_failure(pc: Pc, monkeypatch: pytest.MonkeyPatch) -> None:
    corrected(pc)
    monkeypatch.setattr("os.getloadavg", lambda: (99.0, 99.0, 99.0))
    code, troubles = pc.examined("--offline")
    assert (code, [t["code"] for t in troubles]) == (0, ["BusyHost", "NotCommissioned"])


@pytest.mark.usefixtures("processes")
def test_a_store_that_may_not_be_entered_is_told_and_the_rest_examined(pc: Pc) -> None:
    pc.document["store"]["run_directory"] = str(pc.folder / "run")
    History.open(pc.store).close()
    command = [*UNPRIVILEGED, sys.executable, "-m", "fdhil", "doctor", str(pc.write()), "--json", "--offline"]
    pc.store.chmod(0)
    try:
        done = subprocess.run(command, capture_output=True, text=True)
    finally:
        pc.store.chmod(0o700)
    assert (done.returncode, done.stderr) == (1, "")
    troubles = json.loads(done.stdout)["troubles"]
    assert {"StoreReadOnly", "NotSeen"} <= {trouble["code"] for trouble in troubles}
    assert any(str(pc.store) in trouble["what"] and "sudo" in trouble["mend"] for trouble in troubles)


def test_offline_leaves_the_hub_in_peace(pc: Pc) -> None:
    with socket.create_server(("127.0.0.1", 0)) as hub:
        pc.bus = {"interface": "socketcand", "port": hub.getsockname()[1]}
        pc.examined("--offline")
        hub.setblocking(False)
        with pytest.raises(BlockingIOError):
            hub.accept()


def test_it_reads_well(pc: Pc) -> None:
    pc.document["store"]["run_directory"] = str(pc.folder / ("x" * 120))
    result = CliRunner().invoke(doctor, [str(pc.write()), "--offline"], standalone_mode=False)
    assert "1. sockets: " in result.stdout
    assert "   fix:   choose a shorter [store] run_directory" in result.stdout
    assert "1 to fix, 0 to improve" in result.stdout
