"""The systemd unit of the uplink: a separate user, without access to the daemon."""

from __future__ import annotations

from pathlib import Path

UNIT = Path(__file__).parents[2] / "systemd" / "fdhil-uplink.service"


def test_uplink_unit_has_required_settings() -> None:
    lines = UNIT.read_text().splitlines()
    settings = dict(line.split("=", 1) for line in lines if "=" in line and not line.startswith("#"))
    assert settings["ExecStart"] == "/opt/fdhil/bin/fdhil uplink /etc/fdhil/machine.toml"
    assert (settings["Type"], settings["User"], settings["IPAddressAllow"]) == ("notify", "fdhil-uplink", "localhost")
    assert (settings["StateDirectory"], settings["StateDirectoryMode"]) == ("fdhil-uplink", "0750")
    assert not {"BindsTo", "Requires", "PartOf", "ReadWritePaths"} & settings.keys()
    assert (settings["RestartPreventExitStatus"], settings["UMask"]) == ("2", "0027")
