"""LinuxCNC, the simulated drives, fdhil's daemon and guard, each a process: identify, cut, record, correct, cut."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from fdhil import config as machine_config
from fdhil.bridges import linuxcnc as bridge
from fdhil.cli.demo.machines import load_machine_document
from fdhil.cli.demo.processes import ChildProcess
from fdhil.cli.demo.toml_writer import format_toml
from fdhil.daemon.daemon_socket import SOCKET_NAME
from fdhil.program import load_trajectory
from tests.free_ports import find_free_port
from tests.linuxcnc.beside import PART, SHUTTLE, TRIES, contour_of_each_cut, fdhil, record, repeated, until
from tests.linuxcnc.machine import LinuxCnc
from tests.sim.simulator_process import SimulatorProcess

pytestmark = pytest.mark.debian


@dataclass
class Shop:
    """The simulated machine with its trace, and fdhil commissioned and recording."""

    file: Path
    twin: SimulatorProcess
    bridge_port: int

    @property
    def trace(self) -> Path:
        return self.file.with_name("trace.csv")

    def status(self) -> dict[str, Any]:
        return fdhil("status", self.file)


@pytest.fixture
def shop(tmp_path: Path) -> Iterator[Shop]:
    document = load_machine_document()
    document["sim"]["pace"] = "lockstep"
    document["nc"] = {"profile": "linuxcnc"}
    document["g0"] = {"source": "linuxcnc"}
    document["nc_source"] = {"linuxcnc": {"port": find_free_port()}}
    for axis in document["axis"].values():
        axis["max_acceleration_mm_s2"] = 2000.0
    (tmp_path / "twin.toml").write_text(format_toml(document))
    file = tmp_path / "machine.toml"
    with ExitStack() as stack:
        twin = stack.enter_context(
            SimulatorProcess(tmp_path / "twin.toml", "--demand", "-", "--trace", tmp_path / "trace.csv")
        )
        document["bus"] = twin.ready["buses"]
        file.write_text(format_toml(document))
        fdhil("commission", file, "--yes")
        for name, command in (("guard", ["fdhil.cli.guard"]), ("daemon", ["fdhil", "run"])):
            stack.enter_context(ChildProcess(name, [*command, str(file)], tmp_path / f"{name}.log"))
        run_directory = machine_config.load_config(file).store.run_directory
        assert run_directory is not None
        until((run_directory / SOCKET_NAME).exists)
        yield Shop(file, twin, document["nc_source"]["linuxcnc"]["port"])


def test_the_second_cut_of_a_program_is_corrected(shop: Shop) -> None:
    part = shop.file.with_name("part.csv")
    loads = f"loadusr -Wn {bridge.NAME} /usr/bin/python3 {bridge.__file__} --port {shop.bridge_port} --channel 1\n"
    with LinuxCnc(hal=loads, axes="XY") as nc, nc.driving(shop.twin):
        nc.run(SHUTTLE)
        until(lambda: all(axis["accepted"] >= 4 for axis in shop.status()["axes"].values()))
        for tried in range(1, TRIES + 1):
            record(shop.file, part, lambda: nc.run(PART))
            promised = fdhil("correct", part, "--config", shop.file, "--from-history")
            fdhil("arm", shop.file, part)
            nc.run(PART)
            until(lambda: len(shop.status()["passes"]) == tried)  # noqa: B023 - called at once
            if repeated(shop.status()):
                break
    shop.twin.wait_for_event("finished")
    before, *_, after = contour_of_each_cut(shop.trace, load_trajectory(part, machine_config.load_config(shop.file)))
    assert promised["contour"]["rms_um"] == pytest.approx(before, rel=0.05)
    assert after < before / 50
