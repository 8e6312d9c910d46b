"""The machine around the drives: offsets and trace on the SYNC grid, repeatability, slide-ways, fault script."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from fdhil.errors import ConfigError
from fdhil.sim import fault_script
from fdhil.sim.drive.drive_sensors import DriveFaults
from fdhil.sim.fault_kinds import FAULTS
from fdhil.sim.operator_commands import CommandError, OperatorCommands
from fdhil.sim.simulated_machine import SimulatedMachine
from fdhil.sim.simulator_service import SyncPace
from fdhil.sim.wire.sensor_faults import SensorFaults
from tests.guard.simulated_bus import settings
from tests.sim.bench_simulator import (
    PERIOD_S,
    SteppedSimulator,
    build_corner_rows,
    build_simulator_config,
    build_trajectory,
)

PER_MM = 65536 / 20


def read_trace(path: Path) -> dict[str, np.ndarray]:
    table = np.genfromtxt(path, delimiter=",", names=True)
    return {name: table[name] for name in table.dtype.names or ()}


def test_trace_has_one_row_per_demand_row_plus_300_ms(tmp_path: Path) -> None:
    twin = SteppedSimulator(build_simulator_config())
    twin.switch_on()
    rows = build_corner_rows()
    file = tmp_path / "trace.csv"
    twin.machine.record_next_file(file)
    twin.play_rows(rows)
    assert not file.exists()
    event = twin.run_until("finished")
    assert event["trace"] == str(file)
    assert list(tmp_path.iterdir()) == [file]
    trace = read_trace(file)
    assert list(trace) == [
        "time_s", "X_reference_mm", "X_table_mm", "X_offset_um", "Y_reference_mm", "Y_table_mm", "Y_offset_um",
    ]  # fmt: skip
    assert len(trace["time_s"]) == len(rows) + 300
    assert trace["time_s"] == pytest.approx(np.arange(len(rows) + 300) * PERIOD_S)
    assert trace["X_reference_mm"][: len(rows)] == pytest.approx(rows[:, 0], abs=1e-9)
    assert trace["Y_table_mm"][0] == 0.0
    error_um = (trace["Y_table_mm"] - trace["Y_reference_mm"]) * 1e3
    assert 5 < np.abs(error_um).max() < 300
    assert np.abs(error_um[-50:]).max() < 1.0
    twin.play_rows(rows)
    assert twin.run_until("finished")["trace"] is None, "a trace is of the next file only"


def test_offset_acts_on_the_row_it_was_sent_with(tmp_path: Path) -> None:
    """A guard that answers SYNC k - 1 with o[k + 2] corrects exactly row k + 2."""
    twin = SteppedSimulator(build_simulator_config())
    twin.switch_on()
    rows = build_corner_rows()
    offset = np.round(0.02 * np.sin(np.arange(len(rows) + 400) / 37) * PER_MM).astype(int)
    file = tmp_path / "trace.csv"
    twin.machine.record_next_file(file)
    twin.play_rows(rows)
    twin.run_until("playing")  # row 0 is in force now: SYNC 0 has been
    row = 0

    def send_offsets() -> None:
        nonlocal row
        twin.send_frame(0x301, struct.pack("<i", offset[row + 3]))
        row += 1

    send_offsets()
    twin.each_cycle = send_offsets
    finished = twin.run_until("finished")
    assert finished["late_rpdo"] == {"X": 0, "Y": 0}
    applied = read_trace(file)["X_offset_um"]
    assert np.all(applied[:3] == 0)
    assert applied[3:] == pytest.approx(offset[3 : len(applied)] / PER_MM * 1e3, abs=1e-6)
    assert np.all(read_trace(file)["Y_offset_um"] == 0)


def test_missing_offset_frames_are_counted() -> None:
    twin = SteppedSimulator(build_simulator_config())
    twin.switch_on()
    twin.play_rows(build_corner_rows())
    twin.run_until("playing")
    cycle = 0

    def send_offsets() -> None:
        nonlocal cycle
        cycle += 1
        if cycle not in (50, 90, 91, 92) and cycle < 200:
            twin.send_frame(0x301, struct.pack("<i", 0))

    twin.each_cycle = send_offsets
    assert twin.run_until("finished")["late_rpdo"] == {"X": 4, "Y": 0}, "the end of the stream is not a late frame"


def test_lockstep_waits_for_rpdo_sent_in_previous_cycle() -> None:
    twin = SteppedSimulator(build_simulator_config())
    twin.switch_on()
    assert not twin.machine.is_waiting_for_rpdo()
    twin.send_frame(0x301, struct.pack("<i", 0))
    twin.run_cycles(1)
    assert twin.machine.is_waiting_for_rpdo()
    twin.send_frame(0x301, struct.pack("<i", 0))
    assert not twin.machine.is_waiting_for_rpdo()
    twin.run_cycles(1)
    assert twin.machine.is_waiting_for_rpdo()
    twin.run_cycles(1)
    assert not twin.machine.is_waiting_for_rpdo(), "it was missing in the cycle before"


def test_lockstep_waits_for_listed_rpdo_after_its_first_frame() -> None:
    twin = SteppedSimulator(build_simulator_config(sim={"lockstep_rpdo": ["X:2"]}))
    twin.switch_on()
    assert not twin.machine.is_waiting_for_rpdo()
    for can_id in (0x301, 0x302):
        twin.send_frame(can_id, struct.pack("<i", 0))
    twin.run_cycles(1)
    assert twin.machine.is_waiting_for_rpdo()
    twin.run_cycles(1)
    assert twin.machine.is_waiting_for_rpdo(), "a listed stream is waited for a little longer"
    twin.send_frame(0x301, struct.pack("<i", 0))
    assert not twin.machine.is_waiting_for_rpdo(), "Y is not listed"
    for _ in range(5):
        twin.run_cycles(1)
    assert not twin.machine.is_waiting_for_rpdo()


@pytest.mark.parametrize("listed", ["Q:2", "X", "X:5", "X:two"])
def test_unknown_listed_rpdo_is_refused(listed: str) -> None:
    with pytest.raises(ConfigError, match="lockstep_rpdo"):
        SimulatedMachine(build_simulator_config(sim={"lockstep_rpdo": [listed]}))


@pytest.mark.usefixtures("long_computation")
def test_two_runs_are_bit_identical() -> None:
    """Noise, stick-slip and sensors depend on the seed and the SYNCs only."""

    def record_run(seed: int) -> tuple[list[tuple[int, bytes]], list[int]]:
        noise = {"voltage_v": 0.06, "current_a": 0.05, "speed_rad_s": 0.15}
        twin = SteppedSimulator(build_simulator_config(sim={"seed": seed, "noise": noise}))
        twin.switch_on()
        twin.play_rows(build_corner_rows() + 3.0)
        twin.run_until("finished")
        sensor = twin.machine.units["Y"].sensor
        return twin.wire, sensor.read_registers()

    assert record_run(1) == record_run(1)
    assert record_run(1)[0] != record_run(2)[0]


def test_foreign_master_takes_over_sync_nmt_and_setpoints() -> None:
    twin = SteppedSimulator(build_simulator_config("X"))
    twin.send_frame(0x000, b"\1\1")
    twin.send_frame(0x601, bytes.fromhex("2f60600008000000"))
    for word in (0x06, 0x07, 0x0F):
        twin.send_frame(0x201, struct.pack("<Hi", word, 0))
        answers = twin.send_frame(0x80, b"")
        assert [can_id for can_id, _ in answers[:2]] == [0x181, 0x281]
    way = 0
    for k in range(400):
        way = min(k * 200, 50000)
        twin.send_frame(0x201, struct.pack("<Hi", 0x0F, way))
        twin.send_frame(0x80, b"")
    assert twin.machine.units["X"].drive.table_mm == pytest.approx(way / PER_MM, abs=0.005)
    assert twin.machine.tick == 403
    sensor = twin.machine.units["X"].sensor
    assert sensor.read_registers()[3] == 402


def test_slide_way_warms_with_speed_and_friction_falls() -> None:
    sim = {
        "thermal": {"ambient_c": 20.0, "rise_c": 50.0, "time_constant_s": 1.0},
        "axis": {"X": {"ft_per_kelvin": -0.1, "Cd_per_kelvin": -0.1}},
    }
    twin = SteppedSimulator(build_simulator_config(sim=sim))
    twin.switch_on()
    sweep = 100 * (1 - np.cos(np.linspace(0, 2 * np.pi, 1500))) / 2
    twin.play_rows(np.column_stack([sweep, np.zeros_like(sweep)]))
    twin.run_until("finished")
    x, y = twin.machine.units["X"], twin.machine.units["Y"]
    assert 22.0 < x.slide_way.celsius < 40.0
    assert y.slide_way.celsius == pytest.approx(20.0, abs=0.1)
    shown = x.drive.dictionary.get_number(0x2110, 1) / 100
    assert shown == pytest.approx(x.slide_way.celsius, abs=0.5)
    assert x.drive.physics.parameters.Cd == pytest.approx(max(5.0 * (1 - 0.1 * (shown - 20)), 0), abs=0.05)
    assert y.drive.physics.parameters.Cd == 5.0


# -- the panel


def create_panel(machine: SimulatedMachine) -> OperatorCommands:
    return OperatorCommands(machine, lambda path: None, lambda: None)


def test_the_panel_sets_parameters_and_temperature() -> None:
    machine = SimulatedMachine(build_simulator_config(sim={"axis": {"X": {"Cd_per_kelvin": -0.1}}}))
    machine.power_on()
    panel = create_panel(machine)
    panel.execute_line('{"command": "set", "axis": "X", "parameters": {"Jt": 0.085, "ft": 0.01}}')
    panel.execute_line('{"command": "temperature", "celsius": 22.0}')
    x = machine.units["X"].drive.physics.parameters
    assert (x.Jt, x.ft) == (0.085, 0.01)
    assert x.Cd == pytest.approx(4.0)
    assert machine.units["Y"].drive.physics.parameters.Jt == 0.075
    assert machine.units["Y"].drive.dictionary.get_number(0x2110, 1) == 2200
    panel.execute_line("")


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("nonsense", "not valid JSON"),
        ("[" * 60_000, "not valid JSON"),
        ("[1]", "unknown panel command None"),
        ('{"command": ["nc"]}', "unknown panel command"),
        ('{"command": "dance"}', "'dance'; the commands are nc, play"),
        ('{"command": "nc"}', '"on" must be true or false'),
        ('{"command": "nc", "on": 1}', '"on" must be true or false'),
        ('{"command": "play"}', '"file" must be a path'),
        ('{"command": "override", "percent": NaN}', '"percent" must be a number'),
        ('{"command": "override", "percent": -1}', "0 to 150"),
        ('{"command": "set", "parameters": {"Jt": 1}}', "unknown axis None"),
        ('{"command": "set", "axis": "X"}', "must be an object"),
        ('{"command": "set", "axis": "X", "parameters": {"J": 1}}', "unknown parameter J"),
        ('{"command": "set", "axis": "X", "parameters": {"Jt": -1}}', "Jt = -1"),
        ('{"command": "temperature", "celsius": 900}', "out of range"),
        ('{"command": "temperature", "celsius": 20, "axis": "Q"}', "unknown axis 'Q'"),
        ('{"command": "fault", "fault": "meteor"}', "unknown fault 'meteor'"),
        ('{"command": "fault", "fault": "reboot"}', "needs an axis"),
        ('{"command": "fault", "fault": "reboot", "axis": "Q"}', "unknown axis 'Q'"),
        ('{"command": "' + "x" * 70000 + '"}', "longer than 64 KiB"),
    ],
)
def test_invalid_panel_command_is_explained(line: str, complaint: str) -> None:
    with pytest.raises(CommandError, match=complaint.replace("?", r"\?")):
        create_panel(SimulatedMachine(build_simulator_config())).execute_line(line)


# -- the fault script


def test_fault_script_starts_and_ends_on_time(tmp_path: Path) -> None:
    script = tmp_path / "faults.toml"
    script.write_text(
        '[[fault]]\nat_sync = 100\naxis = "X"\nfault = "position_stuck"\nduration_s = 0.05\n'
        '[[fault]]\nat_row = 200\naxis = "Y"\nfault = "trip"\nvalue = 0x3210\n'
        "[[fault]]\nat_s = 0.05\nfault = 'frame'\ncan_id = 0x123\ndata = '0a0b'\nduration_s = 0.01\n"
    )
    twin = SteppedSimulator(build_simulator_config())
    for entry in fault_script.load_script(script, ("X", "Y")):
        twin.machine.faults.add_entry(entry)
    twin.switch_on()
    twin.play_rows(build_corner_rows())
    signal = []
    twin.each_cycle = lambda: signal.append("position" in twin.machine.units["X"].drive.faults.signals)
    twin.run_until("error")
    assert [event["fault"] for event in twin.events if event["event"] == "fault"] == ["frame", "position_stuck", "trip"]
    assert any(can_id == 0x82 and data[:2] == b"\x10\x32" for can_id, data in twin.wire)
    assert [data for can_id, data in twin.wire if can_id == 0x123] == [b"\x0a\x0b"] * 10
    twin.run_cycles(100)
    assert not twin.machine.units["X"].drive.faults.signals["position"].stuck


@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_restores_state_at_its_end(name: str) -> None:
    twin = SteppedSimulator(build_simulator_config("X"))
    twin.switch_on()
    item = {"axis": "X", "fault": name, "value": 2.0, "duration_s": 0.003, "can_id": 0x555, "data": "01"}
    item |= {"index": 0x6065}
    objects = dict(twin.machine.units["X"].drive.dictionary.numbers)
    twin.machine.faults.add_entry(fault_script.parse_entry(item, ("X",)))
    twin.run_cycles(20)
    assert twin.machine.faults.is_idle
    unit = twin.machine.units["X"]
    ended = {signal: fault for signal, fault in unit.drive.faults.signals.items() if fault.stuck or fault.gain != 1.0}
    assert not ended
    unit.drive.faults.signals.clear()
    assert unit.drive.faults == DriveFaults()
    assert unit.sensor.faults == SensorFaults()
    assert unit.drive.feedback.digital_inputs == 0
    assert unit.sync_on
    assert twin.machine.wires[unit.bus].is_idle
    for key in (0x606500, 0x1A0101, 0x1A0102, 0x1A0103):
        assert unit.drive.dictionary.numbers[key] == objects[key]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("fault = 3", "entry"),
        ("[[fault]]\naxis='X'", r"fault\[0\]\.fault: Field required"),
        ("[[fault]]\naxis='X'\nfault='load_torqe'\nvalue=1", "did you mean 'load_torque'"),
        ("[[fault]]\naxis='X'\nfault='load_torque'", "needs a value: N.m"),
        ("[[fault]]\nfault='reboot'", "needs an axis"),
        ("[[fault]]\nfault='reboot'\naxis='Q'", "unknown axis 'Q'"),
        ("[[fault]]\nfault='reboot'\naxis='X'\nat_s=1\nat_sync=2", "one of at_s"),
        ("[[fault]]\nfault='reboot'\naxis='X'\nat_s=-1", "greater than or equal"),
        ("[[fault]]\nfault='reboot'\naxis='X'\nwhen=1", "when"),
        ("[[fault]]\nfault='load_torque'\naxis='X'\nvalue=nan", "finite"),
        ("[[fault]]\nfault='frame'", "needs can_id"),
        ("[[fault]]\nfault='object'\naxis='X'\nvalue=1", "needs the index"),
        ("[[fault]]\nfault='drop_tpdo'\naxis='X'\nvalue=5", "5 is not among 1 to 4"),
        ("[[fault]]\nfault='remap'\naxis='X'\nvalue=1.5", "1.5 is not a whole number"),
        ("[[fault]]\nfault='sensor_exception'\naxis='X'\nvalue=9", "9 is not among 1, 2, 3"),
        ("[[fault]]\nfault='frame'\ncan_id=1\ndata='zz'", "hex"),
        ("[[fault]]\nfault='frame'\ncan_id=1\ndata='000102030405060708'", "at most 8"),
        ("faults = []", "faults: unknown key"),
        ("[[fault]\n", "is not valid TOML"),
    ],
)
def test_invalid_fault_script_is_refused(text: str, complaint: str, tmp_path: Path) -> None:
    script = tmp_path / "faults.toml"
    script.write_text(text)
    with pytest.raises(ConfigError, match=complaint):
        fault_script.load_script(script, ("X", "Y"))


@pytest.mark.parametrize(
    ("item", "complaint"),
    [
        ({"index": 0x5FFF, "value": 1}, "no numeric object 5FFF:00"),
        ({"index": 0x1008, "value": 1}, "no numeric object 1008:00"),
        ({"index": 0x6060, "value": 200}, "200 does not fit 6060:00"),
    ],
)
def test_value_that_object_cannot_hold_is_refused(item: dict[str, int], complaint: str) -> None:
    machine = SimulatedMachine(build_simulator_config("X"))
    with pytest.raises(ConfigError, match=complaint):
        machine.faults.add_entry(fault_script.parse_entry({"fault": "object", "axis": "X", **item}, ("X",)))


def test_all_invalid_entries_are_reported_together(tmp_path: Path) -> None:
    script = tmp_path / "faults.toml"
    script.write_text("[[fault]]\nfault='reboot'\n[[fault]]\nfault='meteor'\n")
    with pytest.raises(ConfigError) as caught:
        fault_script.load_script(script, ("X",))
    assert [fault.path for fault in caught.value.faults] == ["fault[0].entry", "fault[1].fault"]


# -- the pace


def test_late_host_delays_sync_without_catching_up() -> None:
    pace = SyncPace(0.001, lockstep=False)
    pace.record_sync(10.0)
    now, sent = 10.0, []
    for k in range(100):
        now = max(now, pace.compute_due_s(waits=False, idle=False)) + (0.0201 if k == 50 else 0.00005)
        pace.record_sync(now)
        sent.append(now)
    gaps = np.diff(sent)
    assert gaps.min() >= 0.00075
    assert gaps[:49].mean() == pytest.approx(0.001, abs=2e-5)
    assert sent[-1] - sent[0] > 0.0201 + 97 * 0.001


def test_lockstep_runs_when_rpdos_are_complete_and_waits_longer_for_offset_sender() -> None:
    pace = SyncPace(0.001, lockstep=True)
    pace.record_sync(10.0)
    assert pace.compute_due_s(waits=False, idle=False) <= 10.0
    assert pace.compute_due_s(waits=True, idle=False) == 12.0
    assert pace.compute_due_s(waits=True, idle=False, holds=True) == 18.0
    assert settings(clock="sync").silence_s > 8.0 + 1.0, "a guard must not take the wait for a dead bus"
    assert pace.compute_due_s(waits=False, idle=True) == pytest.approx(10.004)  # idle: listeners are spared


def test_lockstep_ahead_of_clock_does_not_pause_afterwards() -> None:
    pace = SyncPace(0.001, lockstep=True)
    for k in range(5000):  # five seconds of motion in one of wall time
        pace.record_sync(10.0 + k * 0.0002)
    assert pace.compute_due_s(waits=False, idle=True) == pytest.approx(11.0038)


def test_played_file_does_not_move_unnamed_axes() -> None:
    twin = SteppedSimulator(build_simulator_config(sim={"axis": {"Y": {"start_mm": 5.0}}}))
    twin.switch_on()
    twin.machine.nc.play_demand("x only", build_trajectory(build_corner_rows()[:, :1], "X"))
    twin.run_until("finished")
    assert twin.machine.units["Y"].drive.table_mm == pytest.approx(5.0, abs=1e-3)
