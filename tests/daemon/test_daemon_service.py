"""The daemon on a simulated machine: records are identified, stored and reported; faults are reported and survived."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from fdhil.cli.demo.toml_writer import format_toml
from fdhil.cli.doctor.devices import examine_daemon
from fdhil.commissioning.void_mark import build_mark_path
from fdhil.config import MachineConfig, load_config
from fdhil.daemon.bus_health import BusHealth
from fdhil.daemon.daemon_service import DaemonService, InternalError, run_daemon_service
from fdhil.daemon.daemon_socket import ask_daemon
from fdhil.daemon.machine_lock import BusLocked
from fdhil.errors import ConnectError, DeviceError
from fdhil.records import Notice
from fdhil.store.history_database import History
from fdhil.store.window_file import list_windows
from tests.bench import bench_document
from tests.daemon.machine_rig import fdhil
from tests.daemon.simulated_machine import NOMINAL, SimulatedMachine, config_of, rapids


@pytest.fixture(autouse=True)
def _skip_kernel_warmup(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.daemon.daemon_service.compile_kernels", lambda config, method: None)


async def _exists(path: Path) -> None:
    for _ in range(6000):
        if path.exists():
            return
        await asyncio.sleep(0.01)
    raise TimeoutError(path)


@asynccontextmanager
async def serving(config: MachineConfig, machine: SimulatedMachine) -> AsyncIterator[Path]:
    task = asyncio.create_task(DaemonService(config, machine.open).run())
    assert config.store.run_directory is not None
    path = config.store.run_directory / "daemon.sock"
    await asyncio.wait([task, asyncio.create_task(_exists(path))], return_when=asyncio.FIRST_COMPLETED)
    try:
        yield path
    finally:
        if not task.done():
            os.kill(os.getpid(), signal.SIGTERM)
        await task


async def status_when(path: Path, ready: Any) -> dict[str, Any]:
    while True:
        status = await asyncio.to_thread(ask_daemon, path, {"request": "status"})
        if ready(status):
            return status
        await asyncio.sleep(0.02)


async def test_rapids_become_parameters_with_intervals_in_status_and_history(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    machine = SimulatedMachine(rapids(config, count=2))
    async with serving(config, machine) as path:
        status = await status_when(path, lambda s: s["axes"]["X"]["accepted"] == 2)
    axis = status["axes"]["X"]
    assert status["source"]["state"] in ("listening", "silent")  # nothing comes behind the last of them
    assert status["sync"]["expected_hz"] == 1000.0
    assert (axis["refused"], axis["revision"]) == (0, 2)
    for name, true in NOMINAL.items():
        result = axis["parameters"][name]
        assert result["low"] < result["value"] < result["high"]
        assert result["value"] == pytest.approx(true, rel=0.1), name
    with History.open_read_only(config.store.directory) as history:
        assert [r.set.revision for r in history.read_revisions("X")] == [1, 2]
        assert history.read_revisions("X")[1].window_ids == (1, 2)
        assert [w.accepted for w in history.read_windows("X")] == [True, True]
    listing = list_windows(config.store.directory / "windows")
    assert [file.number for file in listing.windows] == [1, 2]
    assert not path.exists()


async def test_edited_configuration_is_reported_with_the_limits_in_force(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "machine.toml"
    file.write_text(format_toml(bench_document()))
    async with serving(load_config(file), SimulatedMachine()):
        document = bench_document()
        document["axis"]["X"]["correction"]["max_offset_um"] = 5.0
        file.write_text(format_toml(document))
        (tmp_path / "p.ngc").write_text("G0 X1")
        asked = [("status",), ("status", "--json"), ("arm", tmp_path / "p.ngc"), ("arm", tmp_path / "p.ngc", "--json")]
        answers = [await asyncio.to_thread(fdhil, command, file, *more, capsys=capsys) for command, *more in asked]
        (trouble,) = await asyncio.to_thread(lambda: list(examine_daemon(load_config(file))))
    assert trouble.code == "ConfigDiffers"
    output = [" ".join((out + err).split()) for _, out, err in answers]
    assert [("configuration file has changed" in text, "X 250 um" in text) for text in output] == [(True, True)] * 4
    assert json.loads(answers[1][1])["limits"]["X"]["max_offset_um"] == 250.0


async def test_restarted_daemon_continues_from_the_history(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    for expected in (1, 2):
        async with serving(config, SimulatedMachine(rapids(config, count=1))) as path:
            status = await status_when(path, lambda s, n=expected: s["axes"]["X"]["accepted"] == n)
        assert status["axes"]["X"]["revision"] == expected


async def test_failed_source_is_reopened_and_the_pipeline_keeps_its_state(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = config_of(tmp_path)
    records = rapids(config, count=1)
    machine = SimulatedMachine(records[:30])
    async with serving(config, machine) as path:
        machine.unreachable = 0
        machine.give(DeviceError("can0", "went away"))
        machine.give(*records[30:])
        await status_when(path, lambda s: s["axes"]["X"]["accepted"] == 1)
    assert machine.opened == 2
    assert "SourceLost: can0: went away" in capsys.readouterr().err


async def test_missing_source_at_start_ends_the_daemon(tmp_path: Path) -> None:
    machine = SimulatedMachine()
    machine.unreachable = 1
    with pytest.raises(ExceptionGroup) as error:
        await DaemonService(config_of(tmp_path), machine.open).run()
    assert error.group_contains(ConnectError, match="cannot be reached")


@pytest.mark.fault("F8")
async def test_second_daemon_of_a_machine_is_refused(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    async with serving(config, SimulatedMachine()):
        with pytest.raises(BusLocked, match=f"process {os.getpid()}"):
            await DaemonService(config, SimulatedMachine().open).run()
        config.run_directory.joinpath("daemon.lock").unlink()  # somebody cleans up
        with pytest.raises(BusLocked, match="another daemon writes to this store"):
            await DaemonService(config, SimulatedMachine().open).run()


@pytest.mark.fault("F12", "A21")
async def test_flood_of_notices_becomes_a_few_lines_and_a_count(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = config_of(tmp_path)
    machine = SimulatedMachine([Notice("DriveEmergency", "MAJOR", f"code {k}", "X") for k in range(2000)])
    async with serving(config, machine) as path:
        await status_when(path, lambda s: s["counters"]["frames"] == 2000)
    assert 10 < capsys.readouterr().err.count("DriveEmergency") < 40
    with History.open_read_only(config.store.directory) as history:
        assert len(history.read_notices()) < 40


async def test_invalid_requests_are_answered_and_affect_no_other_client(tmp_path: Path) -> None:
    async with serving(config_of(tmp_path), SimulatedMachine()) as path:
        for line in (b"no json", b"[1]", b'{"request": 5}', b'{"request": "fly"}', b"[" * 5000):
            reader, writer = await asyncio.open_unix_connection(str(path))
            writer.write(line + b"\n")
            answer = json.loads(await reader.readline())
            assert (answer["ok"], answer["code"]) == (False, "BadRequest")
            writer.close()
            await writer.wait_closed()
        silent = await asyncio.open_unix_connection(str(path))
        reader, writer = await asyncio.open_unix_connection(str(path))
        writer.write(b"x" * 200_000 + b"\n")
        assert await reader.read() == b""
        assert (await asyncio.to_thread(ask_daemon, path, {"request": "status"}))["ok"]
        for stream in (silent[1], writer):
            stream.close()


@pytest.mark.fault("F20")
def test_internal_error_ends_the_daemon_and_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = config_of(tmp_path)

    def fail(*_: Any) -> None:
        raise ZeroDivisionError("made up")

    monkeypatch.setattr("fdhil.pipeline.AxisPipeline.process_record", fail)
    with pytest.raises(InternalError, match=r"ZeroDivisionError.*there was no guard, nothing was sent") as error:
        run_daemon_service(config, SimulatedMachine(rapids(config, count=1)).open)
    assert error.value.exit_code == 3
    assert "made up" in capsys.readouterr().err
    assert config.store.run_directory is not None
    assert not (config.store.run_directory / "daemon.sock").exists()


async def test_systemd_receives_ready_watchdog_and_stopping(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "100000")
        machine = SimulatedMachine()
        async with serving(config_of(tmp_path), machine):
            received = [await asyncio.get_running_loop().sock_recv(manager, 200) for _ in range(2)]
        with contextlib.suppress(BlockingIOError):
            while True:
                received.append(manager.recv(200))
    assert any(message.startswith(b"READY=1") for message in received)
    assert b"WATCHDOG=1" in received
    assert b"STOPPING=1" in received


async def test_boot_up_of_a_drive_voids_its_record(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config, booted = config_of(tmp_path), Notice("NodeRebooted", "MAJOR", "Drive X booted.", "X")
    async with serving(config, SimulatedMachine([Notice("SyncLost", "MAJOR", "SYNC stopped"), booted])):
        await _exists(build_mark_path(config.store.directory, "X"))
    assert "booted" in build_mark_path(config.store.directory, "X").read_text()
    build_mark_path(config.store.directory, "X").unlink()
    (tmp_path / "file").write_text("")
    blocked = config.model_copy(update={"store": config.store.model_copy(update={"directory": tmp_path / "file"})})
    async with serving(blocked, SimulatedMachine([booted])) as path:
        await status_when(path, lambda s: s["notices"])
    assert "cannot be written" in capsys.readouterr().err


@pytest.mark.fault("A23", "F12")
async def test_suppressed_boot_up_notice_still_voids_the_record(tmp_path: Path) -> None:
    config = config_of(tmp_path, ("X", "Y"))
    service = DaemonService(config, SimulatedMachine().open)
    for k in range(300):
        service._record_notices(
            [Notice("NodeRebooted", "MAJOR", f"boot {k}", "X"), Notice(f"Code{k}", "minor", "flood")]
        )
    assert service._notices.full()
    service._record_notices([Notice("NodeRebooted", "MAJOR", "Drive Y booted", "Y")])
    voiding = asyncio.create_task(service._void_records())
    await service._void_axes.join()
    voiding.cancel()
    assert "boot 299" in build_mark_path(config.store.directory, "X").read_text()
    assert "Drive Y booted" in build_mark_path(config.store.directory, "Y").read_text()


def test_watchdog_starves_on_a_hanging_source_but_not_on_a_silent_bus(tmp_path: Path) -> None:
    hearing = BusHealth(config_of(tmp_path), 0.0)
    assert hearing.is_alive(1e6, 2.0)  # not open: it is being opened again
    hearing.note_source_opened(100.0)
    assert hearing.is_alive(101.0, 2.0)
    assert not hearing.is_alive(103.0, 2.0)
    hearing.take_record(Notice("SyncLost", "MAJOR", "SYNC stopped"), 104.0)
    assert hearing.is_alive(1000.0, 2.0)
    hearing.take_record(Notice("SyncLost", "info", "SYNC is back."), 1000.0)
    assert not hearing.is_alive(1003.0, 2.0)
