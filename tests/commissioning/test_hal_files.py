"""fdhil init for a machine of HAL pins: pins and gains from LinuxCNC's files, and the HAL file that adds offsets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from fdhil.commissioning.init.config_assembly import finish_draft, make_draft
from fdhil.commissioning.init.config_draft import ConfigDraft
from fdhil.commissioning.init.hal_file import find_insertions, format_correction_hal
from fdhil.commissioning.init.hal_pins import convert_to_current_gains, propose_axis
from fdhil.commissioning.init.linuxcnc_import import LinuxcncMachine, read_linuxcnc
from fdhil.commissioning.init.linuxcnc_text import HalNetlist, Ini, parse_hal
from fdhil.config import MachineConfig, parse_config, parse_toml
from fdhil.errors import ConfigError

SERVO_INI = """
[EMCMOT]
SERVO_PERIOD = 1000000
[HAL]
HALFILE = servo.hal
[TRAJ]
COORDINATES = X Z
LINEAR_UNITS = {units}
[KINS]
KINEMATICS = trivkins coordinates=XZ
[AXIS_X]
MAX_VELOCITY = 20
MAX_ACCELERATION = 100
[JOINT_0]
TYPE = LINEAR
P = 50
[AXIS_Z]
MAX_VELOCITY = 20
MAX_ACCELERATION = 100
[JOINT_1]
TYPE = LINEAR
"""
SERVO_HAL = """
loadrt motmod
loadrt pid names=pid.x,pid.z
addf hm2_7i92.0.read servo-thread
addf motion-command-handler servo-thread
addf motion-controller servo-thread
addf pid.x.do-pid-calcs servo-thread
addf hm2_7i92.0.write servo-thread
setp pid.x.Pgain [JOINT_0]P
setp pid.x.FF1 0.98
setp pid.x.FF2 0.0012
setp pid.x.Dgain 2
setp pid.x.deadband 0.001
setp pid.x.error-previous-target false
net x-cmd joint.0.motor-pos-cmd => pid.x.command
net x-fb hm2_7i92.0.encoder.00.position => pid.x.feedback joint.0.motor-pos-fb
net x-out pid.x.output => hm2_7i92.0.7i77.0.1.analogout0
net z-cmd joint.1.motor-pos-cmd => hm2_7i92.0.stepgen.01.position-cmd
net z-fb hm2_7i92.0.stepgen.01.position-fb => joint.1.motor-pos-fb
"""
AXIS: dict[str, Any] = {
    "screw_pitch_mm": 5.0,
    "nominal": {"R": 0.5, "L": 0.005, "K": 0.4, "Jt": 0.002, "ft": 0.001, "Cd": 0.2},
    "regulators": {"current_limit_a": 20.0, "voltage_limit_v": 100.0},
}


def read_machine(tmp_path: Path, units: str = "mm") -> LinuxcncMachine:
    (tmp_path / "mill.ini").write_text(SERVO_INI.format(units=units))
    (tmp_path / "servo.hal").write_text(SERVO_HAL)
    return read_linuxcnc(tmp_path / "mill.ini")


def build_answers(**x: Any) -> dict[str, Any]:
    hal = {"current": "hm2_7i92.0.7i77.0.1.analogin0"}
    z = {**AXIS, "drive": {"hal": {"current": "hm2_7i92.0.7i77.0.1.analogin1"}}}
    return {"axis": {"X": {**AXIS, "drive": {"hal": hal}} | x, "Z": z}}


def make_config(
    tmp_path: Path, nc: LinuxcncMachine, given: dict[str, Any], pins: list[str] | None = None
) -> tuple[ConfigDraft, MachineConfig]:
    draft = make_draft(tmp_path / "mill.toml", given, nc, pins=pins or [])
    return draft, parse_config(parse_toml(finish_draft(draft, tmp_path / "mill.toml").encode(), "made"))


def test_pins_and_gains_are_read_from_files(tmp_path: Path) -> None:
    draft, config = make_config(tmp_path, read_machine(tmp_path), build_answers(correction={}))
    x, z = (config.axis[name].drive.hal for name in "XZ")
    assert x is not None
    assert z is not None
    assert (x.position_command, x.position_feedback) == ("joint.0.motor-pos-cmd", "hm2_7i92.0.encoder.00.position")
    assert (x.speed, x.enabled) == ("hm2_7i92.0.encoder.00.velocity", "joint.0.amp-enable-out")
    assert z.speed == "hm2_7i92.0.stepgen.01.velocity-fb"
    loop = config.axis["X"].regulators
    assert (loop.structure, loop.pid_output, loop.position_gain_per_s) == ("linuxcnc_pid", "speed", 50.0)
    assert (loop.speed_feedforward, loop.acceleration_feedforward_s, loop.deadband_mm) == (0.98, 0.0012, 0.001)
    assert not loop.error_previous_target
    assert config.g0.source == "linuxcnc"
    assert config.bus["hal"].offset_lead_cycles > 0
    reported = "\n".join(draft.notes)
    assert "the card measures no current" in reported
    assert "position is that of the pulses" in reported
    assert "remove this loop" not in reported


def test_gains_of_current_pid_are_converted(tmp_path: Path) -> None:
    x: dict[str, Any] = {"regulators": {**AXIS["regulators"], "pid_output": "current"}}
    x["drive"] = {"hal": {"current": "pid.x.output", "current_a_per_unit": 3.0}}
    _, config = make_config(tmp_path, read_machine(tmp_path), build_answers(**x))
    loop = config.axis["X"].regulators
    assert (loop.position_gain_per_s, loop.position_derivative, loop.speed_ki) == (25.0, 1.0, 0.0)
    assert loop.speed_kp == pytest.approx(2 * 3.0 * 5.0 / (2 * 3.14159265), rel=1e-5)


def test_current_pid_without_derivative_is_refused() -> None:
    with pytest.raises(ValueError, match="needs a Dgain"):
        convert_to_current_gains({"position_gain_per_s": 50.0}, 1.0, 1.0, 5.0)


def test_inches_are_converted(tmp_path: Path) -> None:
    _, config = make_config(tmp_path, read_machine(tmp_path, "inch"), build_answers())
    pins = config.axis["X"].drive.hal
    assert pins is not None
    assert (pins.position_mm_per_unit, pins.speed_mm_s_per_unit) == (25.4, 25.4)
    assert config.axis["X"].regulators.deadband_mm == pytest.approx(0.0254)


def test_axis_without_current_pin_is_refused_by_key(tmp_path: Path) -> None:
    given = build_answers()
    given["axis"]["X"] = AXIS
    with pytest.raises(ConfigError) as refused:
        make_config(tmp_path, read_machine(tmp_path), given)
    (fault,) = refused.value.faults
    assert fault.path == "axis.X.drive.hal.current"


def test_pin_missing_in_running_hal_is_refused_by_name(tmp_path: Path) -> None:
    running = ["joint.0.motor-pos-cmd", "joint.0.amp-enable-out", "hm2_7i92.0.encoder.00.position"]
    running += ["joint.1.motor-pos-cmd", "joint.1.amp-enable-out", "hm2_7i92.0.stepgen.01.position-fb"]
    with pytest.raises(ConfigError) as refused:
        make_config(tmp_path, read_machine(tmp_path), build_answers(), running)
    reported = {fault.path: fault.what for fault in refused.value.faults}
    assert reported == {
        f"axis.{x}.drive.hal.current": f"HAL has no pin hm2_7i92.0.7i77.0.1.analogin{k}" for k, x in enumerate("XZ")
    }


def test_unknown_component_is_named_in_notes() -> None:
    hal = HalNetlist()
    parse_hal("net fb mydrive.0.where => joint.0.motor-pos-fb\n", Ini({}), lambda _name: "", hal)
    (note,) = propose_axis(hal, "X", 0, 1.0).notes
    assert "component mydrive.0 is unknown" in note


def test_offset_is_inserted_between_motion_controller_and_loop(tmp_path: Path) -> None:
    nc = read_machine(tmp_path)
    _, config = make_config(tmp_path, nc, build_answers(correction={"max_offset_um": 40.0}))
    text = format_correction_hal(config, "mill.toml", nc.joint_count, find_insertions(nc.hal, nc.joints, "X"), nc.hal)
    written = HalNetlist(threads={"servo-thread": list(nc.hal.threads["servo-thread"])})
    parse_hal(text, Ini({}), lambda _name: "", written)
    order = written.threads["servo-thread"]
    assert order.index("fdhil-offset-x.update-feedback") < order.index("motion-controller")
    behind = ("motion-controller", "streamer.0", "fdhil-limit-x", "fdhil-offset-x.update-output", "pid.x.do-pid-calcs")
    assert [f for f in order if f in behind] == list(behind)
    assert written.find_linked_pins("fdhil-offset-x.out") == ["pid.x.command"]
    assert written.find_linked_pins("fdhil-offset-x.fb-out") == ["joint.0.motor-pos-fb"]
    assert {"fdhil-gate.out", "fdhil-limit-x.enable"} == written.nets["fdhil-on"]
    assert float(written.given["fdhil-limit-x.max"]) == pytest.approx(0.04)
    assert "--also ffssff" in text
    assert "limit-z" not in text


def test_component_loaded_twice_is_noted(tmp_path: Path) -> None:
    nc = read_machine(tmp_path)
    nc.hal.loaded.add("limit3")
    _, config = make_config(tmp_path, nc, build_answers(correction={}))
    text = format_correction_hal(config, "mill.toml", nc.joint_count, find_insertions(nc.hal, nc.joints, "X"), nc.hal)
    assert "# Your HAL files already load limit3" in text


@pytest.mark.parametrize(
    ("hal", "text"),
    [
        ("net x joint.0.motor-pos-cmd => joint.0.motor-pos-fb\n", "commands no drive"),
        ("net x joint.0.motor-pos-cmd => pid.0.command\n", "joint.0.motor-pos-fb is not connected"),
        ("", "joint.0.motor-pos-cmd is not connected"),
    ],
)
def test_joint_without_place_for_offset_is_refused_by_pin(hal: str, text: str) -> None:
    found = HalNetlist()
    parse_hal(hal, Ini({}), lambda _name: "", found)
    with pytest.raises(ConfigError, match=text):
        find_insertions(found, {"X": 0}, "X")
