"""The machine configuration: all faults are reported at once, each with its path and a suggestion."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from fdhil import config
from fdhil.config import config_loader
from fdhil.config.section import _check_magnitude
from fdhil.errors import ConfigError
from tests.bench import bench_config, bench_document


def list_faults(document: dict[str, Any]) -> str:
    with pytest.raises(ConfigError) as caught:
        config.parse_config(document)
    assert caught.value.exit_code == 2
    return "\n".join(str(fault) for fault in caught.value.faults)


def test_bench_config_is_complete_and_other_keys_have_defaults() -> None:
    machine = bench_config()
    assert machine.nc.smoothing_s == (0.060, 0.030)
    assert [machine.get_node_id(axis) for axis in machine.axis] == [1, 2]
    assert machine.axis["X"].scaling.increments_per_mm == pytest.approx(3276.8)
    assert machine.axis["X"].rapid_speed_rad_s == pytest.approx(157.0796, rel=1e-6)


@pytest.mark.fault("F7")
def test_all_faults_are_reported_at_once() -> None:
    document = bench_document()
    del document["axis"]["X"]["screw_pitch_mm"]
    document["axis"]["X"]["nominal"]["Jtt"] = 3.0
    document["axis"]["Y"]["nominal"]["R"] = math.nan
    document["axis"]["Y"]["correction"]["max_offset_um"] = 900.0
    document["g0"] = {"source": "infered"}
    text = list_faults(document)
    assert "axis.X.screw_pitch_mm: is missing (table travel per motor revolution)" in text
    assert "axis.X.nominal.Jtt: is not a key of this section (did you mean 'Jt'?)" in text
    assert "axis.Y.nominal.R: " in text
    assert "nan" in text
    assert "axis.Y.correction.max_offset_um: " in text
    assert "did you mean 'inferred'?" in text


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            {"speed_period_s": 0.0003},
            "axis.X.regulators.speed_period_s: 0.0003 s does not divide sync_period_s of its bus, 0.001 s",
        ),
        ({"current_kp": -1.0}, "axis.X.regulators.current_kp"),
        ({"structure": "p_pi"}, "did you mean 'p_pi_pi'?"),
        ({"voltage_limit_v": "300"}, "axis.X.regulators.voltage_limit_v: must be a number, not '300'"),
    ],
)
def test_regulator_structures_check_their_gains(change: dict[str, Any], expected: str) -> None:
    document = bench_document()
    document["axis"]["X"]["regulators"].update(change)
    assert expected in list_faults(document)


@pytest.mark.parametrize("value", [True, "1", "1e3", "yes"])
def test_number_refuses_text_and_booleans(value: object) -> None:
    document = bench_document()
    document["axis"]["X"]["nominal"]["R"] = value
    document["axis"]["X"]["correction"] = {"max_offset_um": value}
    document["sim"] = {"seed": value, "axis": {"X": {"limit_switches_mm": [value, 1.0]}}}
    document["bus"] = {"can0": {"bitrate": value}}
    reported = list_faults(document)
    keys = ("axis.X.nominal.R", "axis.X.correction.max_offset_um", "sim.seed", "bus.can0.bitrate")
    for key in (*keys, "sim.axis.X.limit_switches_mm.0"):
        assert f"{key}: must be a number, not {value!r}" in reported


@pytest.mark.parametrize("value", [1, 0.0, "yes", "true"])
def test_switch_accepts_only_booleans(value: object) -> None:
    document = bench_document()
    document["sim"] = {"nc": value}
    assert f"sim.nc: must be true or false, not {value!r}" in list_faults(document)


def test_integers_paths_and_adapter_options_are_accepted() -> None:
    document = bench_document()
    document["axis"]["X"]["nominal"]["R"] = 1
    document["store"] = {"directory": "data"}
    options = {"text": "1", "switch": True, "whole": 1, "number": 1.5}
    document["bus"] = {"can0": {"bitrate": 1e6, "options": options}}
    read = config.parse_config(document)
    assert (read.axis["X"].nominal.R, read.store.directory, read.bus["can0"].bitrate) == (1.0, Path("data"), 1_000_000)
    assert repr(dict(read.bus["can0"].options)) == repr(options)


def test_limits_that_cannot_be_ramped_down_in_time_are_refused() -> None:
    document = bench_document("X")
    document["axis"]["X"]["correction"] = {
        "max_offset_um": 250.0,
        "max_speed_mm_s": 2.0,
        "max_acceleration_mm_s2": 400.0,
    }
    assert "from the largest offset to zero these limits need" in list_faults(document)


@pytest.mark.parametrize(
    ("per_turn", "limits", "told"),
    [
        (2000, (50.0, 2.0, 2000.0), "2,000 increments per turn are too coarse: max_acceleration_mm_s2 is 0.2"),
        (2000, (50.0, 2.0, 2000.0), "set the drive to 10,000 or more per turn, or raise max_acceleration_mm_s2"),
        (9_000, (50.0, 1.0, 2000.0), "max_speed_mm_s is 0.45 of an increment per SYNC cycle (set the drive to 20,000"),
        (15_000, (50.0, 1.5, 2000.0), ""),
        (10_000, (50.0, 2.0, 2000.0), ""),
        (65_536, (50.0, 2.0, 250.0), ""),
        (100, (50.0, 20.0, 2000.0), "set the drive to 10,000 or more per turn"),
        (65_536, (50.0, 1e-9, 2000.0), "no resolution suffices"),
    ],
)
def test_increments_too_coarse_for_the_limits_are_refused(
    per_turn: int, limits: tuple[float, float, float], told: str
) -> None:
    """The message gives the required resolution; rounded up to one increment per SYNC the limits would differ."""
    document = bench_document("X")
    names = ("max_offset_um", "max_speed_mm_s", "max_acceleration_mm_s2")
    document["axis"]["X"]["correction"] = dict(zip(names, limits, strict=True))
    document["axis"]["X"]["drive"] = {"increments_per_rev": per_turn}
    if told:
        assert told in list_faults(document)
    else:
        assert config.OffsetBounds.derive(config.parse_config(document).axis["X"], 0.001).whole_increments[2] == 1


def test_duplicate_node_id_is_refused() -> None:
    document = bench_document()
    document["axis"]["X"]["drive"] = {"node_id": 2}
    assert "have the same node_id on one bus" in list_faults(document)


@pytest.mark.parametrize("section", ["guard", "play"])
def test_own_heartbeat_with_a_drives_node_id_is_refused(section: str) -> None:
    document = bench_document() | {section: {"node_id": 2}}
    assert f"{section}.node_id: it is that of drive Y" in list_faults(document)


def test_two_sections_for_one_bus_are_refused() -> None:
    """Every SYNC would be sent twice, and two drives with the same node-ID would be accepted."""
    place = {"interface": "socketcand", "host": "127.0.0.1", "port": 29536}
    document = bench_document() | {"bus": {"can0": place, "can1": place}}
    document["axis"]["Y"]["drive"] = {"node_id": 1, "bus": "can1"}
    assert "bus.can1: it is the same bus as [bus.can0]" in list_faults(document)
    document["bus"]["can1"] = {**place, "channel": "can1"}
    config.parse_config(document)


def test_byte_order_mark_is_ignored() -> None:
    assert config.parse_toml(b"\xef\xbb\xbf[machine]\nname = 'mill'\n", "m.toml") == {"machine": {"name": "mill"}}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (b"[machine\n", "is not valid TOML"),
        (b"\xff\xfe", "is not valid TOML"),
        (b"#" * 300_000, "larger than 256 KiB"),
        (b"", "machine"),
    ],
)
def test_invalid_files_are_config_errors(tmp_path: Path, text: bytes, expected: str) -> None:
    path = tmp_path / "machine.toml"
    path.write_bytes(text)
    with pytest.raises(ConfigError, match=expected):
        config.load_config(path)


def test_a_missing_file_is_a_config_error() -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        config.load_config(Path("nowhere.toml"))


def test_store_directory_is_relative_to_the_config(tmp_path: Path) -> None:
    machine = bench_config(folder=tmp_path)
    assert machine.store.directory == tmp_path / "fdhil-data"
    assert machine.store.run_directory == tmp_path / "fdhil-data" / "run"


@pytest.mark.parametrize(
    ("section", "key", "value", "range_"),
    [
        ("machine", "sync_period_s", 1e-301, "from 0.0001 to 0.02"),
        ("machine", "sync_period_s", math.inf, "from 0.0001 to 0.02"),
        ("axis.X", "screw_pitch_mm", 1e-301, "from 0.001 to 10000"),
        ("axis.X", "max_jerk_mm_s3", 1e300, "to 1e+09"),
        ("axis.X.correction", "max_speed_mm_s", 1e-301, "from 1e-12 to 1e+09"),
        ("axis.X.correction", "max_speed_mm_s", 1e301, "above 0 and at most 20"),
        ("axis.X.regulators", "speed_kp", 1e-301, "from 1e-12 to 1e+09"),
        ("axis.X.regulators", "current_period_s", 1e-301, "from 1e-06 to 0.02"),
        ("axis.X.nominal", "Jt", math.nan, "from 1e-09 to 1e+06"),
        ("axis.X.drive", "rated_current_a", 0.0, "from 0.001 to 100000"),
        ("nc", "smoothing_s", [1e9], "from 0 to 10"),
    ],
)
def test_number_out_of_range_is_reported_with_the_range(section: str, key: str, value: float, range_: str) -> None:
    document = bench_document("X")
    table = document
    for part in section.split("."):
        table = table.setdefault(part, {})
    table[key] = value
    reported = list_faults(document)
    assert f"{section}.{key}" in reported
    assert range_ in reported


def test_every_number_of_every_section_has_a_range() -> None:
    """Whatever the file contains, each number is finite and within what a machine can have."""
    open_ended = []

    def walk(section: type[config.Section], place: str) -> None:
        for key, field in section.model_fields.items():
            inner = [a for a in config_loader._list_type_arguments(field.annotation) if isinstance(a, type)]
            for kind in inner:
                if issubclass(kind, config.Section):
                    walk(kind, f"{place}{key}.")
                elif kind in (int, float):
                    reported = list(config_loader._iterate_constraints(field)) + list(
                        config_loader._iterate_constraints(field.annotation)
                    )
                    bounded = any(hasattr(c, "le") for c in reported) and any(
                        hasattr(c, "ge") or hasattr(c, "gt") for c in reported
                    )
                    bounded |= any(getattr(c, "func", None) is _check_magnitude for c in reported)
                    if not bounded and key != "sign":
                        open_ended.append(f"{place}{key}")

    walk(config.MachineConfig, "")
    assert open_ended == []


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a = " + "[" * 100_000, "nested deeper"),
        ("a = " + "{b=" * 60_000, "nested deeper"),
        ("a = " + "9" * 5000, "is not valid TOML"),
        ("[machine]\nsync_period_s = 0x" + "f" * 5000, "machine.sync_period_s: "),
        ('[machine]\nname = "' + "x" * 200_000 + '"', "machine.name: "),
        ('[machine]\nsync_period_s = "' + "9" * 5000 + '"', "machine.sync_period_s: "),
        ("[store]\nkeep_windows = 0x" + "f" * 5000, "store.keep_windows: "),
        ("[machine]\n" + "".join(f"k{n} = 1\n" for n in range(20_000)), "more faults (fix these first)"),
        (("x" * 100_000) + " = 1", "is not a key of this section"),
        ("a" + ".a" * 100_000 + " = 1", "nested deeper"),
        (("a" + ".a" * 90 + " = 1\n") + ("[b" + ".b" * 90 + "]\n") * 1000, "is not valid TOML"),
    ],
    ids=lambda text: text[:24],
)
@pytest.mark.fault("G7")
def test_hostile_file_is_a_short_config_error(text: str, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "machine.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        config.load_config(path)
    reported = str(caught.value)
    assert expected in reported
    assert len(reported) < 12_000
