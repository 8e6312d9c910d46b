"""The units are what systemd understands, and as confined as promised."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

UNITS = Path(__file__).parents[2] / "systemd"
NAMES = ("fdhil.service", "fdhil-sim.service")


@pytest.mark.parametrize("name", NAMES)
def test_the_unit_says_what_the_service_relies_on(name: str) -> None:
    lines = (UNITS / name).read_text().splitlines()
    settings = dict(line.split("=", 1) for line in lines if "=" in line and not line.startswith("#"))
    assert settings["LimitCORE"] == "0"
    assert settings["NoNewPrivileges"] == "yes"
    assert settings["RestartPreventExitStatus"] == "2"
    assert settings["Environment"].startswith("PYTHON") or "NUMBA_CACHE_DIR" in settings["Environment"]
    assert "Environment=NUMBA_CACHE_DIR=/var/cache/fdhil/numba" in lines
    if name == "fdhil.service":
        assert (settings["Type"], settings["WatchdogSec"]) == ("notify", "10")
        assert not {"BindsTo", "Requires", "PartOf"} & settings.keys()


@pytest.mark.debian
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.fault("G13")
def test_systemd_agrees(name: str, tmp_path: Path) -> None:
    unit = tmp_path / name
    unit.write_text((UNITS / name).read_text().replace("/opt/fdhil/bin/fdhil", sys.executable))
    verified = subprocess.run(["systemd-analyze", "verify", str(unit)], capture_output=True, text=True)
    assert (verified.returncode, verified.stderr.strip()) == (0, "")
    confined = ["systemd-analyze", "security", "--offline=yes", "--threshold=15", str(unit)]
    assert subprocess.run(confined, capture_output=True).returncode == 0
