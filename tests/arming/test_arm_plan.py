"""Nothing is armed unless all facts hold; every refusal has its code and the next action."""

from __future__ import annotations

import math
import os
import stat
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fdhil.arming.arm_plan import (
    MODEL_AGE_S,
    ArmPlan,
    ArmRequest,
    Refusal,
    collect_model_facts,
    collect_models,
    prepare_program,
    prepare_request,
)
from fdhil.arming.arming_service import ArmingService
from fdhil.arming.model_tracker import AxisModelState, ModelTracker
from fdhil.arming.operator_token import read_token
from fdhil.arming.whole_plan import plan_whole_program
from fdhil.commissioning.commissioning_record import CommissioningRecord, compute_axis_digest, save_record
from fdhil.commissioning.void_mark import mark_record_void
from fdhil.config import MachineConfig
from fdhil.daemon.outcome_store import OutcomeStore
from fdhil.errors import ConfigError, ProgramError
from fdhil.identification.drive_loops.loop_identification import DIFFER
from fdhil.program import compute_program_digest, program_loading
from fdhil.records import LoopEstimate, Notice, Reason, Skill, Verdict
from fdhil.store.history_rows import Revision, TimeStamp
from tests.daemon.simulated_machine import config_of
from tests.store.sample_records import make_published

GENTLE = "G21 G90 G94\nG1 X20 F4000\nG1 Y20\nG4 P0.2\nM2\n"


@pytest.fixture
def config(tmp_path: Path) -> MachineConfig:
    return config_of(tmp_path, ("X", "Y"))


@pytest.fixture
def program(tmp_path: Path) -> Path:
    path = tmp_path / "gentle.ngc"
    path.write_text(GENTLE)
    return path


def make_model_states(config: MachineConfig, **changes: Any) -> dict[str, AxisModelState]:
    newest = replace(make_published(), config_digest=config.digest)
    skill = Skill("X", 1, 0.5, 1.0, 0.0, 30.0)
    good = AxisModelState(newest, 60.0, 21.5, (skill, skill, skill))
    return {"X": replace(good, **changes), "Y": good}


def make_record(config: MachineConfig, **changes: Any) -> CommissioningRecord:
    record = CommissioningRecord(
        axis="X",
        vendor_id=1,
        product_code=2,
        revision=3,
        serial=4,
        config_digest=compute_axis_digest(config, "X"),
        mapping_fingerprint="f",
        options={"6007": 1},
        following_error_window_um=10_000.0,
        offset_in_feedforward=True,
        sign_test_um=10.0,
        readback_ok=True,
        watchdog="proven",
        created_utc="2026-01-01T00:00:00Z",
    )
    return replace(record, **changes)


def save_records(config: MachineConfig, **changes: Any) -> None:
    save_record(make_record(config, **changes), config.store.directory)
    other = make_record(config, axis="Y", config_digest=compute_axis_digest(config, "Y"))
    save_record(other, config.store.directory)


def make_whole_plan(
    program: Path, config: MachineConfig, method: str | None = None, **changes: Any
) -> ArmPlan | Refusal:
    request = prepare_request(program, method, config, make_model_states(config, **changes))
    assert isinstance(request, ArmRequest)
    assert not request.ahead
    checked = plan_whole_program(request, make_model_states(config, **changes))
    if isinstance(checked, Refusal):
        return checked
    return prepare_program(request, checked, config, make_model_states(config, **changes))


def test_all_facts_hold_for_a_good_machine(config: MachineConfig, program: Path) -> None:
    save_records(config)
    armament = make_whole_plan(program, config)
    assert isinstance(armament, ArmPlan)
    assert all(armament.facts.values()), armament.facts
    reported = armament.summarise()
    assert reported["after"]["rms_um"] < 0.2 * reported["before"]["rms_um"]
    assert reported["program_digest"] == compute_program_digest(program)
    assert reported["rows"] == len(armament.first_piece.offset["X"])
    assert armament.first_piece.final


