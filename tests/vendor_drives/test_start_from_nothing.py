"""Complete set-up with drives of every vendor: init, check, commissioning, arming and a corrected move."""

from __future__ import annotations

import json
import uuid
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil import config as machine_config
from fdhil import correction
from fdhil.arming.guard_configuration import make_guard_settings
from fdhil.cia402 import pack_pdo
from fdhil.cli.demo.toml_writer import format_toml
from fdhil.commissioning.commissioning_record import save_record
from fdhil.commissioning.commissioning_steps import commission_axis
from fdhil.commissioning.config_check import check_machine
from fdhil.config import MachineConfig
from fdhil.errors import DriveFault
from fdhil.guard import guard_step
from fdhil.guard.corrected_path import CorrectedPath
from fdhil.guard.frame_monitor import FrameMonitor
from fdhil.guard.guard_protocol import Mode
from fdhil.guard.guard_state import GuardRequest, StepInputs, StepOutput, make_initial_state
from fdhil.records import Float, Parameters, Trajectory
from tests.bench import AXIS, bench_document
from tests.daemon.machine_rig import fdhil
from tests.drivers.peer import DrivePeer
from tests.guard.simulated_bus import FACTS_GIVEN
from tests.sim.bench_simulator import PERIOD_S, SteppedSimulator, build_trajectory, smooth_rows
from tests.sim.drive_rig import NO_NOISE
from tests.vendor_drives.test_drive_set_up import run_on_a_bus, short_delays
from tests.vendor_drives.vendor_machines import OUTFITS, VendorDrive, start_drives

pytestmark = pytest.mark.usefixtures("long_computation")

Capture = pytest.CaptureFixture[str]
__all__ = ["short_delays"]  # a fixture: shorter waits than on a real machine
PROGRAM = "program-1"
EVERY = pytest.mark.parametrize("outfit", OUTFITS, ids=lambda outfit: outfit.name)
# what a retrofitter reads from labels, data sheets and the drive's tool, where the drive does not tell it
KNOWN = {
    "drive.increments_per_rev": 65536,
    "drive.rated_current_a": 50.0,
    "drive.rated_torque_nm": 1.0,
    "drive.dc_link_v": 300.0,
    "regulators.current_limit_a": 200.0,
    "regulators.voltage_limit_v": 300.0,
    **{f"nominal.{key}": value for key, value in AXIS["nominal"].items()},
}


def answer_interview(outfit: VendorDrive, machine: MachineConfig) -> dict[str, Any]:
    """Return the answers to the questions that the drives cannot answer."""
    axis = machine.axis["X"]
    bus = machine.bus["can0"]
    drive = {key: value for key, value in outfit.drive.items() if key == "logical_axis"}
    if outfit.profile in ("cia402", "schunk"):
        drive["profile"] = outfit.profile
    return {
        "bus": {"can0": {"interface": bus.interface, "channel": bus.channel}},
        "guard": {"clock": "sync"},
        "axis": {
            "X": {
                "screw_pitch_mm": axis.screw_pitch_mm,
                "rapid_speed_mm_s": axis.rapid_speed_mm_s,
                "max_acceleration_mm_s2": axis.max_acceleration_mm_s2,
                "correction": dict(AXIS["correction"]),
            }
            | ({"drive": drive} if drive else {})
        },
    }


def create_config(outfit: VendorDrive, machine: MachineConfig, folder: Path, capsys: Capture) -> MachineConfig:
    """Run init, check which keys it reports as missing, and run it again with them."""
    file, answers = folder / "machine.toml", answer_interview(outfit, machine)
    given = folder / "answers.toml"
    given.write_text(format_toml(answers))
    code, out, err = fdhil("init", file, "--answers", given, "--json", capsys=capsys)
    assert code == 2, out + err
    missing = [fault["path"] for fault in json.loads(out)["error"]["faults"]]
    assert not file.exists()
    for path in missing:
        key = path.removeprefix("axis.X.")
        table, _, name = key.partition(".")
        answers["axis"]["X"].setdefault(table, {})[name] = KNOWN[key]
    given.write_text(format_toml(answers))
    code, out, err = fdhil("init", file, "--answers", given, capsys=capsys)
    assert code == 0, out + err
    return machine_config.load_config(file)


