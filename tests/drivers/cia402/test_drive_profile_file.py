"""A profile is the user's own file, one based on another, or taken from an EDS; its faults are named."""

from __future__ import annotations

from pathlib import Path

import pytest

from fdhil.commissioning.commissioning_record import compute_axis_digest
from fdhil.config import Drive
from fdhil.drivers.cia402.drive_profile_file import load_profile, read_profile, require_offset
from fdhil.errors import ConfigError, EdsError
from tests.drivers.cia402.eds_text import (
    COMMON,
    CURRENT,
    I16,
    I32,
    OFFSETS,
    SERVO,
    U16,
    U32,
    build_pdo_objects,
    write_eds_file,
)
from tests.drivers.frame_builder import build_machine_config

PDOS = """
[[rpdos]]
name = "RPDO1"
cob_base = 0x200
entries = [[0x6040, 0, 16, false], [0x607A, 0, 32, true]]
[[tpdos]]
name = "TPDO1"
cob_base = 0x180
entries = [[0x6064, 0, 32, true], [0x606C, 0, 32, true]]
[[tpdos]]
name = "TPDO2"
cob_base = 0x280
entries = [[0x6041, 0, 16, false], [0x6078, 0, 16, true]]
"""


def write_own_profile(folder: Path, text: str) -> Drive:
    path = folder / "own.toml"
    path.write_text(text)
    return Drive(profile=str(path))


def test_users_own_profile_file_is_loaded(tmp_path: Path) -> None:
    profile = load_profile(write_own_profile(tmp_path, 'title = "mine"\nspeed_unit = "rpm"\nnotes = ["a"]\n' + PDOS))
    assert (profile.name, profile.title, profile.speed_unit, profile.notes) == ("own", "mine", "rpm", ("a",))
    assert not profile.can_take_offset
    with pytest.raises(ConfigError, match=r"own maps no offset .*let the NC play the corrected demand"):
        require_offset(profile, "X")


def test_profile_file_inherits_from_packaged_profile(tmp_path: Path) -> None:
    profile = load_profile(
        write_own_profile(tmp_path, 'base = "epos4"\nspeed_unit = "millirpm"\nduty_per_count = 0.01\n')
    )
    packaged = read_profile("epos4")
    assert (profile.speed_unit, profile.duty_per_count) == ("millirpm", 0.01)
    assert (profile.tpdos, profile.current) == (packaged.tpdos, packaged.current)


def test_profile_path_is_relative_to_the_configuration(tmp_path: Path) -> None:
    write_own_profile(tmp_path, PDOS)
    drive = build_machine_config(folder=tmp_path, drive={"profile": "own.toml"}).axis["X"].drive
    assert load_profile(drive).name == "own"


def test_profile_content_is_part_of_the_configuration_digest(tmp_path: Path) -> None:
    """A model identified in one unit does not hold for the same machine in another."""
    digests, records = [], []
    for text in (PDOS, 'speed_unit = "rpm"\n' + PDOS, PDOS):
        write_own_profile(tmp_path, text)
        read_profile.cache_clear()
        config = build_machine_config(folder=tmp_path, drive={"profile": "own.toml"})
        digests.append(config.digest)
        records.append(compute_axis_digest(config, "X"))
    assert digests[0] == digests[2] != digests[1]
    assert records[0] == records[2] != records[1]
    assert build_machine_config().axis["X"].drive.files_digest == ""