@pytest.mark.parametrize(
    ("changes", "withheld"),
    [
        ({"age_s": MODEL_AGE_S + 1}, "model_fresh"),
        ({"age_s": -1.0}, "model_fresh"),
        ({"age_s": math.nan}, "model_fresh"),
        ({"temperature_c": 25.0}, "model_fresh"),
        ({"load_changed": True}, "model_fresh"),
        ({"published": make_published()}, "model_fresh"),  # of another configuration
        ({"skills": ()}, "skill_enough"),
        ({"skills": (Skill("X", 1, 500.0, 900.0, 0.0, 900.0),)}, "skill_enough"),
        ({"skills": (Skill("X", 1, math.nan, 1.0, 0.0, 900.0),)}, "skill_enough"),
    ],
)
@pytest.mark.fault("E4", "E19")
def test_fact_that_does_not_hold_is_withheld(changes: dict[str, Any], withheld: str, config: MachineConfig) -> None:
    facts = collect_model_facts(["X", "Y"], config, make_model_states(config, **changes), gain_um=20.0)
    assert [name for name, holds in facts.items() if not holds] == [withheld]


@pytest.mark.fault("A23")
def test_void_record_withholds_commissioned(config: MachineConfig, program: Path) -> None:
    save_records(config)
    mark_record_void(config.store.directory, "X", "booted")
    armament = make_whole_plan(program, config)
    assert isinstance(armament, ArmPlan)
    assert [name for name, good in armament.facts.items() if not good] == ["commissioned"]


@pytest.mark.fault("E7")
def test_zero_gain_is_not_positive(config: MachineConfig) -> None:
    for gain_um in (0.0, -1.0, math.nan):
        assert not collect_model_facts(["X", "Y"], config, make_model_states(config), gain_um)["gain_positive"]


@pytest.mark.parametrize(
    ("changes", "withheld"),
    [
        ({"readback_ok": False}, ["commissioned"]),
        ({"config_digest": "other"}, ["commissioned"]),
        ({"offset_in_feedforward": None}, ["offset_in_feedforward_known"]),
        ({"offset_in_feedforward": False}, ["offset_in_feedforward_known"]),
        ({"watchdog": "none"}, ["watchdog_proven"]),
        (None, ["commissioned", "offset_in_feedforward_known", "watchdog_proven"]),
    ],
)
@pytest.mark.fault("E14")
def test_uncommissioned_drive_withholds_facts(
    changes: dict[str, Any] | None, withheld: list[str], config: MachineConfig, tmp_path: Path
) -> None:
    program = tmp_path / "fast.ngc"
    program.write_text(GENTLE.replace("F4000", "F9000"))  # an offset larger than what may stay in a drive
    if changes is not None:
        save_records(config, **changes)
    armament = make_whole_plan(program, config)
    assert isinstance(armament, ArmPlan)
    assert [name for name, holds in armament.facts.items() if not holds] == withheld


def test_nothing_is_planned_without_parameters_or_limits(config: MachineConfig, program: Path, tmp_path: Path) -> None:
    refused = prepare_request(program, None, config, make_model_states(config, published=None))
    assert isinstance(refused, Refusal)
    assert refused.reasons[0].code == "ModelNotValidated"
    listening = {axis: settings.model_copy(update={"correction": None}) for axis, settings in config.axis.items()}
    shadow = config.model_copy(update={"axis": listening})
    off = make_whole_plan(program, shadow)
    assert isinstance(off, Refusal)
    assert off.reasons[0].code == "WritingOff"


