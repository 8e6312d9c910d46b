"""From the simulated bus to the history: slopes of warm slide-ways, and a loaded table at its first rapid."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil import config as machine_config
from fdhil.cli.demo.processes import SimulatorProcess
from tests.daemon.machine_rig import AXIS, HEAD, MachineRig, fdhil

pytestmark = pytest.mark.usefixtures("processes")

FT_PER_KELVIN, CD_PER_KELVIN = -0.16, -0.10
SHUTTLE = "G21 G90 G94\nG0 X200\nG4 P0.3\nG0 X0\nG4 P0.3\nM2\n"
CELSIUS = np.linspace(20.0, 22.0, 4)
# heavier than the data sheet says, with slide-ways that keep the temperature they are given
TWIN = f"""
ft_per_kelvin = {FT_PER_KELVIN}
Cd_per_kelvin = {CD_PER_KELVIN}
[sim.thermal]
rise_c = 0.0
time_constant_s = 1e9
"""


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[MachineRig]:
    bench = HEAD + AXIS + TWIN
    (tmp_path / "twin.toml").write_text(f'{bench}[bus.can0]\ninterface = "socketcand"\n')
    with SimulatorProcess(tmp_path / "twin.toml", tmp_path / "twin.log") as twin:
        bus, sensor = twin.ready["buses"]["can0"], twin.ready["modbus"]["X"]
        expected = "\n".join(f"{key} = {json.dumps(value)}" for key, value in {**sensor, "period_s": 0.05}.items())
        place = "\n".join(f"{key} = {json.dumps(bus[key])}" for key in ("channel", "host", "port"))
        machine = tmp_path / "machine.toml"
        machine.write_text(f'{bench}[axis.X.temperature]\n{expected}\n[bus.can0]\ninterface = "socketcand"\n{place}\n')
        yield MachineRig(tmp_path, twin, machine, machine_config.load_config(machine))


def test_drift_tracks_warming_and_load_change(rig: MachineRig, capsys: pytest.CaptureFixture[str]) -> None:
    with rig.daemon() as daemon:
        rig.nc(on=True)
        for celsius in CELSIUS:
            rig.twin.send_command("temperature", celsius=float(celsius))
            rig.wait_for_status(partial(_is_read, float(celsius)))
            _shuttle(rig)
        assert not [n for n in _notices(rig) if n["code"] in {"LoadChanged", "ParameterJump", "MaintenanceDue"}]
        rig.twin.send_command("set", axis="X", parameters={"Jt": 0.085 * 1.13})
        _shuttle(rig)
        loaded = [notice for notice in _notices(rig) if notice["code"] == "LoadChanged"]
        assert [notice["severity"] for notice in loaded] == ["MAJOR", "minor"]
        assert daemon.stop() == 0
    document = json.loads(fdhil("history", rig.path, "--json", capsys=capsys)[1])
    slopes = document["slopes"]["X"]
    assert slopes["ft"]["per_kelvin"] == pytest.approx(0.05 * FT_PER_KELVIN, rel=0.1)
    assert slopes["Cd"]["per_kelvin"] == pytest.approx(5.0 * CD_PER_KELVIN, rel=0.1)
    (change,) = document["changes"]["X"]
    assert (change["cause"], list(change["parameters"])) == ("a changed load", ["Jt"])
    assert change["parameters"]["Jt"]["after"] == pytest.approx(0.085 * 1.13, rel=0.01)
    windows = document["windows"]["X"]
    assert [w["temperature_c"] for w in windows[:-2:2]] == pytest.approx(list(CELSIUS), abs=0.02)


def _is_read(celsius: float, status: dict[str, Any]) -> bool:
    return bool(abs(status["axes"]["X"].get("slideway_c", math.nan) - celsius) < 0.01)


def _shuttle(shop: MachineRig) -> None:
    before = _analysed(shop.status() or {})
    shop.play("shuttle.ngc", SHUTTLE)
    shop.wait_for_status(lambda status: _analysed(status) >= before + 2)


def _analysed(status: dict[str, Any]) -> int:
    axis = status["axes"]["X"]
    return int(axis["accepted"] + axis["refused"])


def _notices(shop: MachineRig) -> list[dict[str, Any]]:
    return list((shop.status() or {})["notices"])