WRONG = {
    "title = 3\n" + PDOS: "title: Input should be a valid string",
    "speed_units = 'rpm'\n" + PDOS: "speed_units: is not a key of a profile",
    "speed_unit = 'm/s'\n" + PDOS: "speed_unit: Input should be",
    PDOS.replace("0x606C, 0, 32", "0x606C, 0, 33"): "tpdos.1: a PDO holds 64 bits, not 65",
    PDOS.replace("0x6064, 0, 32, true", "0x6064, 0, 32"): "tpdos.1: not enough values",
    PDOS.replace("0x6064, 0, 32, true", "'a', 0, 32, true"): "tpdos.1: ",
    PDOS.replace("TPDO2", "TPDO"): "tpdos.2: its name 'TPDO' does not end in the number",
    PDOS.replace("cob_base = 0x280\n", ""): "tpdos.2: has no 'cob_base'",
    PDOS.replace("cob_base = 0x280", "cob_base = 0x80"): "cob_base not from",
    PDOS.replace("cob_base = 0x280", "cob_bas = 0x280"): "cob_bas is not a key of a PDO",
    PDOS.replace("0x6078", "0x6077"): "no TPDO with every SYNC carries its current",
    PDOS.replace("[[tpdos]]", "[[tpods]]"): "tpods: is not a key",
    "rpdos = 3\n": "tpdos: is missing",
    "base = 'epos5'": "base: is not a profile: 'epos5'",
    "base = 'own.toml'": "is nested too deeply, or circular",
    "logical_axis = 2\n" + PDOS: "logical_axis: it is for axis 2 of its device, but the configuration has 1",
    "base = 3": "base: is not a profile",
    "a = ": "is not valid TOML",
    "title = 'no PDOs'": "there is no EDS to derive them from",
}


