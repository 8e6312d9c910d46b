"""Model files: all faults are reported at once, as a config error."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.errors import ConfigError
from fdhil.prediction.axis_models import (
    apply_loops,
    build_nominal_models,
    load_model_file,
    load_validated_models,
    select_models,
)
from fdhil.records import Float, ParameterSet
from tests.bench import bench_config
from tests.paths import build_trajectory
from tests.store.sample_records import BENCH, make_published

GOOD: dict[str, Any] = {"R": 0.5, "L": 0.005, "K": 0.8, "Jt": 0.075, "ft": 0.0, "Cd": 5}


def write_model_file(folder: Path, text: str) -> Path:
    path = folder / "m.json"
    path.write_text(text)
    return path


def test_valid_model_file_is_read(tmp_path: Path) -> None:
    """Six numbers per axis; a friction may be 0."""
    models = load_model_file(write_model_file(tmp_path, json.dumps({"X": GOOD, "Y": GOOD}))).parameters
    assert models["X"].Cd == 5.0
    assert set(models) == {"X", "Y"}


def test_held_out_errors_are_read(tmp_path: Path) -> None:
    document = {"X": GOOD | {"held_out": {"moves": 4, "rms_um": 0.7, "max_um": 2.0, "following_um": 40.0}}, "Y": GOOD}
    found = load_model_file(write_model_file(tmp_path, json.dumps(document)))
    assert (found.held_out_um, found.held_out_max_um) == ({"X": 0.7}, {"X": 2.0})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"R": -1}, "X.R: must be above 0"),
        ({"L": 0}, "X.L: must be above 0"),
        ({"Cd": -0.1}, "X.Cd: must be at least 0"),
        ({"K": float("nan")}, "X.K: must be a finite number"),
        ({"K": 10**400}, "X.K: must be a finite number"),
        ({"Jt": None}, "X.Jt: must be a number, not None"),
        ({"ft": True}, "X.ft: must be a number"),
        ({"J": 0.07}, "did you mean 'Jt'"),
        ({"held_out": {"moves": 4}}, "X.held_out.rms_um: must be a finite number of at least 0, not None"),
        ({"held_out": {"rms_um": -1}}, "X.held_out.rms_um: must be a finite number of at least 0, not -1"),
        ({"held_out": {"rms_um": 0.7, "max_um": "2"}}, "X.held_out.max_um: must be a finite number of at least 0"),
        ({"held_out": 3}, "X.held_out: must be a table"),
        ({"terms": {"presliding_um": -2}}, "X.terms.presliding_um: must be at least 0"),
        ({"terms": {"loadd": 1.0}}, "X.terms.loadd: is not a parameter (did you mean 'load'?)"),
        ({"terms": {"Cd": 1.0}}, "X.terms.Cd: is not a parameter"),
        ({"terms": {"load": "2"}}, "X.terms.load: must be a number, not '2' (in N.m)"),
        ({"terms": {"viscous_positive": -0.1}}, "X.terms.viscous_positive: must be at least 0"),
        ({"terms": {"resonance": 80, "resonance_share": 1.0}}, "X.terms.resonance_share: must be from 0.01 to 0.99"),
        ({"terms": {"resonance": 80, "resonance_share": 0}}, "X.terms.resonance_share: must be from 0.01 to 0.99"),
        ({"terms": {"stribeck": 1.0}}, "X.terms.stribeck: requires stribeck_speed"),
        ({"terms": {"stribeck": 1.0, "stribeck_speed": 0}}, "X.terms.stribeck_speed: must be above 0"),
        ({"terms": {"stribeck": -6.0, "stribeck_speed": 5}}, "X.terms.stribeck: exceeds the dry friction"),
        ({"terms": {"stribeck_speed": 5}}, "X.terms.stribeck_speed: has no meaning without stribeck"),
        ({"terms": {"ripple_motor_24_phase": 1}}, "has no meaning without ripple_motor_24"),
        ({"terms": {"ripple_motor_0": 1}}, "X.terms.ripple_motor_0: is not a parameter"),
        ({"terms": [1]}, "X.terms: must be a table of names, not [1]"),
        ({"loops": 3}, "X.loops: must be a table of names, not 3"),
    ],
)
def test_fault_is_named_with_key(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_model_file(write_model_file(tmp_path, json.dumps({"X": GOOD | change})))
    assert message in str(caught.value)


def test_terms_and_loops_are_read(tmp_path: Path) -> None:
    terms = {"load": -2.5, "stribeck": -1.0, "stribeck_speed": 12.0, "ripple_screw_1": 0.2, "ripple_screw_1_phase": -1}
    found = load_model_file(
        write_model_file(
            tmp_path, json.dumps({"X": GOOD | {"terms": terms, "loops": {"speed_kp": 21.0, "speed_filter_s": 5e-4}}})
        )
    )
    assert dict(found.parameters["X"].terms) == terms
    config = bench_config()
    changed = apply_loops(config, found.loops, "m.json")
    assert changed.axis["X"].regulators.speed_kp == 21.0
    assert changed.axis["X"].regulators.speed_filter_s == 5e-4
    assert changed.axis["Y"] == config.axis["Y"]
    assert changed.store == config.store


@pytest.mark.parametrize(
    ("loops", "message"),
    [
        ({"speed_k": 21.0}, "axis.X.regulators.speed_k: is not a key of this section (did you mean 'speed_kp'?)"),
        ({"speed_kp": "fast"}, "axis.X.regulators.speed_kp"),
        ({"structure": "double_pi"}, "double_pi needs position_ki_per_s2"),
    ],
)
def test_invalid_loops_are_refused(loops: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        apply_loops(bench_config(), {"X": loops}, "m.json")
    assert message in str(caught.value)


def test_configured_resonance_is_added_to_model() -> None:
    config = bench_config()
    axis = config.axis["X"].model_copy(update={"resonance_hz": 80.0, "resonance_damping": 0.05})
    config = config.model_copy(update={"axis": {**config.axis, "X": axis}})
    path = build_trajectory(np.column_stack([np.linspace(0, 1, 10), np.zeros(10)]))
    nominal = build_nominal_models(config)
    found = select_models(path, nominal, config, "m.json")
    assert dict(found["X"].terms) == {"resonance": 80.0, "resonance_damping": 0.05}
    assert found["Y"].terms == ()
    own = nominal["X"].replace_values(resonance=60.0)
    assert select_models(path, nominal | {"X": own}, config, "m.json")["X"] == own


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"X": 3}', "no json", '{"X": {"R": 1}}', "[" * 100_000])
def test_other_files_are_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(ConfigError):
        load_model_file(write_model_file(tmp_path, text))


@pytest.mark.parametrize("text", ['{"X": {"R": 1}, "X": {"R": 2}}', '{"X": {"R": 1, "R": 2}}'])
def test_duplicate_key_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "model.json"
    file.write_text(text)
    with pytest.raises(ConfigError, match="appears twice"):
        load_model_file(file)


def test_all_faults_are_reported_at_once(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        load_model_file(write_model_file(tmp_path, json.dumps({"X": {"R": -1}, "Y": 2})))
    assert len(caught.value.faults) == 7


def test_axis_at_rest_needs_no_model() -> None:
    config = bench_config()
    demand = np.column_stack([np.linspace(0, 1, 10), np.zeros(10)])
    nominal = build_nominal_models(config)
    assert set(select_models(build_trajectory(demand), {"X": nominal["X"]}, config, "m.json")) == {"X", "Y"}
    with pytest.raises(ConfigError, match="X: moves and has no model"):
        select_models(build_trajectory(demand), {"Y": nominal["Y"]}, config, "m.json")


CONFIG = bench_config()
FILTERED: Mapping[str, float | str] = {"speed_filter_s": 0.002, "speed_kp": 23.4}


def make_published_set(loops: Mapping[str, float | str] | None, digest: str = CONFIG.digest) -> dict[str, ParameterSet]:
    return {"X": replace(make_published(), config_digest=digest, loops=loops)}


def test_published_set_is_used_with_its_loops() -> None:
    models, config = load_validated_models(make_published_set(FILTERED), CONFIG, "store")
    assert models == {"X": BENCH}
    assert config.axis["X"].regulators.speed_filter_s == 0.002
    assert config.axis["Y"] == CONFIG.axis["Y"]
    assert config.store.directory == CONFIG.store.directory
    assert load_validated_models(make_published_set(None), CONFIG, "store")[1] is CONFIG
    assert load_validated_models(make_published_set({}, "another"), CONFIG, "store")[1] is CONFIG


def test_loops_of_earlier_configuration_are_refused_unless_equal() -> None:
    older = make_published_set(FILTERED, "another")
    with pytest.raises(
        ConfigError, match=r"axis\.X\.regulators: LoopsDiffer: .*speed_filter_s 0.002 instead of 0,"
    ) as error:
        load_validated_models(older, CONFIG, "store")
    assert "enter the loops that the rapids showed" in str(error.value)
    copied = apply_loops(CONFIG, {"X": {**FILTERED, "speed_kp": 23.402}}, "copied")
    assert load_validated_models(older, copied, "store")[1] is copied


def make_friction_set(dry_nm: float, stribeck_nm: float, covariance: Float) -> dict[str, ParameterSet]:
    parameters = BENCH.replace_values(Cd=dry_nm, stribeck=stribeck_nm, stribeck_speed=8.0)
    return {"X": replace(make_published(parameters=parameters), covariance=covariance)}


def test_slightly_unphysical_set_is_bounded() -> None:
    covariance = np.diag([0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2.8**2, 1.0])
    models, _ = load_validated_models(make_friction_set(4.95, -6.4, covariance), CONFIG, "store")
    assert models["X"].Cd + models["X"].get_term("stribeck") == 0.0
    assert models["X"].Cd == pytest.approx(4.95 + 1.45 / (1 + 2.8**2))
    for reported in (make_friction_set(4.95, -26.4, covariance), make_friction_set(4.95, -6.4, np.zeros((6, 6)))):
        with pytest.raises(ConfigError, match="X: Unphysical: friction in the newest set would drive"):
            load_validated_models(reported, CONFIG, "store")
