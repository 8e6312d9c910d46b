"""The real processes: the simulator with its NC on its own bus, guard, daemon and command line."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path

import can
import numpy as np
import pytest

from fdhil.cli.demo.processes import ChildProcess
from fdhil.errors import ConnectError
from fdhil.prediction import compute_contour_error_um
from fdhil.store.history_database import History
from fdhil.store.window_file import list_windows
from tests.daemon.machine_rig import CORNER, REAL, SHUTTLE, MachineRig, fdhil, opened, patient

Capture = pytest.CaptureFixture[str]
pytestmark = [pytest.mark.timeout(1500), pytest.mark.usefixtures("processes")]


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[MachineRig]:
    with opened(tmp_path) as shop:
        shop.commission()
        yield shop


def test_recorded_rapids_lead_to_a_corrected_cut_and_back_to_zero(rig: MachineRig, capsys: Capture) -> None:
    with rig.guard() as guard, rig.daemon() as daemon:
        _refuses_what_is_not_known(rig, capsys)
        rig.nc(on=True)
        rig.play("shuttle.ngc", SHUTTLE)
        refused = rig.wait_for_status(
            lambda s: (
                s["sync"]["rate_hz"] and all(s["axes"][a]["accepted"] + s["axes"][a]["refused"] >= 4 for a in "XY")
            )
        )
        _has_identified_the_drives(refused)
        _refuses_a_second_daemon(rig)
        _cuts_corrected(rig, capsys)
        _refuses_a_drive_that_was_written_to_until_it_is_compared(rig, capsys)
        code, out, err = fdhil("arm", rig.path, rig.folder / "corner.ngc", capsys=capsys)
        assert code == 0, (out, err)
        assert daemon.stop() == 0  # disarms first
        assert guard.stop() == 0
    log = (rig.folder / "daemon.log").read_text()
    assert log.count("Armed: armed corner.ngc") == 2, log
    assert "ArmRefused: ModelNotValidated" in log
    assert "GuardState: ARMED -> " in log
    assert "PassMeasured: pass 1 of corner.ngc: contour error measured" in log
    assert log.splitlines()[-1].endswith(" stopped, offset 0"), log
    token = (rig.run_directory / "token").read_text()
    for file in (*rig.folder.glob("*.log"), *rig.config.store.directory.rglob("*.sqlite*")):
        assert token.encode() not in file.read_bytes(), file
    _replays_bit_by_bit(rig, capsys)
    _check_history_command(rig, capsys)


def _refuses_what_is_not_known(shop: MachineRig, capsys: Capture) -> None:
    program = shop.folder / "corner.ngc"
    program.write_text(CORNER)
    code, out, err = fdhil("arm", shop.path, program, capsys=capsys)
    assert (code, out) == (1, "")
    assert "refused: ModelNotValidated" in err


def _has_identified_the_drives(status: dict[str, object]) -> None:
    document = json.loads(json.dumps(status))
    assert document["state"] == "OFF"
    assert document["frames"]["received"] > 20_000
    assert document["sync"]["rate_hz"] > 0
    for axis in (document["axes"]["X"], document["axes"]["Y"]):
        assert (axis["accepted"], axis["refused"]) == (4, 0), axis
        assert axis["skill"]["rms_um"] < 0.1 * axis["skill"]["measured_rms_um"]
        for name, true in REAL.items():
            result = axis["parameters"][name]
            assert result["value"] == pytest.approx(true, rel=0.1 if name in {"ft", "Cd"} else 0.02), name
            assert result["low"] < result["high"]


def _refuses_a_second_daemon(shop: MachineRig) -> None:
    second = ChildProcess("second daemon", ["fdhil", "run", str(shop.path)], shop.folder / "second.log")
    with pytest.raises(ConnectError, match="BusLocked"):
        second.await_event("ready")
    assert second.stop() == 3


def _cuts_corrected(shop: MachineRig, capsys: Capture) -> None:
    plain = _cut(shop, "plain")
    code, out, err = fdhil("arm", shop.path, shop.folder / "corner.ngc", "--json", capsys=capsys)
    assert code == 0, (out, err)
    answer = json.loads(out)
    assert answer["state"] == "ARMED"
    assert answer["after"]["rms_um"] < 0.2 * answer["before"]["rms_um"]
    status = shop.wait_for_status(lambda s: s["state"] == "ARMED")
    assert status["armed"]["program"] == str(shop.folder / "corner.ngc")
    corrected = _cut(shop, "corrected")
    assert corrected < 0.2 * plain, (corrected, plain)
    shop.get_notices("-> OFF: Finished")


def _refuses_a_drive_that_was_written_to_until_it_is_compared(shop: MachineRig, capsys: Capture) -> None:
    place = shop.config.bus["can0"]
    with can.Bus(interface="socketcand", channel=place.channel, host=place.host, port=place.port) as bus:
        written = struct.pack("<BHBI", 0x23, 0x6065, 0, 32768)
        bus.send(can.Message(arbitration_id=0x601, data=written, is_extended_id=False))
        shop.wait_for_status(lambda s: any(notice["code"] == "RecordVoid" for notice in s["notices"]))
    code, out, err = fdhil("arm", shop.path, shop.folder / "corner.ngc", capsys=capsys)
    assert (code, out) == (1, "")
    assert "refused: RecordVoid: axis X" in err
    assert "run fdhil check" in err
    shop.nc(on=False)
    with patient():
        assert fdhil("check", shop.path, capsys=capsys)[0] == 0
    shop.nc(on=True)
    shop.play("dwell.ngc", "G4 P0.3\nM2\n")  # the interlocks want 100 good SYNC


def _cut(shop: MachineRig, name: str, program: str = "corner.ngc", text: str = CORNER) -> float:
    trace = shop.folder / f"{name}.csv"
    shop.play(program, text, trace=trace)
    rows = np.genfromtxt(trace, delimiter=",", names=True)
    reference = np.column_stack([rows[f"{axis}_reference_mm"] for axis in "XY"])
    table = np.column_stack([rows[f"{axis}_table_mm"] for axis in "XY"])
    return float(np.sqrt(np.mean(compute_contour_error_um(reference, table, 1e-3) ** 2)))


def _replays_bit_by_bit(shop: MachineRig, capsys: Capture) -> None:
    folder = shop.config.store.directory / "windows"
    files = [file.path for file in list_windows(folder).windows if file.axis == "X"]
    assert len(files) == 4
    code, out, err = fdhil("replay", "--config", shop.path, "--json", *files, capsys=capsys)
    assert code == 0, err
    document = json.loads(out)
    with History.open_read_only(shop.config.store.directory) as history:
        stored, revisions, skills = history.read_windows("X"), history.read_revisions("X"), history.read_skills("X")
    for file, window, revision, skill in zip(document["files"], stored, revisions, skills, strict=True):
        of = {outcome["kind"]: outcome for outcome in file["outcomes"]}
        unitless = {
            name: {key: value for key, value in result.items() if key != "unit"}
            for name, result in of["window"]["parameters"].items()
        }
        assert unitless == window.parameters
        assert of["window"]["fit_percent"] == window.fit_percent
        values = {name: result["value"] for name, result in of["parameters"]["parameters"].items()}
        assert values == revision.set.parameters.as_dict()
        assert of["skill"]["rms_um"] == skill.rms_um


def _check_history_command(shop: MachineRig, capsys: Capture) -> None:
    _, out, _ = fdhil("history", shop.path, "--json", capsys=capsys)
    assert [row["revision"] for row in json.loads(out)["revisions"] if row["axis"] == "Y"] == [1, 2, 3, 4]
    code, _, err = fdhil("status", shop.path, capsys=capsys)
    assert code == 3
    assert "is not running" in err
