"""After each corrected pass its measured error is reported with the predicted one and its uncertainty."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.arming import pass_monitor
from fdhil.arming.arm_plan import ArmPlan, Refusal
from fdhil.arming.pass_monitor import ProgramPass
from fdhil.config import MachineConfig
from fdhil.prediction import compute_contour_error_um
from fdhil.prediction.correction_gain import (
    CorrectionGain,
    combine_held_out_um,
    find_worst_rms_um,
    format_half_interval,
)
from fdhil.records import AxisSamples, Correction, Float, Notice, Skill, freeze_array, freeze_integers
from tests.arming.machine_peer import MachinePeer
from tests.arming.test_arm_plan import make_whole_plan, save_records
from tests.arming.test_armed_ahead_of_check import open_service
from tests.daemon.simulated_machine import config_of

REST_ROWS = 300


@pytest.fixture
def config(tmp_path: Path) -> MachineConfig:
    config = config_of(tmp_path, ("X", "Y"))
    save_records(config)
    return config


@pytest.fixture
def arm_plan(config: MachineConfig, program: Path) -> ArmPlan:
    found = make_whole_plan(program, config)
    assert isinstance(found, ArmPlan)
    return found


def make_samples(demand: Mapping[str, Float], position: Mapping[str, Float]) -> Iterator[AxisSamples]:
    for axis, size in (("X", 40), ("Y", 37)):
        way = np.concatenate([np.linspace(30.0, 0.0, 200) + demand[axis][0], np.full(REST_ROWS, demand[axis][0])])
        wanted = np.concatenate([way, demand[axis], np.full(REST_ROWS, demand[axis][-1])])
        is_at = np.concatenate([way, position[axis], np.full(REST_ROWS, position[axis][-1])])
        tick, zeros = np.arange(1000, 1000 + wanted.size), np.zeros(wanted.size)
        for k in range(0, wanted.size, size):
            part = slice(k, k + size)
            ticks, still = freeze_integers(tick[part]), freeze_array(zeros[part])
            yield AxisSamples(
                axis, ticks, freeze_array(wanted[part]), freeze_array(is_at[part]), still, still, None, still, ticks
            )


def test_measured_error_is_independent_of_block_sizes(
    config: MachineConfig, arm_plan: ArmPlan, planned: Correction, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pass_monitor, "CHUNK_S", 0.2)
    reference, after = planned.before.reference, planned.after
    demand = arm_plan.first_piece.demand
    for rows in (arm_plan.row_count, None):
        running = ProgramPass(config, demand, rows)
        samples = sorted(make_samples(reference.position_mm, after.predicted_mm), key=lambda block: int(block.tick[-1]))
        for block in samples:
            running.take_samples(block)
        reported = running.measure_errors()
        assert reported is not None
        path, is_at = (np.column_stack([of[a] for a in "XY"]) for of in (reference.position_mm, after.predicted_mm))
        error = compute_contour_error_um(path, is_at, reference.dt_s)
        assert reported["measured"]["max_um"] == pytest.approx(float(error.max()), rel=1e-6)
        if rows is not None:
            assert reported["rows"] == rows
            assert reported["measured"]["rms_um"] == pytest.approx(after.rms_um, rel=1e-6)
            assert arm_plan.predicted_gain.after_um > after.rms_um  # held-out moves are predicted worse
            lag = (after.predicted_mm["X"] - reference.position_mm["X"]) * 1e3
            assert reported["following_rms_um"]["X"] == pytest.approx(float(np.sqrt(np.mean(lag**2))), rel=1e-6)
        else:
            assert reported["rows"] >= arm_plan.row_count


def test_pass_that_never_began_measures_nothing(config: MachineConfig, arm_plan: ArmPlan, planned: Correction) -> None:
    reference = planned.before.reference
    running = ProgramPass(config, arm_plan.first_piece.demand, arm_plan.row_count)
    away = {axis: values + 5.0 for axis, values in reference.position_mm.items()}
    for block in make_samples(away, away):
        running.take_samples(block)
    assert running.measure_errors() is None


def measure_pass(told: Sequence[Notice], count: int) -> bool:
    return sum(notice.code == "PassMeasured" for notice in told) == count


@pytest.mark.usefixtures("real_time")
async def test_each_pass_is_reported_with_its_prediction(
    config: MachineConfig,
    machine_peer: MachinePeer,
    program: Path,
    planned: Correction,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pass_monitor, "LATE_S", 0.0)
    reference = planned.before.reference.position_mm
    worse = {axis: 3 * planned.before.predicted_mm[axis] - 2 * reference[axis] for axis in reference}
    cases = [
        (planned.after.predicted_mm, "Finished", "info"),
        (worse, "StaleData", "MAJOR"),
        (planned.before.predicted_mm, "Finished", "minor"),
    ]
    async with open_service(config, machine_peer) as shop:
        for number, (is_at, cause, severity) in enumerate(cases, 1):
            answer = await shop.arm(program)
            assert answer["ok"], answer
            assert "is predicted to become" in answer["text"]
            assert "um RMS (95 %), " in answer["text"]
            assert answer["after"]["uncertainty_um"] > 0.5  # no better than the last moves were predicted
            for block in make_samples(reference, is_at):
                shop.desk.take_samples(block)
            machine_peer.state, machine_peer.cause = "OFF", cause
            await shop.wait_until(partial(measure_pass, shop.told, number))
            reported = shop.desk.passes[-1]
            notice = next(notice for notice in reversed(shop.told) if notice.code == "PassMeasured")
            assert (notice.severity, notice.text.startswith(reported["text"])) == (severity, True)
            assert (reported["pass"], reported["ended_by"]) == (number, cause)
        refused = await shop.arm(program)
    assert (refused["ok"], refused["code"]) == (False, "PromiseBroken"), refused
    first, third, second = shop.desk.passes
    assert first["measured"]["rms_um"] == pytest.approx(planned.after.rms_um, rel=1e-3)
    assert first["predicted"]["rms_um"] > first["measured"]["rms_um"]  # held-out moves are predicted worse
    assert second["measured"]["rms_um"] == pytest.approx(second["predicted_without"]["rms_um"], rel=1e-3)
    assert "pass 1 of gentle.ngc: contour error measured" in first["text"]
    assert first["gain"]["measured"] > first["gain"]["predicted"] > 1.0
    assert "ended early: StaleData" in third["text"]
    assert any("more than predicted; identify again" in notice.text for notice in shop.told)
    assert any("worse than uncorrected; leave it off" in notice.text for notice in shop.told)


def test_gain_is_bounded_by_parameter_covariance_and_skill(config: MachineConfig, program: Path) -> None:
    def predicted(**changes: Any) -> CorrectionGain:
        found = make_whole_plan(program, config, **changes)
        assert isinstance(found, ArmPlan)
        return found.predicted_gain

    good = predicted()
    assert good.half_um is not None
    assert good.half_um > math.hypot(0.5, 0.5)  # the skill of both axes, and the parameters' spread
    assert good.at_least is not None
    assert good.at_least < good.before_um / good.after_um
    poor = predicted(skills=(Skill("X", 1, 500.0, 1.0, 0.0, 900.0),))
    assert poor.half_um is not None
    assert poor.half_um > 500.0
    assert poor.at_least is None
    for unknown in ((), (Skill("X", 1, math.nan, 1.0, 0.0, 900.0),)):
        assert predicted(skills=unknown).half_um is None
    assert "its accuracy on this machine is unknown" in str(predicted(skills=()))


def test_program_is_not_armed_when_held_out_errors_exceed_gain(config: MachineConfig, program: Path) -> None:
    found = make_whole_plan(program, config, skills=(Skill("X", 1, 0.5, 4.0, 0.0, 24.0),))
    assert isinstance(found, Refusal)
    assert [reason.code for reason in found.reasons] == ["HarmPredicted"]


def test_gain_includes_held_out_error_and_is_unknown_without_moves() -> None:
    assert combine_held_out_um({"X": 3.0, "Y": 4.0}, ("X", "Y")) == pytest.approx(5.0)
    assert combine_held_out_um({"X": 3.0}, ("X", "Y")) is None
    assert combine_held_out_um({"X": 3.0}, ()) is None
    assert find_worst_rms_um(
        {"X": (Skill("X", 1, 2.0, 9.0, 0.0, 9.0), Skill("X", 2, 3.0, 9.0, 0.0, 9.0)), "Y": ()}
    ) == {"X": 3.0}


def test_small_uncertainty_is_not_shown_as_zero() -> None:
    assert format_half_interval(0.44) == "± 0.4"
    assert format_half_interval(0.05) == "± 0.1"
    assert format_half_interval(0.004) == "± <0.1"
    assert format_half_interval(0.0) == "± <0.1"
    assert format_half_interval(0.004, 2) == "± <0.01"


def test_table_behind_known_compliance_is_measured_at_table(
    config: MachineConfig, arm_plan: ArmPlan, planned: Correction
) -> None:
    reference = planned.before.reference
    rows = reference.time_s.size
    ahead = np.column_stack([5e-3 * np.sin(2 * np.pi * 2.0 * reference.time_s), np.zeros(rows)])
    motor = {axis: reference.position_mm[axis] - ahead[:, k] for k, axis in enumerate("XY")}
    for known, largest_um in ((ahead, 1e-3), (None, 6.0)):
        running = ProgramPass(config, arm_plan.first_piece.demand, arm_plan.row_count, None, known)
        for block in sorted(make_samples(reference.position_mm, motor), key=lambda block: int(block.tick[-1])):
            running.take_samples(block)
        reported = running.measure_errors()
        assert reported is not None
        assert 0.1 * largest_um * (known is None) <= reported["measured"]["max_um"] <= largest_um


@pytest.mark.parametrize(
    ("late", "severity", "told"),
    [
        ("this PC was late (37 offsets, worst 9.0 ms)", "minor", "reduce the load of this PC, then arm again"),
        ("", "MAJOR", "worse than uncorrected; leave it off and identify again"),
    ],
)
def test_pass_ended_by_late_pc_is_not_blamed_on_the_model(late: str, severity: str, told: str) -> None:
    found: dict[str, Any] = {
        "program": "part.ngc",
        "pass": 1,
        "ended_by": "LimitActive",
        "late": late,
        "measured": {"rms_um": 31.0, "max_um": 90.0},
        "predicted": {"rms_um": 0.08, "uncertainty_um": 1.6},
        "predicted_without": {"rms_um": 24.2},
        "gain": {"predicted": 302.0, "measured": 0.8},
    }
    text = pass_monitor._format_report(found)
    assert "predicted at most 1.68 um RMS (95 %), 0.08 by the model" in text
    assert text.endswith(f"it ended early: {late or 'LimitActive'}")
    notice = pass_monitor._make_notice(found, text)
    assert (notice.severity, notice.text.endswith(told)) == (severity, True)
