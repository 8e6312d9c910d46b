"""Rotary axes in degrees, and the second drives of gantry axes, in a machine's configuration."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fdhil import config
from fdhil.config import MachineConfig
from fdhil.config.config_template import write_filled_template
from fdhil.errors import ConfigError
from tests.bench import bench_document, rotary_and_gantry_document, rotary_axis

Change = Callable[[dict[str, Any]], object]


def test_degrees_become_arc_lengths_at_the_radius() -> None:
    axis = config.parse_config(rotary_and_gantry_document()).axis["A"]
    assert axis.mm_per_unit == pytest.approx(100.0 * math.pi / 180.0)
    assert axis.screw_pitch_mm == pytest.approx(12.0 * axis.mm_per_unit)
    assert axis.rapid_speed_rad_s == pytest.approx(280.0 / 12.0 * 2 * math.pi)  # of the motor: without the radius
    assert axis.correction is not None
    assert axis.correction.max_offset_um == pytest.approx(140.0 * axis.mm_per_unit)


def test_radius_changes_no_quantity_of_the_motor() -> None:
    documents = bench_document("X"), bench_document("X")
    for document, radius_mm in zip(documents, (50.0, 500.0), strict=True):
        document["axis"]["A"] = rotary_axis(radius_mm)
        document["axis"]["A"].pop("correction")
    near, far = (config.parse_config(document).axis["A"] for document in documents)
    assert near.rapid_speed_rad_s == pytest.approx(far.rapid_speed_rad_s)
    per_degree = [axis.scaling.increments_per_mm * axis.mm_per_unit for axis in (near, far)]
    assert per_degree == pytest.approx([65536 / 12.0] * 2)


def test_other_tables_of_a_rotary_axis_are_in_degrees_too() -> None:
    document = rotary_and_gantry_document()
    document["axis"]["A"] |= {
        "drive": {"following_error_window_deg": 2.0, "speed_limit_deg_s": 300.0},
        "setpoints": {"travel_deg": [-90.0, 90.0]},
        "table": {"cob_id": 0x2A0, "scale": 0.001},
    }
    document["sim"] = {"axis": {"A": {"start_deg": 45.0}}}
    read = config.parse_config(document)
    axis, factor = read.axis["A"], read.axis["A"].mm_per_unit
    assert axis.drive.following_error_window_mm == pytest.approx(2.0 * factor)
    assert axis.top_speed_mm_s == pytest.approx(300.0 * factor)
    assert axis.setpoints is not None
    assert axis.table is not None
    assert axis.setpoints.travel_mm == pytest.approx((-90.0 * factor, 90.0 * factor))
    assert axis.table.scale == pytest.approx(0.001 * factor)
    assert read.sim.axis["A"].start_mm == pytest.approx(45.0 * factor)


def test_second_drive_inherits_keys_except_node_id_and_sensors() -> None:
    document = rotary_and_gantry_document()
    document["axis"]["Y"] |= {
        "drive": {"node_id": 7, "profile": "epos4", "rated_current_a": 12.0},
        "resonance_hz": 90.0,
    }
    document["axis"]["Y"]["table"] = {"cob_id": 0x2A0}
    read = config.parse_config(document)
    first, second = read.axis["Y"], read.axis["Y2"]
    assert second.model_copy(update={"drive": first.drive, "table": first.table}) == first
    assert second.drive == first.drive.model_copy(update={"node_id": None, "sign": -1})
    assert (read.get_node_id("Y"), read.get_node_id("Y2"), second.table) == (7, 3, None)


def test_configuration_survives_dump_and_reload() -> None:
    read = config.parse_config(rotary_and_gantry_document())
    dumped = MachineConfig.model_validate(read.model_dump(mode="json"))
    assert dumped == read
    assert dumped.digest == read.digest


def test_digest_covers_unit_and_radius_but_not_max_difference() -> None:
    digests = {config.parse_config(rotary_and_gantry_document()).digest}
    document = rotary_and_gantry_document()
    document["axis"]["Y2"]["max_difference_um"] = 200.0
    digests.add(config.parse_config(document).digest)
    assert len(digests) == 1
    document["axis"]["A"]["radius_mm"] = 101.0
    assert config.parse_config(document).digest not in digests


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            lambda axis: axis["A"].pop("radius_mm"),
            "axis.A.radius_mm: is missing: angles count as path error at a radius",
        ),
        (lambda axis: axis["A"].update(radius_mm=5.0), "axis.A.radius_mm: must be from 10 to 10000, not 5.0"),
        (lambda axis: axis["A"].update(radius_mm="far"), "axis.A.radius_mm: must be a number, not 'far'"),
        (
            lambda axis: axis["A"].update(rapid_speed_mm_s=90.0),
            "axis.A.rapid_speed_mm_s: is a length, and this axis is rotary (give rapid_speed_deg_s, in degrees)",
        ),
        (lambda axis: axis["A"].pop("screw_pitch_deg"), "axis.A.screw_pitch_deg: is missing"),
        (lambda axis: axis["A"].update(rapid_speed_deg_s=0.0), "axis.A.rapid_speed_deg_s: must be from 0.001"),
        (
            lambda axis: axis["A"].update(rapid_speed_deg_s=5e4),
            "rapid_speed_deg_s = 50000, screw_pitch_deg = 12: the motor's speed in a rapid is 2.5e+05 1/min",
        ),
        (
            lambda axis: axis["A"].update(radius_mm=20.0, correction={"max_offset_um": 200.0}),
            "axis.A.correction: max_offset_mdeg is 573; a rotary axis is limited to 250, whatever its radius",
        ),
        (
            lambda axis: axis["A"]["correction"].update(max_offset_um=20.0),
            "axis.A.correction.max_offset_mdeg: duplicates max_offset_um (keep one of them)",
        ),
        (lambda axis: axis["A"].update(unit="mm"), 'axis.A.unit: is "mm", and keys are in degrees (give unit = "deg")'),
        (lambda axis: axis["X"].update(unit="deg"), "axis.X.unit: programs give X in mm; name a rotary axis A, B or C"),
        (lambda axis: axis["X"].update(unit="inch"), "axis.X.unit: Input should be 'mm' or 'deg'"),
        (lambda axis: axis.pop("Y"), "axis.Y2: is the second drive of axis Y, which is missing (add [axis.Y]"),
        (lambda axis: axis["Y2"].update(screw_pitch_mm=10.0), "axis.Y2.screw_pitch_mm: differs from axis.Y"),
        (lambda axis: axis["Y2"].update(rapid_speed_mm_s=400.0), "axis.Y2.rapid_speed_mm_s: differs from axis.Y"),
        (
            lambda axis: axis["Y2"]["drive"].update(node_id=2),
            "axis.Y2.drive.node_id: drives Y and Y2 have the same node_id on one bus; give them different ones",
        ),
        (
            lambda axis: axis["Y"].update(voltage={"source": "modbus", "port": 502}),
            "axis.Y2.voltage: is missing: the sensor of [axis.Y.voltage] measures the other motor",
        ),
        (
            lambda axis: axis["Y"].pop("correction") and axis["Y2"].update(correction={}),
            "axis.Y2.correction: both drives",
        ),
        (lambda axis: axis.update({"Y3": {}}), "axis.Y3"),
        (
            lambda axis: axis["Y"].update(setpoints={"travel_mm": [0.0, 9.0]}),
            "axis.Y.setpoints: fdhil plays no set-points on a gantry axis: moving one drive would skew the beam",
        ),
    ],
)
def test_impossible_axis_is_refused_with_its_key(change: Change, expected: str) -> None:
    document = rotary_and_gantry_document()
    change(document["axis"])
    with pytest.raises(ConfigError) as caught:
        config.parse_config(document)
    assert expected in str(caught.value)


@pytest.mark.parametrize("value", [None, True, "x", [], {}, [1, 2], {"a": 1}, float("nan"), float("inf"), -1, 10**400])
@pytest.mark.parametrize("key", ["axis", "unit", "radius_mm", "rapid_speed_deg_s", "correction", "drive", "sim"])
def test_wrong_kind_of_value_is_a_fault_of_the_configuration(key: str, value: object) -> None:
    """None: the key is missing. The conversion of angles leaves other faults to the models."""
    document = rotary_and_gantry_document()
    document["sim"] = {"axis": {"A": {}}}
    tables = [document] if key in ("axis", "sim") else [document["axis"]["A"], document["axis"]["Y"]]
    for table in tables:
        table.pop(key, None)
        if value is not None:
            table[key] = value
    if (key, value) in [
        ("correction", None),
        ("correction", {}),
        ("drive", None),
        ("sim", None),
        ("drive", {}),
        ("sim", {}),
    ]:
        assert config.parse_config(document).axis["A"].mm_per_unit > 1.0
    else:
        with pytest.raises(ConfigError):
            config.parse_config(document)


def test_radius_of_a_linear_axis_gives_a_warning() -> None:
    document = bench_document("X")
    document["axis"]["X"]["radius_mm"] = 80.0
    read = config.parse_config(document)
    assert read.axis["X"].mm_per_unit == 1.0
    assert read.digest == config.parse_config(bench_document("X")).digest
    (sentence,) = config.find_unlikely_values(read)
    assert sentence.startswith("axis.X.radius_mm is only used by a rotary axis")


def test_both_drives_of_a_gantry_axis_share_a_bus() -> None:
    document = rotary_and_gantry_document()
    document["bus"] = {"can0": {}, "can1": {"channel": "can1"}}
    document["axis"]["Y2"]["drive"]["bus"] = "can1"
    with pytest.raises(ConfigError, match=r"axis\.Y2\.drive\.bus: both drives of axis Y are on one bus"):
        config.parse_config(document)


def test_filled_template_of_a_rotary_axis_round_trips(tmp_path: Path) -> None:
    document = rotary_and_gantry_document()
    path = tmp_path / "machine.toml"
    path.write_text(write_filled_template(document, {"axis.A.rapid_speed_deg_s": "measured"}))
    assert "rapid_speed_deg_s = 280.0  # measured" in path.read_text().splitlines()
    assert config.load_config(path).digest == config.parse_config(document, folder=tmp_path).digest
