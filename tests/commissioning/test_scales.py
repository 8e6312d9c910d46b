"""A drive's units are compared with the configuration, on simulated drives with vendor emulation."""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from fdhil.commissioning.compare_scales import compare_scales
from fdhil.commissioning.finding import Finding
from fdhil.commissioning.master import Master
from fdhil.config import parse_config
from fdhil.sim.drive.servo_drive import SimulatedDrive
from tests.bench import bench_document
from tests.drivers.peer import DrivePeer
from tests.eds import write_eds

pytestmark = pytest.mark.usefixtures("fast_commissioning")


def compare_drive(sheet: str, folder: Path, objects: Mapping[tuple[int, int], int], **drive: Any) -> dict[str, Finding]:
    eds = write_eds(sheet, folder)
    document = bench_document("X")
    document["bus"] = {"can0": {"interface": "virtual", "channel": uuid.uuid4().hex}}
    document["guard"] = {"clock": "sync"}
    document["axis"]["X"]["drive"] = {"eds": str(eds), **drive}
    document["sim"] = {"axis": {"X": {"eds": str(eds)}}}
    config = parse_config(document)
    with DrivePeer(config) as peer:
        for (index, sub), value in objects.items():
            peer.drive.overwrite_object(index, sub, value)
        with Master(config, "X") as master:
            return {finding.point: finding for finding in compare_scales(master)}


@pytest.mark.parametrize(
    ("word", "unit", "ok", "says"),
    [
        (0x00B44700, None, True, ""),
        (0xFDB44700, None, False, "set drive.speed_unit = 'millirpm'"),
        (0xFDB44700, "millirpm", True, ""),
        (0x00B44700, "millirpm", False, "set drive.speed_unit = 'rpm'"),
        (0xFFB44700, None, False, "set 0x60A9 to 00B44700 (rpm) or FDB44700 (millirpm)"),
    ],
)
def test_speed_unit_is_compared(word: int, unit: str | None, ok: bool, says: str, tmp_path: Path) -> None:
    found = compare_drive("epos4", tmp_path, {(0x60A9, 0): word}, profile="epos4", speed_unit=unit)["speed unit"]
    assert found.ok is ok
    assert ok or says in found.advice


@pytest.mark.parametrize(
    ("counts", "volts", "ok"), [(480, 48.0, True), (480, 47.0, True), (480, 24.0, False), (480, None, False)]
)
def test_dc_link_is_compared_if_it_scales_duty(
    counts: int, volts: float | None, ok: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        SimulatedDrive, SimulatedDrive.run_timers.__name__, lambda *_: []
    )  # its supply stays as it is set
    found = compare_drive("epos4", tmp_path, {(0x2200, 1): counts}, profile="epos4", dc_link_v=volts).get("DC link")
    assert found is not None
    assert found.ok is ok
    assert ok or "set drive.dc_link_v = 48.0" in found.advice


def test_scale_missing_in_drive_is_not_compared(tmp_path: Path) -> None:
    found = compare_drive("epos4", tmp_path, {}, profile="epos4")
    assert found["scale"].ok is None
    assert "DC link" in found


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize(("millis", "ok"), [(2000, True), (3000, False)])
def test_rated_torque_is_compared_if_current_is_torque(millis: int, ok: bool, tmp_path: Path) -> None:
    own = tmp_path / "own.toml"
    own.write_text('base = "cia402"\ncurrent = [0x6077, 0]\ncurrent_unit = "permille_of_rated_torque"\n')
    found = compare_drive("elmo", tmp_path, {(0x6076, 0): millis}, profile=str(own), rated_torque_nm=2.0)
    assert found["rated torque"].ok is ok
    assert "rated current" not in found
    assert ok or "correct drive.rated_torque_nm" in found["rated torque"].advice
