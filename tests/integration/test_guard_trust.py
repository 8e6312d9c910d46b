"""The guard's trust in a drive on the bus: a foreign configuration, a reboot, a remapped read-back."""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import can
import pytest
from click.testing import CliRunner

from fdhil.arming.guard_client import GuardClient
from fdhil.arming.operator_token import read_token
from fdhil.cli.demo.processes import ChildProcess
from fdhil.cli.main import cli
from fdhil.commissioning.void_mark import is_record_void, mark_record_void
from fdhil.guard.interlocks import FACTS
from tests.guard import short_timeouts
from tests.integration.conftest import PATIENCE_S, Bench, sign_off
from tests.integration.test_guard import toml

pytestmark = pytest.mark.usefixtures("processes")

WINDOW = 0x6065


@pytest.fixture
def transport() -> str:
    return "hub"


@pytest.fixture
def sections() -> dict[str, Any]:
    return {"sim": {"pace": "lockstep", "modbus": False}, "guard": {"clock": "sync"}}


class TrustRig:
    def __init__(self, bench: Bench, folder: Path) -> None:
        self.bench, self.folder, self.config = bench, folder, folder / "machine.toml"
        self.config.write_text(toml(json.loads(bench.config.model_dump_json(exclude_none=True))), "utf-8")
        self.store = bench.config.store.directory
        assert bench.config.store.run_directory is not None
        self.run = bench.config.store.run_directory
        sign_off(bench.config)

    @contextmanager
    def guard(self) -> Iterator[GuardClient]:
        with ChildProcess("guard", [short_timeouts.__name__, str(self.config)], self.folder / "guard.log") as process:
            process.await_event("ready", PATIENCE_S)
            with GuardClient(self.run) as client:
                yield client

    def nc(self, on: bool) -> None:
        if on:
            (self.run / short_timeouts.BUS).unlink(missing_ok=True)
        self.bench.command(json.dumps({"command": "nc", "on": on}))
        while (event := self.bench.events.get(timeout=PATIENCE_S))["event"] != "nc" or event["on"] is not on:
            pass
        if not on:
            (self.run / short_timeouts.BUS).touch()

    def fault(self, **fault: object) -> None:
        self.bench.command(json.dumps({"command": "fault", **fault}))

    def write(self, bus: can.BusABC, index: int, value: int, specifier: int = 0x23) -> None:
        bus.send(
            can.Message(
                arbitration_id=0x601, data=struct.pack("<BHBI", specifier, index, 0, value), is_extended_id=False
            )
        )

    def refused(self, client: GuardClient) -> set[tuple[str, str]]:
        answer = client.arm(read_token(self.run), "0" * 64, dict.fromkeys(FACTS, True))
        return {(result["code"], result["axis"]) for result in answer["refused"]} - {
            ("ProgramMismatch", ""),
            ("MainLost", ""),
        }

    def until(self, client: GuardClient, wanted: set[tuple[str, str]]) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not (found := self.refused(client)) >= wanted or (found and not wanted):
            assert time.monotonic() < deadline, found
            time.sleep(0.05)

    def check(self) -> int:
        found = CliRunner().invoke(cli, ["check", str(self.config), "--json"], standalone_mode=False)
        assert found.exception is None, found.output
        return int(found.return_value)


@pytest.fixture
def rig(bench: Bench, tmp_path: Path) -> TrustRig:
    return TrustRig(bench, tmp_path)


VOID = {("RecordVoid", "X")}


def test_record_is_valid_until_an_event_voids_it(rig: TrustRig) -> None:
    with rig.guard() as client, rig.bench.join() as bus:
        rig.nc(on=True)
        rig.until(client, set())
        rig.write(bus, WINDOW, 0xFFFFFFFF)
        rig.until(client, VOID)
        rig.nc(on=False)
        assert rig.check() == 1
        assert is_record_void(rig.store, "X")
        rig.write(bus, WINDOW, 32768)
        assert rig.check() == 0
        assert not is_record_void(rig.store, "X")
        rig.nc(on=True)
        rig.until(client, set())
        rig.fault(axis="X", fault="reboot")
        rig.until(client, VOID | {("NmtStateWrong", "X")})
        rig.nc(on=False)
        assert rig.check() == 0
        rig.nc(on=True)
        rig.until(client, set())
    rig.nc(on=False)
    with rig.bench.join() as bus:
        rig.write(bus, 0x6007, 0, 0x2B)
    with rig.guard() as client:  # it is compared before the guard starts, which has not heard of it
        assert is_record_void(rig.store, "X")
        rig.nc(on=True)
        rig.until(client, VOID)


def test_void_record_survives_a_guard_restart_next_to_a_running_nc(rig: TrustRig) -> None:
    rig.nc(on=True)
    mark_record_void(rig.store, "X", "booted")
    with rig.guard() as client:
        rig.until(client, VOID)


def test_remapped_read_back_moves_nothing(rig: TrustRig, tmp_path: Path) -> None:
    rows = 450
    demand = tmp_path / "demand.csv"
    way = [100 * (10 * t**3 - 15 * t**4 + 6 * t**5) for t in (min(k / (rows - 10), 1.0) for k in range(rows))]
    demand.write_text("time_s,X_mm,Y_mm\n" + "".join(f"{k * 1e-3:.3f},{x:.6f},0\n" for k, x in enumerate(way)))
    rig.nc(on=True)
    rig.bench.command(json.dumps({"command": "play", "file": str(demand)}))
    rig.bench.event("finished")
    rig.fault(axis="X", fault="remap", value=3)
    with rig.bench.join() as bus:
        bus.set_filters([{"can_id": i, "can_mask": 0x7FF, "extended": False} for i in (0x301, 0x302, 0x764)])
        with rig.guard() as client:
            deadline = time.monotonic() + PATIENCE_S
            while (status := client.read_status())["state"] != "FROZEN":
                assert time.monotonic() < deadline, status
                time.sleep(0.05)
            assert status["cause"]["code"] == "OffsetDoubtful"
            assert "100000.0 um may still be applied" in status["cause"]["text"]
            assert not client.adopt(read_token(rig.run))["ok"]
        assert bus.recv(0.1) is None