def test_other_method_is_planned_at_once_for_any_length(config: MachineConfig, tmp_path: Path) -> None:
    program = tmp_path / "long.ngc"
    program.write_text(GENTLE.replace("G4 P0.2", "G4 P12"))
    save_records(config)
    armament = make_whole_plan(program, config, "mirror")
    assert isinstance(armament, ArmPlan)
    assert (armament.summarise()["method"], armament.summarise()["streamed"], armament.first_piece.final) == (
        "mirror",
        True,
        False,
    )
    pieces = [armament.first_piece]
    while armament.stream.has_block:
        pieces.append(armament.stream.take_rows())
    assert sum(len(piece.offset["X"]) for piece in pieces) == armament.row_count
    assert [piece.final for piece in pieces] == [False] * (len(pieces) - 1) + [True]
    refused = make_whole_plan(program, config, "flatness")
    assert isinstance(refused, Refusal)
    assert refused.reasons[0].text == "the method flatness plans no position offset"


@pytest.mark.fault("G1")
async def test_wrong_token_is_refused_and_missing_guard_reported(config: MachineConfig, program: Path) -> None:
    store = OutcomeStore(config)
    assert config.store.run_directory is not None
    config.store.run_directory.mkdir(parents=True)
    service = ArmingService(config, store, config.store.run_directory)
    stamp = TimeStamp(0.0, "another boot", 0)
    newest = replace(make_published(), config_digest=config.digest)
    skills = [Skill(axis, 1, 0.5, 1.0, 0.0, 30.0) for axis in ("X", "Y")]
    service.start_from_history(
        {axis: Revision(1, replace(newest, axis=axis), (), stamp) for axis in ("X", "Y")}, skills
    )
    request = {"request": "arm", "program": str(program)}
    for token in (None, "", 5, "wrong", "ä"):
        answer = await service.arm(request | {"token": token})
        assert (answer["ok"], answer["code"]) == (False, "AuthRequired")
    token = read_token(config.store.run_directory)
    meant = {"token": token, "program_digest": compute_program_digest(program)}
    assert (await service.arm(request | meant))["code"] == "GuardAbsent"
    program.write_bytes(program.read_bytes() + b"\n")
    assert (await service.arm(request | meant))["code"] == "ProgramMismatch"
    assert (await service.arm(request | {"token": token}))["code"] == "GuardAbsent"
    assert (await service.arm(request | {"token": token, "method": "magic"}))["code"] == "BadRequest"
    assert (await service.arm({"request": "arm", "token": token}))["code"] == "BadRequest"
    assert (await service.disarm())["code"] == "GuardAbsent"
    assert not (await service.shut_down()).guard_seen


@pytest.mark.timeout(100)
def test_pipe_is_refused_as_program_without_waiting(config: MachineConfig, tmp_path: Path) -> None:
    """Opening a pipe would block arming and shutdown until somebody writes to it."""
    os.mkfifo(tmp_path / "program.ngc")
    axis = AxisModelState(make_published(), 0.0, None, ())
    for program in (tmp_path / "program.ngc", Path(os.devnull)):
        with pytest.raises(ProgramError, match="use a regular file"):
            prepare_request(program, None, config, dict.fromkeys(config.axis, axis))


@pytest.mark.timeout(100)
@pytest.mark.parametrize("name", ["program.ngc", "demand.csv"])
def test_sparse_file_is_refused_by_its_size(name: str, config: MachineConfig, tmp_path: Path) -> None:
    """A sparse file takes no disk space, but hashing it would block arming for minutes."""
    (tmp_path / name).touch()
    os.truncate(tmp_path / name, 1 << 40)
    known = dict.fromkeys(config.axis, AxisModelState(make_published(), 0.0, None, ()))
    with pytest.raises(ProgramError, match="is larger than 1024 MiB, so it was not read"):
        prepare_request(tmp_path / name, None, config, known)


def test_program_that_grows_while_it_is_read_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(program_loading, "MAX_BYTES", 10)
    monkeypatch.setattr(os, "fstat", lambda _file: SimpleNamespace(st_mode=stat.S_IFREG, st_size=4))
    program = tmp_path / "program.ngc"
    program.write_bytes(b"G1 X10 F1000\n")
    with pytest.raises(ProgramError, match="is larger than"):
        compute_program_digest(program)


