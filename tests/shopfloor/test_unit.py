"""The publishers' unit: its own user, restricted access, and a stop that waits for the daemon's answer."""

from __future__ import annotations

from pathlib import Path

from fdhil.shopfloor.publisher_process import STOP_S
from fdhil.shopfloor.status_poller import ANSWER_S

UNIT = Path(__file__).parents[2] / "systemd" / "fdhil-publish@.service"


def test_unit_has_the_settings_that_the_publishers_need() -> None:
    lines = UNIT.read_text().splitlines()
    settings = dict(line.split("=", 1) for line in lines if "=" in line and not line.startswith("#"))
    assert settings["ExecStart"] == "/opt/fdhil/bin/fdhil publish %i /etc/fdhil/machine.toml"
    assert (settings["Type"], settings["User"], settings["IPAddressAllow"]) == ("notify", "fdhil-publish", "localhost")
    assert not {"BindsTo", "Requires", "PartOf"} & settings.keys()
    assert settings["RestartPreventExitStatus"] == "2"
    assert float(settings["TimeoutStopSec"]) > STOP_S > ANSWER_S  # a question that waits for its answer is not cut off
