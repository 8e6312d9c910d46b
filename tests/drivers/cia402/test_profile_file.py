"""A profile is the user's own file, one based on another, or taken from an EDS; its faults are named."""

from __future__ import annotations

from pathlib import Path

import pytest

from fdhil.commissioning.record import axis_digest
from fdhil.config import Drive
from fdhil.drivers.cia402.profile_file import load_profile, read_profile, require_offset
from fdhil.errors import ConfigError, EdsError
from tests.drivers.cia402.eds_text import COMMON, CURRENT, I16, I32, OFFSETS, SERVO, U16, U32, eds_file, pdos
from tests.drivers.wire import machine

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


def own(folder: Path, text: str) -> Drive:
    path = folder / "own.toml"
    path.write_text(text)
    return Drive(profile=str(path))


def test_a_file_of_the_users_is_a_profile(tmp_path: Path) -> None:
    profile = load_profile(own(tmp_path, 'title = "mine"\nspeed_unit = "rpm"\nnotes = ["a"]\n' + PDOS))
    assert (profile.name, profile.title, profile.speed_unit, profile.notes) == ("own", "mine", "rpm", ("a",))
    assert not profile.takes_offset
    with pytest.raises(ConfigError, match=r"own maps no offset .*let the NC play the corrected demand"):
        require_offset(profile, "X")


def test_a_file_may_build_on_a_packaged_profile(tmp_path: Path) -> None:
    profile = load_profile(own(tmp_path, 'base = "epos4"\nspeed_unit = "millirpm"\nduty_per_count = 0.01\n'))
    packaged = read_profile("epos4")
    assert (profile.speed_unit, profile.duty_per_count) == ("millirpm", 0.01)
    assert (profile.tpdos, profile.current) == (packaged.tpdos, packaged.current)


def test_a_path_counts_from_the_folder_of_the_configuration(tmp_path: Path) -> None:
    own(tmp_path, PDOS)
    drive = machine(folder=tmp_path, drive={"profile": "own.toml"}).axis["X"].drive
    assert load_profile(drive).name == "own"


