"""What fdhil can do with a drive is decided from its EDS: with the reason, the advice, and an exit code."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from fdhil.drivers.cia402.capabilities import assess_capabilities, find_similar_names, suggest_profile
from fdhil.drivers.cia402.device_description import read_device
from fdhil.drivers.cia402.drive_profile_file import read_profile
from tests.daemon.machine_rig import fdhil
from tests.drivers.cia402.eds_text import (
    COMMON,
    CURRENT,
    I16,
    I32,
    OFFSETS,
    SERVO,
    U16,
    U32,
    Variable,
    build_pdo_objects,
    write_eds_file,
)

STOP = ((0x6007, 0, I16, "rw", 0, 1),)
MAXON = ((0x30D1, 2, I32, "ro", 1, None), (0x3203, 1, U16, "ro", 1, None), (0x2200, 1, U16, "ro", 0, None))
FAULHABER = ((0x6078, 0, I16, "ro", 1, None), (0x2360, 0, I16, "rww", 1, None))


def remove_objects(variables: tuple[Variable, ...], *indices: int) -> tuple[Variable, ...]:
    return tuple(each for each in variables if each[0] not in indices)


def change_objects(variables: tuple[Variable, ...], index: int, access: str, mappable: int = 1) -> tuple[Variable, ...]:
    return tuple((i, s, t, access, mappable, d) if i == index else (i, s, t, a, m, d) for i, s, t, a, m, d in variables)


def list_capabilities(
    folder: Path, variables: tuple[Variable, ...], name: str = "cia402", **maker: Any
) -> dict[str, tuple[str, str]]:
    path = write_eds_file(folder, variables, **maker)
    return {
        a.what: (a.answer, f"{a.why}; {a.advice}")
        for a in assess_capabilities(read_device(path), read_profile(name, path))
    }


def test_servo_with_position_offset_can_be_corrected(tmp_path: Path) -> None:
    reported = list_capabilities(tmp_path, (*SERVO, *STOP))
    assert {what: answer for what, (answer, _) in reported.items()} == {
        "listen": "yes",
        "mapping": "yes",
        "voltage": "no",
        "follow an NC": "yes",
        "correct on line": "yes",
        "feed-forward": "yes",
        "stop alone": "yes",
        "heartbeat": "yes",
        "compare scales": "yes",
        "compare other scales": "no",
        "rapid signal": "yes",
    }
    assert "R and L cannot; wire a sensor" in reported["voltage"][1]
    assert "--set-pdos" in reported["mapping"][1]


CASES: dict[str, tuple[tuple[Variable, ...], str, str, str]] = {
    "no offset": (remove_objects(SERVO, 0x60B0), "correct on line", "no", "no position offset (60B0)"),
    "offset for no PDO": (change_objects(SERVO, 0x60B0, "rw", 0), "correct on line", "no",
                         "no RPDO can carry its 60B0"),
    "offset for RPDOs": (change_objects(SERVO, 0x60B0, "rww"), "correct on line", "perhaps", "only a test on the "
                                                                                             "drive shows"),
    "mode not shown": (change_objects(SERVO, 0x6061, "ro", 0), "correct on line", "no", "no TPDO shows its 6061:00"),
    "no feed-forward": (remove_objects(SERVO, 0x60B2), "feed-forward", "no", "60B1, 60B2"),
    "no current": (remove_objects(SERVO, 0x6078), "listen", "no", "current (6077:00)"),
    "no speed": (remove_objects(SERVO, 0x606C), "listen", "no", "speed (606C:00)"),
    "no SYNC": (remove_objects(SERVO, 0x1005), "listen", "perhaps", "by a timer only"),
    "no abort option": (SERVO, "stop alone", "perhaps", "6007"),
    "no heartbeat": (remove_objects(SERVO, 0x1017), "heartbeat", "no", "1017"),
    "no inputs": (remove_objects(SERVO, 0x60FD), "rapid signal", "no", "inferred"),
    "no modes": (remove_objects(SERVO, 0x6502), "follow an NC", "perhaps", "6502"),
    "no CSP": (
        (*remove_objects(SERVO, 0x6502), (0x6502, 0, U32, "ro", 0, 0x25)), "follow an NC", "no", "no mode 8 (6502 = "
                                                                                                 "00000025)"
    ),
    "another voltage": (
        (*SERVO, (0x2611, 2, I16, "ro", 1, None)), "voltage", "no", "wire a sensor"
    ),
    "a duty by its name": ((*SERVO, (0x3203, 1, U16, "ro", 1, None)), "voltage", "perhaps", "PWM duty cycle"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_missing_capability_is_reported_with_its_reason(case: str, tmp_path: Path) -> None:
    variables, what, answer, says = CASES[case]
    reported = list_capabilities(tmp_path, variables)[what]
    assert reported[0] == answer
    assert says in reported[1]


def test_device_that_is_not_a_drive_is_reported(tmp_path: Path) -> None:
    module = ((0x1000, 0, U32, "ro", 0, 0x00070191), (0x6000, 1, 5, "ro", 1, None))
    reported = list_capabilities(tmp_path, module)
    assert list(reported) == ["listen"]
    assert reported["listen"][0] == "no"
    assert "profile 401" in reported["listen"][1]


@pytest.mark.parametrize(
    ("variables", "vendor", "number", "name"),
    [
        ((*COMMON, *OFFSETS, *MAXON, *build_pdo_objects()), "maxon motor ag", 0xFB, "epos4"),
        (
            (*remove_objects(COMMON, 0x607A), (0x2062, 0, I32, "rww", 1, None), *CURRENT, *build_pdo_objects()),
            "maxon motor ag",
            0xFB,
            "epos2",
        ),
        ((*COMMON, *FAULHABER, *build_pdo_objects()), "Faulhaber", 0x147, "faulhaber"),
        ((*COMMON, *CURRENT, *build_pdo_objects()), "Pilz GmbH & Co. KG", 0, "schunk"),
        ((*COMMON, *CURRENT, *build_pdo_objects()), "Technosoft S.A.", 0x1A3, "technosoft"),
        (SERVO, "Motor Control Ltd", 0x7777, "cia402"),
        (SERVO, "", 0, "cia402"),
    ],
)
def test_vendors_profile_is_suggested(
    variables: tuple[Variable, ...], vendor: str, number: int, name: str, tmp_path: Path
) -> None:
    assert suggest_profile(read_device(write_eds_file(tmp_path, variables, vendor, number))) == name


def test_duty_object_counts_as_voltage_with_caveat(tmp_path: Path) -> None:
    reported = list_capabilities(tmp_path, (*COMMON, *OFFSETS, *MAXON, *build_pdo_objects()), "epos4")["voltage"]
    assert reported[0] == "yes"
    assert "3203:01 (duty) times drive.dc_link_v" in reported[1]


def test_vendor_objects_are_found_by_name(tmp_path: Path) -> None:
    device = read_device(write_eds_file(tmp_path, (*SERVO, *MAXON, *FAULHABER[1:])))
    assert [f"{at.key[0]:04X}" for at in find_similar_names(device, "voltage")] == ["2360", "3203"]
    assert [f"{at.key[0]:04X}" for at in find_similar_names(device, "dc_link")] == ["2200"]
    assert [f"{at.key[0]:04X}" for at in find_similar_names(device, "current")] == ["30D1"]


def test_eds_command_prints_text_and_json(tmp_path: Path, capsys: Any) -> None:
    path = str(write_eds_file(tmp_path, SERVO))
    code, out, err = fdhil("eds", path, capsys=capsys)
    assert (code, err) == (0, "")
    for words in (
        "correct on line",
        "60B0 has a separate RPDO",
        "TPDO1 180+node, every 1 SYNC: 6064:00/32, 606C:00/32",
    ):
        assert words in " ".join(out.split())
    code, out, _ = fdhil("eds", path, "--profile", "epos4", "--json", capsys=capsys)
    message = json.loads(out)
    assert code == 1  # its current is not where an EPOS4 has it
    assert (message["schema"], message["profile"], message["suggested_profile"]) == ("fdhil-eds-1", "epos4", "cia402")
    assert message["abilities"][0]["what"] == "listen"
    assert message["device"]["is_drive"] is True


def test_unknown_profile_exits_with_2(tmp_path: Path, capsys: Any) -> None:
    path = str(write_eds_file(tmp_path, SERVO))
    code, _, err = fdhil("eds", path, "--profile", "epos5", capsys=capsys)
    assert (code, "did you mean 'epos" in err) == (2, True)
    code, _, err = fdhil("eds", path, "--profile", str(tmp_path / "none.toml"), capsys=capsys)
    assert (code, "cannot be read" in err) == (2, True)
