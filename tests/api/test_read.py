"""Files of other programs: columns named by a part of their heading, or proposed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

import fdhil
from fdhil.errors import RecordingError
from fdhil.store.column_proposal import propose_columns, propose_for_table
from fdhil.store.recording_table import RecordingTable
from tests.api.independent_motor import TRUTH
from tests.api.motor_recordings import record_motor
from tests.api.test_identify import assert_true_within_intervals


def write_csv(path: Path, head: str, order: str = "tuiw", rpm: bool = False) -> Path:
    m = record_motor("steps of voltage")
    columns = {"t": m.time, "u": m.voltage, "i": m.current, "w": m.speed * (30 / np.pi if rpm else 1.0)}
    np.savetxt(path, np.column_stack([columns[k] for k in order]), delimiter=",", header=head, comments="", fmt="%.7g")
    return path


def test_column_is_found_by_a_part_of_its_heading(tmp_path: Path) -> None:
    path = write_csv(
        tmp_path / "scope.csv", "Time (s),Terminal voltage (V),r78 Current actual (A),n_act (rpm)", rpm=True
    )
    names = {"time": "Time", "voltage": "voltage", "current": "r78", "speed": "n_act"}
    recording = fdhil.read(path, columns=names)
    assert recording.speed == pytest.approx(record_motor("steps of voltage").speed, abs=1e-3)
    assert_true_within_intervals(fdhil.identify(recording, any_move=True))


def test_ambiguous_heading_is_refused_with_both_columns(tmp_path: Path) -> None:
    path = write_csv(tmp_path / "scope.csv", "Time (s),Channel 1,Channel 2,Channel 3")
    with pytest.raises(RecordingError, match="'Channel 1' and 'Channel 2' and 'Channel 3'"):
        fdhil.read(path, columns={"time": "Time", "voltage": "Chan", "current": "Channel 2", "speed": "Channel 3"})


@pytest.mark.parametrize(
    ("head", "order"),
    [("a,b,c,d", "tuiw"), ("a,b,c,d", "wtiu"), ("Zeit [s],CH1,CH2,Drehzahl", "tiuw"), ("t,u,i,omega", "tuiw")],
)
def test_columns_are_proposed_by_headings_and_physics(head: str, order: str, tmp_path: Path) -> None:
    path = write_csv(tmp_path / "trace.csv", head, order)
    proposal = propose_columns(path)
    signals = {"t": "time_s", "u": "voltage_V", "i": "current_A", "w": "speed_rad_per_s"}
    headings = dict(zip(order, head.split(","), strict=True))
    assert {p.signal: p.heading for p in proposal.columns} == {s: headings[k] for k, s in signals.items()}
    assert proposal.faults == []
    assert proposal.headers["voltage_sampling"] == "interval_mean"
    assert_true_within_intervals(fdhil.identify(fdhil.read(path, "?"), any_move=True))


def test_position_needs_a_pitch_and_states_are_not_signals(tmp_path: Path) -> None:
    m = record_motor("steps of voltage")
    angle = np.cumsum(m.speed) * 1e-3
    state = (m.speed > 1.0).astype(float)
    table = np.column_stack([m.time, state, angle, m.voltage, m.current, m.speed, angle % 7.0])
    head = "Time (s),INP,Position (mm),CH1,CH2,CH3,Droop (pls.)"
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header=head, comments="", fmt="%.6g")
    proposal = propose_columns(tmp_path / "a.csv")
    found = {p.signal: p.heading for p in proposal.columns}
    assert found == {"time_s": "Time (s)", "voltage_V": "CH1", "current_A": "CH2", "speed_rad_per_s": "CH3"}
    assert [(p.signal, p.unit) for p in proposal.aside] == [("position_m", "mm")]
    assert '\n# position_m = { name = "Position (mm)", unit = "mm" }' in proposal.toml
    assert fdhil.read(tmp_path / "a.csv", "?").speed == pytest.approx(m.speed, rel=1e-3, abs=1e-3)


def test_column_of_another_length_is_not_proposed() -> None:
    m = record_motor("steps of voltage")
    columns = {"t": m.time, "u": m.voltage, "i": m.current[1:], "w": m.speed}
    proposal = propose_for_table(RecordingTable({}, columns))
    assert [p.signal for p in proposal.columns] == ["time_s", "voltage_V", "speed_rad_per_s"]
    assert proposal.faults == ["no current recognised"]


def test_file_without_a_current_is_not_proposed_as_a_recording(tmp_path: Path) -> None:
    path = tmp_path / "trace.csv"
    np.savetxt(path, np.random.default_rng(1).normal(size=(200, 3)), delimiter=",", header="a,b,c", comments="")
    assert len(propose_columns(path).faults) == 3
    with pytest.raises(RecordingError, match="no column rises evenly"):
        fdhil.read(path, "?")


def test_matlab_file_is_read_by_its_variables(tmp_path: Path) -> None:
    m = record_motor("chirp")
    savemat(tmp_path / "lab.mat", {"t": m.time, "u": m.voltage, "i": m.current, "omega": m.speed})
    from fdhil.store.recording_mat import read as read_matlab

    assert set(read_matlab((tmp_path / "lab.mat").read_bytes(), "lab.mat").columns) >= {"t", "u", "i", "omega"}


@pytest.mark.usefixtures("processes")
def test_matlab_file_is_identified(tmp_path: Path) -> None:
    m = record_motor("chirp")
    savemat(tmp_path / "lab.mat", {"t": m.time, "u": m.voltage, "i": m.current, "omega": m.speed})
    assert_true_within_intervals(fdhil.identify(fdhil.read(tmp_path / "lab.mat", "?"), any_move=True))


def test_column_map_accepts_angle_for_speed_and_torque_for_current(tmp_path: Path) -> None:
    m = record_motor("rapids")
    angle = np.concatenate([[0.0], np.cumsum((m.speed[1:] + m.speed[:-1]) / 2 * 1e-3)])
    counts, torque = np.rint(angle * 2**16 / (2 * np.pi)), 1e3 * TRUTH["K"] * m.current
    table = np.column_stack([m.time, counts, torque])
    np.savetxt(
        tmp_path / "a.csv", table, delimiter=",", header="Time,Encoder counts,Torque mNm", comments="", fmt="%.7g"
    )
    (tmp_path / "map.toml").write_text(
        f"""[headers]
axis = "X"
[columns]
time_s = {{ name = "Time", unit = "s" }}
angle_rad = {{ name = "Encoder", unit = "rev", factor = {2.0**-16} }}
torque_Nm = {{ name = "Torque", unit = "mN.m" }}
"""
    )
    result = fdhil.identify(fdhil.read(tmp_path / "a.csv", tmp_path / "map.toml"))
    assert result.validated, result.reasons
    assert result.parameters["Jt"].value == pytest.approx(TRUTH["Jt"], rel=0.03)