@pytest.mark.parametrize("text", WRONG)
def test_invalid_profile_names_the_fault(text: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        load_profile(write_own_profile(tmp_path, text))
    assert WRONG[text] in str(caught.value)


def test_unreadable_profile_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        load_profile(Drive(profile=str(tmp_path / "none.toml")))
    with pytest.raises(EdsError, match="cannot be read"):
        load_profile(Drive(profile="cia402", eds=tmp_path / "none.eds"))
    (tmp_path / "long.toml").write_bytes(b" " * 300_000)
    with pytest.raises(ConfigError, match="larger than 256 KiB"):
        load_profile(Drive(profile=str(tmp_path / "long.toml")))


def test_generic_profile_uses_the_pdos_of_the_eds(tmp_path: Path) -> None:
    profile = load_profile(Drive(profile="cia402", eds=write_eds_file(tmp_path, SERVO)))
    mapped = {spec.name: [f"{e.index:04X}" for e in spec.entries] for spec in (*profile.rpdos, *profile.tpdos)}
    assert mapped == {
        "RPDO1": ["6040", "607A"],
        "RPDO2": ["60B0"],
        "RPDO3": ["60B1", "60B2"],
        "TPDO1": ["6064", "606C"],
        "TPDO2": ["6041", "6078"],
        "TPDO3": ["6062", "60B0"],
        "TPDO4": ["6061", "60FD"],
    }
    assert [spec.valid for spec in profile.rpdos] == [True, True, False]
    assert [spec.every_sync for spec in profile.tpdos] == [1, 1, 10, 10]
    assert (profile.vendor_id, profile.can_take_offset) == (0x12, True)


def test_drive_without_current_object_uses_its_torque(tmp_path: Path) -> None:
    torque = ((0x6077, 0, I16, "ro", 1, None), (0x60A9, 0, U32, "rw", 0, 0xFDB44700))
    profile = load_profile(
        Drive(profile="cia402", eds=write_eds_file(tmp_path, (*COMMON, *torque, *build_pdo_objects())))
    )
    assert (profile.current, profile.current_unit) == ((0x6077, 0), "permille_of_rated_torque")
    assert profile.speed_unit == "millirpm"
    assert not profile.can_take_offset


def test_scarce_pdo_space_goes_to_required_signals_first(tmp_path: Path) -> None:
    eds = write_eds_file(tmp_path, (*COMMON, *OFFSETS, *CURRENT, *build_pdo_objects(count=2, room=3)))
    profile = load_profile(Drive(profile="cia402", eds=eds))
    mapped = [[f"{e.index:04X}" for e in spec.entries] for spec in profile.tpdos]
    assert mapped == [["6064", "606C"], ["6041", "6078", "6062"]]


def test_fixed_pdos_are_adopted_unchanged(tmp_path: Path) -> None:
    words = {
        0x1600: [0x60400010, 0x607A0020],
        0x1A00: [0x60410010, 0x60780010],
        0x1A01: [0x60640020, 0x606C0020],
    }
    variables = (*COMMON, *CURRENT, *build_pdo_objects(count=2, room=2, access="ro", mapped=words))
    kinds = [(i, s, t, a, m, 1 if i in (0x1400, 0x1800, 0x1801) and s == 2 else d) for i, s, t, a, m, d in variables]
    profile = load_profile(Drive(profile="cia402", eds=write_eds_file(tmp_path, kinds)))
    assert [[e.mapping for e in spec.entries] for spec in profile.tpdos] == [words[0x1A00], words[0x1A01]]


def test_vendor_signals_are_mapped_into_the_pdos_of_the_eds(tmp_path: Path) -> None:
    """A drive with its current in mA in a vendor-specific object, and its duty."""
    own_objects = ((0x2039, 2, I32, "ro", 1, None), (0x3203, 1, U16, "ro", 1, None))
    eds = write_eds_file(tmp_path, (*COMMON, *own_objects, *build_pdo_objects()))
    drive = write_own_profile(
        tmp_path,
        'base = "cia402"\ncurrent = [0x2039, 2]\ncurrent_unit = "mA"\nvoltage = [0x3203, 1]\nduty_per_count = 0.001\n',
    )
    profile = load_profile(drive.model_copy(update={"eds": eds}))
    carried = {key: profile.find_tpdo(key) for key in (profile.current, (0x3203, 1))}
    assert {key: at[1].bits for key, at in carried.items() if at} == {(0x2039, 2): 32, (0x3203, 1): 16}


def test_packaged_profile_is_reduced_to_the_objects_of_the_eds(tmp_path: Path) -> None:
    """An EPOS4 whose firmware is older than object 0x3203."""
    current = ((0x30D1, 2, I32, "ro", 1, None),)
    eds = write_eds_file(tmp_path, (*COMMON, *OFFSETS, *current, *build_pdo_objects()), "maxon motor ag", 0xFB)
    profile = load_profile(Drive(profile="epos4", eds=eds))
    assert profile.voltage_objects == ()
    found = profile.find_tpdo((0x30D1, 2))
    assert found is not None
    assert [f"{e.index:04X}" for e in found[0].entries] == ["6041", "30D1"]


def test_profile_can_describe_a_second_axis(tmp_path: Path) -> None:
    """For a device whose axes share the first PDOs: the file's PDOs are used unchanged."""
    second = {"607A": "687A", "6064": "6864", "606C": "686C", "6041": "6841", "6040": "6840", "6078, 0": "2100, 2"}
    text = 'base = "roboteq"\nlogical_axis = 2\ntarget = [0x607A, 0]\ncurrent = [0x6078, 0]\nposition = [0x6064, 0]\n'
    text += "speed = [0x606C, 0]\nstatusword = [0x6041, 0]\n" + PDOS
    for old, new in (*second.items(), ("TPDO2", "TPDO4"), ("TPDO1", "TPDO3"), ("0x280", "0x480"), ("0x180", "0x380")):
        text = text.replace(old, new)
    drive = write_own_profile(tmp_path, text).model_copy(update={"logical_axis": 2})
    profile = load_profile(drive)
    assert [(s.name, s.cob_base) for s in profile.tpdos] == [("TPDO3", 0x380), ("TPDO4", 0x480)]
    assert profile.shift_object_index(0x6060) == 0x6860


def test_second_axis_is_0x800_and_64_pdos_higher() -> None:
    first, second = read_profile("fdhil_twin"), load_profile(Drive(logical_axis=2))
    assert (second.target, second.offset, second.position) == ((0x687A, 0), (0x68B0, 0), (0x6864, 0))
    assert second.voltage == first.voltage
    assert [(s.name, s.number, s.cob_base) for s in second.tpdos] == [
        (f"TPDO{s.number + 64}", s.number + 64, s.cob_base + 1) for s in first.tpdos
    ]
    assert second.can_take_offset
    assert second.shift_object_index(0x6060) == 0x6860
    assert second.shift_object_index(0x1018) == 0x1018
