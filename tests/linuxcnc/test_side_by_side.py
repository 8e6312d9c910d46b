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
from tests.linuxcnc.cli_session import (
    PART,
    SHUTTLE,
    TRIES,
    compute_contour_errors,
    is_pass_repeated,
    record_demand,
    run_fdhil,
    wait_for_state,
)
from tests.linuxcnc.linuxcnc_process import LinuxCnc
from tests.sim.simulator_process import SimulatorProcess

pytestmark = pytest.mark.debian


@dataclass
class ChainRig:
    """The simulated machine with its trace, and fdhil commissioned and recording."""

    file: Path
    twin: SimulatorProcess
    bridge_port: int

    @property
    def trace(self) -> Path:
        return self.file.with_name("trace.csv")

    def read_status(self) -> dict[str, Any]:
        return run_fdhil("status", self.file)


@pytest.fixture
def chain_rig(tmp_path: Path) -> Iterator[ChainRig]:
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
        run_fdhil("commission", file, "--yes")
        for name, command in (("guard", ["fdhil.cli.guard"]), ("daemon", ["fdhil", "run"])):
            stack.enter_context(ChildProcess(name, [*command, str(file)], tmp_path / f"{name}.log"))
        run_directory = machine_config.load_config(file).store.run_directory
        assert run_directory is not None
        wait_for_state((run_directory / SOCKET_NAME).exists)
        yield ChainRig(file, twin, document["nc_source"]["linuxcnc"]["port"])


def test_second_cut_of_program_is_corrected(chain_rig: ChainRig) -> None:
    part = chain_rig.file.with_name("part.csv")
    loads = f"loadusr -Wn {bridge.NAME} /usr/bin/python3 {bridge.__file__} --port {chain_rig.bridge_port} --channel 1\n"
    with LinuxCnc(hal=loads, axes="XY") as nc, nc.drive_simulator(chain_rig.twin):
        nc.run(SHUTTLE)
        wait_for_state(lambda: all(axis["accepted"] >= 4 for axis in chain_rig.read_status()["axes"].values()))
        for tried in range(1, TRIES + 1):
            record_demand(chain_rig.file, part, lambda: nc.run(PART))
            promised = run_fdhil("correct", part, "--config", chain_rig.file, "--from-history")
            run_fdhil("arm", chain_rig.file, part)
            nc.run(PART)
            wait_for_state(lambda: len(chain_rig.read_status()["passes"]) == tried)  # noqa: B023 - called at once
            if is_pass_repeated(chain_rig.read_status()):
                break
    chain_rig.twin.wait_for_event("finished")
    before, *_, after = compute_contour_errors(
        chain_rig.trace, load_trajectory(part, machine_config.load_config(chain_rig.file))
    )
    assert promised["contour"]["rms_um"] == pytest.approx(before, rel=0.05)
    assert after < before / 50
