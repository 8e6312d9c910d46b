"""Planner and guard derive the same limits, and no file can raise a ceiling."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fdhil import config as machine_config
from fdhil.arming.guard_configuration import make_guard_settings
from fdhil.config import CEILING_ACCELERATION_MM_S2, CEILING_OFFSET_UM, CEILING_SPEED_MM_S, VARIATION_MM, OffsetBounds
from fdhil.correction import PlanLimits, check_offsets
from fdhil.correction.correction_gate import check_writing_enabled
from fdhil.correction.plan_limits import fit_within_limits, round_to_increments
from fdhil.errors import ConfigError
from fdhil.guard import offset_limits as guard_limits
from fdhil.guard.correction_table import check_rows
from fdhil.guard.guard_settings import AxisSettings, decode_settings, encode_settings
from tests.bench import bench_document
from tests.guard.simulated_bus import LIMITS
from tests.guard.simulated_bus import settings as made_settings


def test_config_and_guard_share_the_same_ceilings() -> None:
    """The guard does not import the config, so that both define the ceilings."""
    ours = (CEILING_OFFSET_UM, CEILING_SPEED_MM_S, CEILING_ACCELERATION_MM_S2, VARIATION_MM)
    assert ours == (
        guard_limits.CEILING_OFFSET_UM,
        guard_limits.CEILING_SPEED_MM_S,
        guard_limits.CEILING_ACCELERATION_MM_S2,
        guard_limits.CEILING_VARIATION_MM,
    )
    assert guard_limits.compute_limit_ceilings(3276.8, 0.001, 500.0, 4000.0) == LIMITS  # the bench is at all of them


def documents() -> st.SearchStrategy[dict[str, Any]]:
    def document(per_turn: int, pitch: float, speed: float, hard: float, given: list[float], period: float) -> Any:
        made = bench_document("X")
        axis = made["axis"]["X"]
        made["machine"]["sync_period_s"] = period
        axis |= {"screw_pitch_mm": pitch, "rapid_speed_mm_s": speed, "max_acceleration_mm_s2": hard}
        axis["drive"] = {"increments_per_rev": per_turn}
        names = ("max_offset_um", "max_speed_mm_s", "max_acceleration_mm_s2")
        axis["correction"] = dict(zip(names, given, strict=True))
        return made

    most = (CEILING_OFFSET_UM, CEILING_SPEED_MM_S, CEILING_ACCELERATION_MM_S2)
    return st.builds(
        document,
        st.sampled_from([4096, 10_000, 65_536, 131_072, 1_000_000, 1 << 23]),
        st.floats(1.0, 60.0),
        st.floats(20.0, 2000.0),
        st.floats(200.0, 20_000.0),
        st.tuples(*[st.floats(0.02 * each, each) for each in most]).map(list),
        st.sampled_from([0.0005, 0.001, 0.002, 0.004]),
    )


def coarse_document() -> dict[str, Any]:
    """Return an axis whose largest offset is just less than an increment."""
    made = bench_document("X")
    made["machine"]["sync_period_s"] = 0.004
    axis = made["axis"]["X"]
    axis |= {"screw_pitch_mm": 21.0, "rapid_speed_mm_s": 20.0, "max_acceleration_mm_s2": 321.0}
    axis["drive"] = {"increments_per_rev": 4096}
    axis["correction"] = {"max_offset_um": 5.0, "max_speed_mm_s": 1.0, "max_acceleration_mm_s2": 161.0}
    return made


@pytest.mark.usefixtures("long_computation")
@settings(max_examples=150, deadline=None)
@given(documents(), st.integers(0, 2**32 - 1))
@example(coarse_document(), 0)
def test_planner_and_guard_limits_agree_and_keep_the_ceilings(document: dict[str, Any], seed: int) -> None:
    machine = parsed(document)
    if isinstance(machine, str):
        assert any(words in machine for words in ("too coarse", "from the largest offset to zero", "feed drives have"))
        return
    axis, period = machine.axis["X"], machine.machine.sync_period_s
    if OffsetBounds.derive(axis, period).is_too_coarse:
        with pytest.raises(ConfigError, match="too coarse"):
            make_guard_settings(machine, "can0", Path(), "")
        assert check_writing_enabled(["X"], machine)[0].code == "CoarseIncrements"
        return
    assert OffsetBounds.derive(axis, period).compute_time_to_safe_s(period) <= 0.120 + 1e-9
    whole = make_guard_settings(machine, "can0", Path(), "").axes[0].limits
    planned = PlanLimits.derive(axis, period)
    assert (whole.offset, whole.rate, whole.acceleration, whole.variation, whole.window) == OffsetBounds.derive(
        axis, period
    ).whole_increments
    per_mm = axis.scaling.increments_per_mm
    assert whole.offset <= planned.offset + 1e-6 <= CEILING_OFFSET_UM * 1e-3 * per_mm + 1e-3
    assert whole.rate <= max(1.0, planned.rate) + 1e-6  # one increment is the least that can be sent
    assert planned.rate <= min(20.0, 0.1 * axis.rapid_speed_mm_s) * per_mm * period + 1e-3
    hardest = min(2000.0, 0.5 * axis.max_acceleration_mm_s2) * per_mm * period**2
    assert whole.acceleration <= max(1.0, planned.acceleration) + 1e-6
    assert planned.acceleration <= hardest + 1e-3
    random = np.random.default_rng(seed)
    wanted = planned.offset * random.uniform(0.1, 3) * np.sin(np.arange(400) * random.uniform(0.001, 1.5))
    wanted[200:] += planned.offset * random.choice([-1.0, 0.0, 1.0])
    rows = round_to_increments(fit_within_limits(wanted, planned))
    assert check_offsets(rows, planned) == []
    assert check_rows(whole, [0, *rows.tolist()], 0, rows.size + 1) is None  # from rest, as the planner has it


def parsed(document: dict[str, Any]) -> machine_config.MachineConfig | str:
    try:
        return machine_config.parse_config(document)
    except ConfigError as error:
        return str(error)


def altered(**changes: object) -> str:
    document = json.loads(encode_settings(made_settings()))
    axis = document["axes"][0]
    for key, value in changes.items():
        (axis["limits"] if key in axis["limits"] else axis)[key] = value
    return json.dumps(document)


@pytest.mark.parametrize("name", ["offset", "rate", "acceleration", "variation", "window"])
@pytest.mark.fault("G11")
def test_settings_file_cannot_raise_a_limit_above_its_ceiling(name: str) -> None:
    value = getattr(LIMITS, name)
    assert decode_settings(altered(**{name: value})).axes[0].limits == LIMITS
    wrongs: tuple[object, ...] = (value + 1, 10 * value, 2**62, 0, -1, value + 0.5, True, None, "1", [], math.inf)
    for wrong in wrongs:
        with pytest.raises(ConfigError, match="let fdhil-guard write it"):
            decode_settings(altered(**{name: wrong}))


def test_axis_speed_and_scale_bound_the_limits() -> None:
    for changes in (
        {"max_speed_mm_s": 100.0},
        {"max_acceleration_mm_s2": 1000.0},
        {"increments_per_mm": 3000.0},
        {"increments_per_mm": 1e7},
        {"increments_per_mm": -3276.8},
        {"increments_per_mm": "3276.8"},
        {"max_speed_mm_s": None},
    ):
        with pytest.raises(ConfigError):
            decode_settings(altered(**changes))


@pytest.mark.parametrize("travel", [None, [-5000, 700_000]])
def test_axis_travel_survives_the_settings_file(travel: list[int] | None) -> None:
    document = json.loads(encode_settings(made_settings()))
    document["axes"][0]["travel"] = travel
    assert decode_settings(json.dumps(document)).axes[0].travel == (travel and tuple(travel))


@pytest.mark.usefixtures("long_computation")
@pytest.mark.fault("G11")
def test_any_invalid_value_in_any_field_is_refused() -> None:
    clean = json.loads(encode_settings(made_settings()))
    paths = list(_paths(clean))
    assert len(paths) > 100
    wrongs: tuple[object, ...] = ("\ud800", -1, 1e300, [], {}, [[[]]], None, True, 10**400)
    for path, wrong in itertools.product(paths, wrongs):
        document = json.loads(encode_settings(made_settings()))
        inner = document
        for key in path[:-1]:
            inner = inner[key]
        inner[path[-1]] = wrong
        try:
            read = decode_settings(json.dumps(document))
        except ConfigError:
            continue
        assert all(_inside(axis) for axis in read.axes)


def _paths(value: Any, before: tuple[Any, ...] = ()) -> Any:
    keys = value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    for key in keys:
        yield (*before, key)
        yield from _paths(value[key], (*before, key))


def _inside(axis: AxisSettings) -> bool:
    return axis.limits == LIMITS and axis.offset.layout == ((0x60B0, 0, 32, True),)
