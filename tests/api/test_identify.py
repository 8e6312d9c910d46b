"""Identification from arrays alone, of a motor simulated by another program."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fdhil
from fdhil.errors import FdhilError, RecordingError
from tests.api.independent_motor import TRUTH, build_speed_loop, run_motor
from tests.api.motor_recordings import record_motor

DEVIATIONS = 4.0  # every one of some dozen values must lie within


def build_recording(move: str, **options: Any) -> fdhil.Recording:
    """Return a recording of voltage, current and speed alone."""
    m = record_motor(move)
    return fdhil.Recording(m.time, m.voltage, m.current, m.speed, **options)


def assert_true_within_intervals(result: fdhil.Result, names: str = "R L K Jt ft Cd") -> None:
    for name in names.split():
        found = result.parameters[name]
        assert found.value is not None, found.reason
        assert found.std is not None
        assert abs(found.value - TRUTH[name]) < DEVIATIONS * found.std, str(found)


def test_rapids_without_position_yield_all_six_parameters() -> None:
    result = fdhil.identify(build_recording("rapids"))
    assert result.validated, result.reasons
    assert len(result.windows) == 2
    assert_true_within_intervals(result)


@pytest.mark.parametrize("move", ["steps of voltage", "chirp", "back and forth", "overshooting speed steps"])
def test_any_move_yields_all_six_parameters(move: str) -> None:
    result = fdhil.identify(build_recording(move), any_move=True)
    assert result.validated, result.reasons
    assert_true_within_intervals(result)
    assert not [w for w in result.warnings if w.code == "OneDirection"]


@pytest.mark.parametrize(("gain", "rate"), [(0.9, 12.0), (0.2, 100.0)], ids=["creeps to its speed", "overshoots"])
def test_speed_loop_settling_is_not_a_feed_hold(gain: float, rate: float) -> None:
    def build_profile(time_s: float) -> float:
        return 100.0 * ((0.1 < time_s < 0.9) - (1.2 < time_s < 2.0))

    m = run_motor(build_speed_loop(build_profile, gain=gain, rate=rate), 2.4)
    result = fdhil.identify(fdhil.Recording(m.time, m.voltage, m.current, m.speed))
    assert result.validated, result.reasons
    assert len(result.windows) == 2


def test_feed_hold_is_detected_without_a_demand() -> None:
    def build_held_profile(time_s: float) -> float:
        return 100.0 * (0.1 < time_s < 1.0) - 60.0 * (0.4 < time_s < 0.6)

    m = run_motor(build_speed_loop(build_held_profile, gain=0.3, rate=60.0), 1.4)
    result = fdhil.identify(fdhil.Recording(m.time, m.voltage, m.current, m.speed))
    assert [reason.code for reason in result.reasons] == ["EpisodeAborted"]
    assert "any_move=True" in result.reasons[0].advice


def test_several_recordings_narrow_the_intervals() -> None:
    one = fdhil.identify(build_recording("chirp"), any_move=True)
    both = fdhil.identify([build_recording("chirp"), build_recording("steps of voltage")], any_move=True)
    assert len(both.windows) == 2
    assert_true_within_intervals(both)
    assert (both.parameters["Jt"].std or 1.0) < (one.parameters["Jt"].std or 0.0)


def test_locked_rotor_yields_r_and_l_and_reasons_for_the_rest() -> None:
    result = fdhil.identify(build_recording("locked rotor"), any_move=True)
    assert not result.validated
    assert_true_within_intervals(result, "R L")
    for name in ("K", "Jt", "ft", "Cd"):
        assert result.parameters[name].value is None
        assert "does not turn" in str(result.parameters[name].reason)
    with pytest.raises(FdhilError, match="is incomplete"):
        _ = result.model


def test_ramp_has_a_reason_for_each_missing_parameter() -> None:
    result = fdhil.identify(build_recording("ramp"), any_move=True)
    assert all(p.value is not None or p.reason is not None for p in result.parameters.values())


def test_recording_without_rapids_names_the_any_move_option() -> None:
    m = record_motor("rapids")
    still = fdhil.Recording(m.time, m.voltage, m.current, 0.0 * m.speed)
    result = fdhil.identify(still)
    assert [reason.code for reason in result.reasons] == ["NoWindow"]
    assert "any-move" in result.reasons[0].advice


def test_speed_from_encoder_counts_and_tacho_volts_gives_the_same_parameters() -> None:
    m = record_motor("steps of voltage")
    angle = np.concatenate([[0.0], np.cumsum((m.speed[1:] + m.speed[:-1]) / 2 * 1e-3)])
    counts = np.rint(angle * 2**17 / (2 * np.pi))
    by_counts = fdhil.Recording(m.time, m.voltage, m.current, angle=counts, angle_scale=2 * np.pi / 2**17)
    by_tacho = fdhil.Recording(m.time, m.voltage, m.current, m.speed * 0.06, speed_scale=1 / 0.06)
    assert by_tacho.speed == pytest.approx(m.speed)
    for recording in (by_counts, by_tacho):
        result = fdhil.identify(recording, any_move=True)
        assert result.parameters["K"].value == pytest.approx(TRUTH["K"], rel=0.02), repr(result)
        assert result.parameters["Jt"].value == pytest.approx(TRUTH["Jt"], rel=0.03), repr(result)


def test_torque_instead_of_current_yields_the_mechanics() -> None:
    m = record_motor("rapids")
    result = fdhil.identify(fdhil.Recording(m.time, speed=m.speed, torque=m.current * TRUTH["K"]))
    assert result.parameters["K"].given
    assert result.parameters["R"].value is None
    assert "voltage" in str(result.parameters["R"].reason)
    assert result.parameters["Jt"].value == pytest.approx(TRUTH["Jt"], rel=0.03)


def test_torque_with_constant_and_voltage_yields_all_six_parameters() -> None:
    m = record_motor("rapids")
    recording = fdhil.Recording(
        m.time, m.voltage, speed=m.speed, torque=m.current * TRUTH["K"], torque_constant_nm_per_a=TRUTH["K"]
    )
    assert_true_within_intervals(fdhil.identify(recording))


def test_result_is_rendered_as_text_html_json_picture_and_page(tmp_path: Path) -> None:
    result = fdhil.identify(build_recording("chirp"), any_move=True)
    assert "validated" in repr(result)
    assert "Jt = " in repr(result)
    assert "<table>" in result._repr_html_()
    document = json.loads(result.to_json())
    pooled = document["files"][0]["pooled"]
    assert document["schema"] == "fdhil-identify-1"
    assert pooled["parameters"]["R"]["value"] == result.parameters["R"].value
    assert result.covariance is not None
    assert result.covariance.shape == (len(result.names),) * 2
    figure = result.plot()
    assert len(figure.axes) == 5
    result.report(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text("utf-8")
    assert "Correlation of the estimates" in page
    assert "Most informative further recording" in page


def test_predicted_next_move_is_not_better_than_a_real_one() -> None:
    """The prediction is the best that a second recording can achieve."""
    from fdhil.identification.next_move import predict_next_moves

    result = fdhil.identify(build_recording("rapids"), any_move=True)
    assert result.found.pooled is not None
    moves = {move.name: move.shares for move in predict_next_moves(result.windows[0].window, result.found.pooled)}
    more = fdhil.identify([build_recording("rapids"), build_recording("chirp")], any_move=True)
    for name, share in moves["fast chirp about half the voltage"].items():
        assert (more.parameters[name].std or 0.0) > (share - 0.05) * (result.parameters[name].std or 1.0)


def test_simulated_model_matches_the_motor() -> None:
    m = record_motor("steps of voltage")
    made = fdhil.simulate(fdhil.Model.from_mapping(TRUTH), m.voltage, 1e-3)
    assert np.abs(made.speed - m.speed).max() < 0.02 * np.abs(m.speed).max()


@pytest.mark.usefixtures("processes")
def test_importing_fdhil_does_not_load_numpy() -> None:
    code = "import fdhil, sys; print([m for m in ('numpy', 'numba', 'scipy', 'can') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_public_names_exist_and_are_documented() -> None:
    assert sorted(fdhil.__all__) == sorted(set(fdhil.__all__))
    for name in fdhil.__all__:
        assert getattr(fdhil, name).__doc__
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = fdhil.nothing


def test_recordings_of_two_axes_are_refused() -> None:
    with pytest.raises(RecordingError, match="of one axis, and these are of X, Y"):
        fdhil.identify([build_recording("chirp"), build_recording("chirp", axis="Y")])


def test_model_becomes_a_state_space_of_python_control() -> None:
    control = pytest.importorskip("control")
    system = fdhil.Model.from_mapping(TRUTH).to_control()
    gain = control.dcgain(system)[1, 0]
    assert gain == pytest.approx(TRUTH["K"] / (TRUTH["K"] ** 2 + TRUTH["R"] * TRUTH["ft"]))


def test_validated_result_predicts_a_program_on_a_machine() -> None:
    machine = fdhil.Machine.load(Path(__file__).parents[2] / "configs" / "sim.toml")
    program = Path(__file__).parents[2] / "configs" / "programs" / "bench_10m.ngc"
    demand = fdhil.plan(program, machine)
    nominal = fdhil.predict(demand, machine)
    heavier = {axis: replace(model, Jt=1.2 * model.Jt) for axis, model in machine.models.items()}
    assert fdhil.predict(demand, machine, heavier).rms_um != nominal.rms_um