def test_what_a_file_says_is_a_part_of_the_configuration(tmp_path: Path) -> None:
    """A model identified in one unit does not hold for the same machine in another."""
    digests, records = [], []
    for text in (PDOS, 'speed_unit = "rpm"\n' + PDOS, PDOS):
        own(tmp_path, text)
        read_profile.cache_clear()
        config = machine(folder=tmp_path, drive={"profile": "own.toml"})
        digests.append(config.digest)
        records.append(axis_digest(config, "X"))
    assert digests[0] == digests[2] != digests[1]
    assert records[0] == records[2] != records[1]
    assert machine().axis["X"].drive.files_digest == ""


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
def test_what_is_wrong_is_named(text: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        load_profile(own(tmp_path, text))
    assert WRONG[text] in str(caught.value)


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        load_profile(Drive(profile=str(tmp_path / "none.toml")))
    with pytest.raises(EdsError, match="cannot be read"):
        load_profile(Drive(profile="cia402", eds=tmp_path / "none.eds"))
    (tmp_path / "long.toml").write_bytes(b" " * 300_000)
    with pytest.raises(ConfigError, match="larger than 256 KiB"):
        load_profile(Drive(profile=str(tmp_path / "long.toml")))


def test_the_generic_profile_takes_what_the_eds_offers(tmp_path: Path) -> None:
    profile = load_profile(Drive(profile="cia402", eds=eds_file(tmp_path, SERVO)))
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
    assert (profile.vendor_id, profile.takes_offset) == (0x12, True)


def test_a_drive_without_a_current_gives_its_torque(tmp_path: Path) -> None:
    torque = ((0x6077, 0, I16, "ro", 1, None), (0x60A9, 0, U32, "rw", 0, 0xFDB44700))
    profile = load_profile(Drive(profile="cia402", eds=eds_file(tmp_path, (*COMMON, *torque, *pdos()))))
    assert (profile.current, profile.current_unit) == ((0x6077, 0), "permille_of_rated_torque")
    assert profile.speed_unit == "millirpm"
    assert not profile.takes_offset


def test_few_places_are_filled_with_what_is_needed_first(tmp_path: Path) -> None:
    eds = eds_file(tmp_path, (*COMMON, *OFFSETS, *CURRENT, *pdos(count=2, room=3)))
    profile = load_profile(Drive(profile="cia402", eds=eds))
    mapped = [[f"{e.index:04X}" for e in spec.entries] for spec in profile.tpdos]
    assert mapped == [["6064", "606C"], ["6041", "6078", "6062"]]


def test_fixed_pdos_are_taken_as_they_are(tmp_path: Path) -> None:
    words = {
        0x1600: [0x60400010, 0x607A0020],
        0x1A00: [0x60410010, 0x60780010],
        0x1A01: [0x60640020, 0x606C0020],
    }
    variables = (*COMMON, *CURRENT, *pdos(count=2, room=2, access="ro", mapped=words))
    kinds = [(i, s, t, a, m, 1 if i in (0x1400, 0x1800, 0x1801) and s == 2 else d) for i, s, t, a, m, d in variables]
    profile = load_profile(Drive(profile="cia402", eds=eds_file(tmp_path, kinds)))
    assert [[e.mapping for e in spec.entries] for spec in profile.tpdos] == [words[0x1A00], words[0x1A01]]


def test_own_signals_are_laid_into_the_pdos_of_the_eds(tmp_path: Path) -> None:
    """A drive with its current in mA in a vendor-specific object, and its duty."""
    own_objects = ((0x2039, 2, I32, "ro", 1, None), (0x3203, 1, U16, "ro", 1, None))
    eds = eds_file(tmp_path, (*COMMON, *own_objects, *pdos()))
    drive = own(
        tmp_path,
        'base = "cia402"\ncurrent = [0x2039, 2]\ncurrent_unit = "mA"\nvoltage = [0x3203, 1]\nduty_per_count = 0.001\n',
    )
    profile = load_profile(drive.model_copy(update={"eds": eds}))
    carried = {key: profile.find_tpdo(key) for key in (profile.current, (0x3203, 1))}
    assert {key: at[1].bits for key, at in carried.items() if at} == {(0x2039, 2): 32, (0x3203, 1): 16}


def test_what_the_eds_does_not_have_is_left_out_of_a_packaged_profile(tmp_path: Path) -> None:
    """An EPOS4 whose firmware is older than object 0x3203."""
    current = ((0x30D1, 2, I32, "ro", 1, None),)
    eds = eds_file(tmp_path, (*COMMON, *OFFSETS, *current, *pdos()), "maxon motor ag", 0xFB)
    profile = load_profile(Drive(profile="epos4", eds=eds))
    assert profile.voltage_objects == ()
    found = profile.find_tpdo((0x30D1, 2))
    assert found is not None
    assert [f"{e.index:04X}" for e in found[0].entries] == ["6041", "30D1"]


def test_a_profile_may_be_written_for_a_second_axis(tmp_path: Path) -> None:
    """For a device whose axes share the first PDOs: the file's PDOs are used unchanged."""
    second = {"607A": "687A", "6064": "6864", "606C": "686C", "6041": "6841", "6040": "6840", "6078, 0": "2100, 2"}
    text = 'base = "roboteq"\nlogical_axis = 2\ntarget = [0x607A, 0]\ncurrent = [0x6078, 0]\nposition = [0x6064, 0]\n'
    text += "speed = [0x606C, 0]\nstatusword = [0x6041, 0]\n" + PDOS
    for old, new in (*second.items(), ("TPDO2", "TPDO4"), ("TPDO1", "TPDO3"), ("0x280", "0x480"), ("0x180", "0x380")):
        text = text.replace(old, new)
    drive = own(tmp_path, text).model_copy(update={"logical_axis": 2})
    profile = load_profile(drive)
    assert [(s.name, s.cob_base) for s in profile.tpdos] == [("TPDO3", 0x380), ("TPDO4", 0x480)]
    assert profile.object_index(0x6060) == 0x6860


def test_a_second_axis_lies_0x800_and_64_pdos_higher() -> None:
    first, second = read_profile("fdhil_twin"), load_profile(Drive(logical_axis=2))
    assert (second.target, second.offset, second.position) == ((0x687A, 0), (0x68B0, 0), (0x6864, 0))
    assert second.voltage == first.voltage
    assert [(s.name, s.number, s.cob_base) for s in second.tpdos] == [
        (f"TPDO{s.number + 64}", s.number + 64, s.cob_base + 1) for s in first.tpdos
    ]
    assert second.takes_offset
    assert second.object_index(0x6060) == 0x6860
    assert second.object_index(0x1018) == 0x1018
