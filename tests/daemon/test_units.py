"""The systemd units are valid, and as confined as documented."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

UNITS = Path(__file__).parents[2] / "systemd"
NAMES = ("fdhil.service", "fdhil-sim.service", "fdhil-web.service")
SERVICES = (
    "fdhil.service", "fdhil-guard.service", "fdhil-web.service",
    "fdhil-publish@.service", "fdhil-uplink.service", "fdhil-sim.service",
)  # fmt: skip
LARGEST_EXPOSURE = 1.5


@pytest.mark.parametrize("name", NAMES)
def test_unit_has_the_settings_that_the_service_needs(name: str) -> None:
    lines = (UNITS / name).read_text().splitlines()
    settings = dict(line.split("=", 1) for line in lines if "=" in line and not line.startswith("#"))
    assert settings["LimitCORE"] == "0"
    assert settings["NoNewPrivileges"] == "yes"
    assert settings["RestartPreventExitStatus"] == "2"
    assert settings["Environment"].startswith("PYTHON") or "NUMBA_CACHE_DIR" in settings["Environment"]
    cache = "fdhil-web" if name == "fdhil-web.service" else "fdhil"
    assert f"Environment=NUMBA_CACHE_DIR=/var/cache/{cache}/numba" in lines
    if name != "fdhil-sim.service":
        assert not {"BindsTo", "Requires", "PartOf"} & settings.keys()
    if name == "fdhil-web.service":
        assert (settings["User"], settings["IPAddressAllow"]) == ("fdhil-web", "localhost")
        assert not any("LoadCredential" in line for line in lines)  # acting takes a drop-in
    if name == "fdhil.service":
        assert "PrivateUsers=yes" not in lines  # SO_PEERCRED names the users of [access] only without
        assert (settings["Type"], settings["WatchdogSec"]) == ("notify", "10")


@pytest.mark.debian
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.fault("G13")
def test_systemd_accepts_the_unit(name: str, tmp_path: Path) -> None:
    unit = tmp_path / name
    unit.write_text((UNITS / name).read_text().replace("/opt/fdhil/bin/fdhil", sys.executable))
    verified = subprocess.run(["systemd-analyze", "verify", str(unit)], capture_output=True, text=True)
    assert (verified.returncode, verified.stderr.strip()) == (0, "")
    confined = ["systemd-analyze", "security", "--offline=yes", "--threshold=15", str(unit)]
    assert subprocess.run(confined, capture_output=True).returncode == 0


@pytest.mark.debian
@pytest.mark.fault("G13")
@pytest.mark.goal("R14")
def test_every_service_is_verified_and_confined(tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    exposed = {name: exposure(name, tmp_path) for name in SERVICES}
    record_property("goal", ", ".join(f"{name} {figure:g}" for name, figure in exposed.items()))
    assert max(exposed.values()) <= LARGEST_EXPOSURE, exposed
    assert {path.name for path in UNITS.glob("*.service")} - exposed.keys() == {"fdhil-mirror@.service"}


def exposure(name: str, folder: Path) -> float:
    unit = folder / name.replace("@", "@one")
    unit.write_text(re.sub(r"^(Exec\w+)=\S+", rf"\1={sys.executable}", (UNITS / name).read_text(), flags=re.MULTILINE))
    verified = subprocess.run(["systemd-analyze", "verify", str(unit)], capture_output=True, text=True)
    assert (verified.returncode, verified.stderr.strip()) == (0, ""), name
    judged = ["systemd-analyze", "security", "--offline=yes", str(unit)]
    output = subprocess.run(judged, capture_output=True, text=True).stdout
    found = re.search(r"exposure level for \S+: ([0-9.]+) ", output)
    assert found, output
    return float(found[1])
