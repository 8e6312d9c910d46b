"""Flatness feed-forward with the real processes: identified from the bus, armed without a program, measured.

The axes are heavier than in their data sheet, so that only identified parameters help.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.guard.guard_step import SETTLED_CYCLES
from tests.bench import AXIS, axis_toml
from tests.daemon.machine_rig import HEAD, TO_AND_FRO, MachineRig, fdhil, opened
from tests.paths import build_bench_demand

Capture = pytest.CaptureFixture[str]
pytestmark = [pytest.mark.timeout(1500), pytest.mark.usefixtures("processes")]
LIMITS = {"max_torque_nm": 100.0, "max_speed_rad_s": 30.0}
CASES = {"X": (1.0, 3.0), "Y": (0.5, 50.0)}
"""An axis of the bench and one that lags: the drive's own speed feed-forward, and by how much the largest tracking
error has to shrink."""


def bench_of(axis: str, speed_feedforward: float) -> str:
    regulators = {**AXIS["regulators"], "speed_feedforward": speed_feedforward}
    return axis_toml(axis, regulators=regulators, feedforward=LIMITS) + f"[sim.axis.{axis}]\nJt = 0.085\n"


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[MachineRig]:
    with opened(tmp_path, HEAD + "".join(bench_of(axis, own) for axis, (own, _) in CASES.items())) as shop:
        shop.commission()
        yield shop


def test_feedforward_of_an_identified_machine_reduces_the_following_error(rig: MachineRig, capsys: Capture) -> None:
    with rig.guard() as guard, rig.daemon() as daemon:
        code, _, err = fdhil("arm", rig.path, "--method", "flatness", capsys=capsys)
        assert (code, "refused: ModelNotValidated" in err) == (1, True), err
        rig.nc(on=True)
        rig.play("shuttle.ngc", f"G21 G90 G94\n{TO_AND_FRO}M2\n")
        rig.wait_for_status(lambda s: all(s["axes"][a]["accepted"] >= 2 for a in "XY"))
        before = largest_errors_um(rig, "before")
        after = fed_forward(rig, capsys)
        for axis, (_, smaller) in CASES.items():
            assert before[axis] / after[axis] >= smaller, (before, after)
        assert fdhil("disarm", rig.path, capsys=capsys)[0] == 0
        status = rig.wait_for_status(lambda s: s["state"] == "OFF" and s["armed"] is None)
        assert feed_of(status)["applied"] == {"X": [0, 0], "Y": [0, 0]}
        assert largest_errors_um(rig, "again") == pytest.approx(before, rel=0.1)
        fades_out_on_an_emergency(rig, capsys)
        assert daemon.stop() == 0
        assert guard.stop() == 0


def switch_on(shop: MachineRig, capsys: Capture) -> None:
    shop.wait_for_status(lambda s: s["guard"].get("good_for", 0) > SETTLED_CYCLES)
    code, out, err = fdhil("arm", shop.path, "--method", "flatness", "--json", capsys=capsys)
    assert code == 0, (out, err)
    assert json.loads(out)["state"] == "FEEDFORWARD"


def fed_forward(shop: MachineRig, capsys: Capture) -> dict[str, float]:
    switch_on(shop, capsys)
    shop.wait_for_status(lambda s: s["state"] == "FEEDFORWARD")
    errors_um = largest_errors_um(shop, "after")
    status = shop.wait_for_status(lambda s: s["guard"])
    assert status["state"] == "FEEDFORWARD", status["guard"]
    return errors_um


def fades_out_on_an_emergency(shop: MachineRig, capsys: Capture) -> None:
    switch_on(shop, capsys)
    shop.wait_for_status(lambda s: s["state"] == "FEEDFORWARD")
    shop.twin.send_command("fault", fault="frame", can_id=0x081, data="1043080000000000")
    status = shop.wait_for_status(lambda s: s["state"] == "OFF" and s["armed"] is None)
    assert feed_of(status)["cause"]["code"] == "DriveEmergency"
    boxes = shop.config.store.directory / "blackbox"
    shop.wait(lambda: any(boxes.glob("*-DriveEmergency.log")))
    (box,) = boxes.glob("*-DriveEmergency.log")
    shop.wait(lambda: "can0 081#1043080000000000" in box.read_text())
    assert feed_of(status)["applied"] == {"X": [0, 0], "Y": [0, 0]}


def feed_of(status: dict[str, Any]) -> dict[str, Any]:
    return dict(status["guard"]["feedforward"])


def largest_errors_um(shop: MachineRig, name: str) -> dict[str, float]:
    """Run the bench's path by the NC; return each axis' largest tracking error, um, by the simulator."""
    demand, trace = shop.folder / "path.csv", shop.folder / f"{name}.csv"
    path = build_bench_demand(10, hold_s=0.2)
    lines = [f"{k * 0.001:.3f},{x:.9f},{y:.9f}" for k, (x, y) in enumerate(path)]
    demand.write_text("time_s,X_mm,Y_mm\n" + "\n".join(lines) + "\n", "utf-8")
    shop.twin.play_program(demand, trace=trace)
    data = np.genfromtxt(trace, delimiter=",", names=True)[: len(path)]
    errors = {axis: data[f"{axis}_table_mm"] - data[f"{axis}_reference_mm"] for axis in "XY"}
    return {axis: 1e3 * float(np.abs(error).max()) for axis, error in errors.items()}