@pytest.fixture(autouse=True)
def short_sdo_delays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the SDO time-outs: a drive in this process answers at once."""
    monkeypatch.setattr("fdhil.commissioning.scan.PACE_S", 1e-4)


class GuardThread:
    """The machine with the guard's core in this process: one decision after each SYNC, as in the guard's process."""

    def __init__(self, twin: SteppedSimulator, config: MachineConfig, folder: Path, path: CorrectedPath) -> None:
        self.settings = make_guard_settings(config, "can0", folder, "")
        self.listener, self.state = FrameMonitor(self.settings), make_initial_state(self.settings)
        self.twin, self.path, self.outputs = twin, path, list[StepOutput]()
        self.request: GuardRequest | None = None
        self.heard = len(twin.wire)
        self.tick = 0
        twin.each_cycle = self.run_cycle

    def run_cycle(self) -> None:
        """Take the frames of one cycle, the SYNC first."""
        for can_id, data in self.twin.wire[self.heard :]:
            if can_id == 0x080:
                self._decide(data)
            else:
                self.listener.take_frame(can_id, data, self.tick * PERIOD_S)
        self.heard = len(self.twin.wire)

    def _decide(self, sync: bytes) -> None:
        self.tick += 1
        now_s = self.tick * PERIOD_S
        axes, bus = self.listener.receive_at_sync(sync, now_s, now_s)
        inputs = StepInputs(True, axes, bus, alarms=self.listener.take_alarms(), path=self.path, request=self.request)
        self.request = None
        self.state, output = guard_step.step_guard(self.state, inputs, self.settings)
        self.outputs.append(output)
        if output.offsets is not None:
            for axis, offset in zip(self.settings.axes, output.offsets, strict=True):
                self.twin.machine.receive_frame("can0", (axis.offset.cob_id, pack_pdo(axis.offset.entries, [offset])))


def build_shuttle_demand() -> Trajectory:
    """A feed move out and back, at rest at both ends."""
    way = np.concatenate([np.linspace(0, 9, 120), np.linspace(9, 0, 120)])
    rest = np.zeros(70)
    return build_trajectory(smooth_rows(np.concatenate([rest, way, rest])[:, None]), axes="X")


def plan_correction(config: MachineConfig, demand: Trajectory) -> Float:
    """Return the offset (n,) um that the model in the file demands."""
    models = {axis: Parameters(**settings.nominal.model_dump()) for axis, settings in config.axis.items()}
    found = correction.plan_correction(demand, models, config, "inverse")
    assert not found.refused
    return found.offset_um["X"]


def compute_path_error_um(twin: SteppedSimulator, demand: Trajectory) -> float:
    """Run the move; return the largest deviation of the table from the demand, without the constant delay."""
    begin = len(twin.table)
    twin.machine.nc.play_demand("move", demand)
    twin.run_until("finished")
    table, path = np.array(twin.table[begin:])[:, 0], demand.position_mm["X"]
    n = len(path) - 60
    return 1e3 * min(float(np.abs(table[late : late + n] - path[:n]).max()) for late in range(60))


def run_online_correction(machine: MachineConfig, config: MachineConfig, folder: Path) -> None:
    """Commission over the bus, then arm the guard on the machine and run the move."""
    save_record(commission_axis(config, "X"), config.store.directory)
    demand = build_shuttle_demand()
    offset_um = plan_correction(config, demand)
    per_mm = config.axis["X"].scaling.increments_per_mm
    rows = tuple(tuple(round(x) for x in column * per_mm) for column in (demand.position_mm["X"], offset_um * 1e-3))
    path = CorrectedPath(0, rows[:1], rows[1:], True, PROGRAM)
    twin = start_drives(machine)
    before = compute_path_error_um(twin, demand)
    guard = GuardThread(twin, config, folder, path)
    twin.run_cycles(200)
    guard.request = GuardRequest("arm", True, PROGRAM, FACTS_GIVEN)
    twin.run_cycles(20)
    assert guard.state.mode is Mode.ARMED, guard.outputs[-20:]
    after = compute_path_error_um(twin, demand)
    assert any(output.offsets and any(output.offsets) for output in guard.outputs)
    assert after < before / 4, (before, after)


def run_corrected_demand(config: MachineConfig) -> None:
    """A drive without an offset object is refused for on-line correction; the NC gets the corrected demand."""
    with pytest.raises(DriveFault, match="corrected demand"):
        commission_axis(config, "X")
    assert np.abs(plan_correction(config, build_shuttle_demand())).max() > 10


@EVERY
def test_vendor_drive_is_set_up_from_nothing(outfit: VendorDrive, tmp_path: Path, capsys: Capture) -> None:
    with run_on_a_bus(outfit, tmp_path) as (_, machine):
        commission_drive(outfit, machine, tmp_path, capsys)


def test_simulated_drive_needs_least_set_up(tmp_path: Path, capsys: Capture) -> None:
    bus = {"can0": {"interface": "virtual", "channel": uuid.uuid4().hex}}
    machine = machine_config.parse_config(bench_document("X") | {"bus": bus, "sim": {"noise": NO_NOISE}})
    with DrivePeer(machine):
        commission_drive(VendorDrive("fdhil_twin", "", on_line=True), machine, tmp_path, capsys)


def commission_drive(outfit: VendorDrive, machine: MachineConfig, folder: Path, capsys: Capture) -> None:
    """Init, check, commission, arm and move; a drive without an offset object gets the corrected demand."""
    config = create_config(outfit, machine, folder, capsys)
    drive = config.axis["X"].drive
    assert (drive.profile, drive.logical_axis) == (outfit.profile, machine.axis["X"].drive.logical_axis)
    differ = {finding.point for _, finding in check_machine(config) if finding.ok is False}
    assert differ <= set(outfit.lacks)
    if outfit.on_line:
        run_online_correction(machine, config, folder)
    elif outfit.led:
        run_corrected_demand(config)