def test_changed_load_holds_until_new_parameters(config: MachineConfig, tmp_path: Path) -> None:
    service = ArmingService(config, OutcomeStore(config), tmp_path)
    service.knowledge.take_outcomes([replace(make_published(), config_digest=config.digest)])
    service.knowledge.take_outcomes([Notice("LoadChanged", "MAJOR", "Jt rose", "X")])
    assert service.knowledge.get_states()["X"].load_changed
    service.knowledge.take_outcomes([replace(make_published(2), config_digest=config.digest)])
    assert not service.knowledge.get_states()["X"].load_changed


def test_model_ages_while_computer_is_suspended(config: MachineConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    knowledge, stamp, awake_ns = ModelTracker(config.axis), TimeStamp.now(), time.clock_gettime_ns(time.CLOCK_BOOTTIME)
    knowledge.take_outcomes([make_published()])
    # this clock alone counts the night in which the others stood still
    monkeypatch.setattr(time, "clock_gettime_ns", {time.CLOCK_BOOTTIME: awake_ns + 10**9 * 36_000}.get)
    assert stamp.compute_age_s() == pytest.approx(36_000, abs=1000)
    assert knowledge.get_states()["X"].age_s == pytest.approx(36_000, abs=1000)


def test_accepted_identified_loops_are_used_in_plan(config: MachineConfig, program: Path) -> None:
    accepted = Verdict(True, None, unexplained_um=0.5, warnings=(Reason(DIFFER, "speed_kp is 21"),))
    loops = LoopEstimate(
        "X", "p_pi_pi", ("speed_kp", "speed_filter_s"), np.array([21.0, 5e-4]), np.zeros((2, 2)), accepted
    )
    knowledge = ModelTracker(config.axis)
    knowledge.take_outcomes([replace(make_published(1, axis), config_digest=config.digest) for axis in "XY"])
    knowledge.take_outcomes([loops])
    found = make_own_config(config, knowledge)
    assert found.axis["X"].regulators.speed_kp == 21.0
    assert found.axis["X"].regulators.speed_filter_s == 5e-4
    assert found.axis["Y"] == config.axis["Y"]
    knowledge.take_outcomes([replace(loops, verdict=replace(accepted, accepted=False))])
    assert make_own_config(config, knowledge) is config
    request = prepare_request(program, None, config, make_model_states(config, loops=loops))
    assert isinstance(request, ArmRequest)
    assert request.config.axis["X"].regulators.speed_kp == 21.0
    save_records(config)
    armament = make_whole_plan(program, config, loops=loops)
    assert isinstance(armament, ArmPlan)
    assert all(armament.facts.values()), armament.facts


def make_own_config(config: MachineConfig, knowledge: ModelTracker) -> MachineConfig:
    found = collect_models("XY", config, knowledge.get_states())
    assert not isinstance(found, Refusal)
    return found[1]


def test_plan_uses_loops_the_set_was_validated_with(config: MachineConfig, program: Path) -> None:
    newest = replace(make_published(), config_digest=config.digest, loops={"speed_filter_s": 0.002})
    request = prepare_request(program, None, config, make_model_states(config, published=newest))
    assert isinstance(request, ArmRequest)
    assert request.config.axis["X"].regulators.speed_filter_s == 0.002
    older = replace(newest, config_digest="another")
    with pytest.raises(ConfigError, match=r"LoopsDiffer: .*speed_filter_s 0.002 instead of 0"):
        prepare_request(program, None, config, make_model_states(config, published=older))


def test_plan_uses_configured_resonance(config: MachineConfig, program: Path) -> None:
    axis = config.axis["X"].model_copy(update={"resonance_hz": 90.0})
    config = config.model_copy(update={"axis": {**config.axis, "X": axis}})
    request = prepare_request(program, None, config, make_model_states(config))
    assert isinstance(request, ArmRequest)
    assert request.models["X"].get_term("resonance") == 90.0
    assert request.models["Y"].terms == ()
