"""Every form that CiA 306 allows for an EDS or DCF gives the same device: node-IDs, compact storage, numbers."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdhil.drivers.cia402.capabilities import assess_capabilities
from fdhil.drivers.cia402.device_description import DeviceDescription, PdoSlot, read_device
from fdhil.drivers.cia402.drive_profile_file import read_profile
from fdhil.eds import MAX_SECTIONS, parse_eds, read_expression
from fdhil.errors import EdsError
from fdhil.sim.drive.eds_file import read_eds_file
from tests.drivers.cia402.eds_text import COMMON, CURRENT, SERVO, U16, U32, Variable, build_pdo_objects, format_eds

TARGETS = {0x1600: (0x60400010, 0x607A0020), 0x1A00: (0x60640020, 0x606C0020), 0x1A01: (0x60410010, 0x60780010)}
DEFAULT_BASES = [0x200, 0x300, 0x400, 0x500], [0x180, 0x280, 0x380, 0x480]


def read_device_text(text: str, folder: Path, name: str = "drive.eds") -> DeviceDescription:
    path = folder / name
    path.write_text(text)
    return read_device(path)


def list_cob_bases(device: DeviceDescription) -> tuple[list[int | None], list[int | None]]:
    return [place.cob_base for place in device.rpdos], [place.cob_base for place in device.tpdos]


def list_capabilities(text: str, folder: Path, name: str) -> dict[str, str]:
    """Return the points that ``fdhil eds`` prints for a file."""
    device = read_device_text(text, folder, name)
    return {
        each.what: f"{each.answer}: {each.why}"
        for each in assess_capabilities(device, read_profile("cia402", folder / name))
    }


def build_dcf(node: int, commissioning: str) -> str:
    """Return the servo's EDS as a DCF: each PDO has its absolute COB-ID for that node."""
    lines = []
    for line in format_eds(SERVO).splitlines():
        lines.append(line)
        if line.startswith("DefaultValue=$NODEID+"):
            lines.append(f"ParameterValue={int(line.partition('+')[2], 16) + node:#x}")
    return "\n".join([commissioning, *lines, ""])


@pytest.mark.parametrize(
    "commissioning",
    [
        "[DeviceComissioning]\nNodeID=5",
        "[DeviceCommissioning]\nNodeID=0x05",
        "[DEVICECOMISSIONING]\nnodeid = 5 ; of axis X",
        "[DeviceComissioning]\nBaudrate=1000\nNode_ID=005",
        "[Device Commissioning]\nNode-ID=5\nNodeName=X",
    ],
)
def test_absolute_cob_ids_of_a_dcf_belong_to_its_own_node(commissioning: str, tmp_path: Path) -> None:
    assert list_cob_bases(read_device_text(build_dcf(5, commissioning), tmp_path)) == DEFAULT_BASES
    any_node = list_capabilities(format_eds(SERVO), tmp_path, "any.eds")
    assert list_capabilities(build_dcf(5, commissioning), tmp_path, "node5.dcf") == any_node


@pytest.mark.parametrize("node", ["", "[DeviceComissioning]\nNodeID=\n", "[DeviceComissioning]\nNodeID=255\n"])
def test_absolute_cob_ids_of_an_unknown_node_are_none(node: str, tmp_path: Path) -> None:
    assert list_cob_bases(read_device_text(build_dcf(5, node), tmp_path)) == ([None] * 4, [None] * 4)


def test_dcf_with_invalid_node_id_is_refused() -> None:
    with pytest.raises(EdsError, match="NodeID is '128', not from 1 to 127"):
        parse_eds(build_dcf(5, "[DeviceComissioning]\nNodeID=128").encode(), "a.dcf")


@pytest.mark.parametrize("second", ["NodeID=6", "[DeviceCommissioning]\nNodeId=0x06", "NODEID=0"])
def test_dcf_with_two_node_ids_is_refused(second: str) -> None:
    with pytest.raises(EdsError, match="and '5' in a line above: its COB-IDs belong to one of these nodes"):
        parse_eds(build_dcf(5, f"[DeviceComissioning]\nNodeID=5\n{second}").encode(), "a.dcf")
    parse_eds(build_dcf(5, "[DeviceComissioning]\nNodeID=5\nNodeID=0x05").encode(), "a.dcf")


def test_cob_id_below_the_node_id_has_no_base(tmp_path: Path) -> None:
    text = build_dcf(5, "[DeviceComissioning]\nNodeID=5").replace("ParameterValue=0x185", "ParameterValue=0x3")
    assert read_device_text(text, tmp_path).tpdos[0].cob_base is None


@pytest.mark.parametrize(
    ("written", "base", "valid"),
    [
        ("$NODEID+0x180", 0x180, True),
        ("0x180 + $NodeID", 0x180, True),
        ("$NODEID + 0x40000180", 0x180, True),
        ("0x80000000+$NODEID+384", 0x180, False),
        ("($NODEID+0x180)", 0x180, True),
        ("$node_id+0x00000180UL", 0x180, True),
        ("0x180", 0x180, True),
        ("0x80000000", None, False),
        ("0x20000180", None, True),
        ("", None, True),
    ],
)
def test_expression_of_a_cob_id_is_evaluated(written: str, base: int | None, valid: bool, tmp_path: Path) -> None:
    text = format_eds(SERVO).replace("DefaultValue=$NODEID+0x180", f"DefaultValue={written}")
    place = read_device_text(text, tmp_path).tpdos[0]
    assert (place.cob_base, place.valid) == (base, valid)


@pytest.mark.parametrize(
    ("written", "says"),
    [
        ("$NODEID*2", r"DefaultValue of \[1800sub1\] is '\$NODEID\*2' where a number belongs"),
        ("0600", r"'0600': as octal 0x180, as decimal 0x258; write it"),
        ("$NODEID+0600", r"as octal 0x180, as decimal 0x258; write it"),
    ],
)
def test_cob_id_that_cannot_be_read_is_refused(written: str, says: str) -> None:
    text = format_eds(SERVO).replace("DefaultValue=$NODEID+0x180", f"DefaultValue={written}")
    with pytest.raises(EdsError, match=says):
        parse_eds(text.encode(), "a.eds")


@given(
    st.lists(st.integers(0, 2**32), min_size=1, max_size=3), st.booleans(), st.sampled_from(("{:d}", "{:#x}", "{:#X}"))
)
def test_sum_of_numbers_and_node_id_is_read_in_any_order(numbers: list[int], relative: bool, form: str) -> None:
    words = [form.format(number) for number in numbers] + ["$NODEID"] * relative
    for order in (words, words[::-1]):
        assert read_expression(" + ".join(order)) == (sum(numbers), relative)


# numbers with leading zeros


@pytest.mark.parametrize(("written", "value", "doubt"), [("0100", 100, "64 if"), ("0090", 90, ""), ("007", 7, "")])
def test_number_with_leading_zeros_is_read_as_decimal(written: str, value: int, doubt: str, tmp_path: Path) -> None:
    text = format_eds(SERVO).replace("[1017]", f"[1017]\nParameterValue={written}")
    device = read_device_text(text, tmp_path)
    assert device.get_default(0x1017) == value
    assert [doubt in each for each in device.ambiguities] == [True] * bool(doubt)
    assert list_capabilities(text, tmp_path, "a.eds")["heartbeat"] == f"yes: 1017 is {value} ms"


@pytest.mark.parametrize(
    ("line", "other"),
    [
        ("[1800sub1]\nDefaultValue=$NODEID+0x180", "[1800sub1]\nDefaultValue=$NODEID+0600"),
        ("[1A00sub1]\nDefaultValue=0x60640020", "[1A00sub1]\nDefaultValue=014431000040"),
        ("[6064]\nDataType=0x0004", "[6064]\nDataType=010"),
        ("[2000]\nDataType=7\nCompactSubObj=8", "[2000]\nDataType=7\nCompactSubObj=010"),
        ("[DeviceInfo]\nVendorNumber=1", "[DeviceInfo]\nVendorNumber=0123"),
    ],
)
def test_ambiguous_pdo_number_is_refused_by_drivers_and_simulator(line: str, other: str, tmp_path: Path) -> None:
    for written, refused in ((line, False), (other, True)):
        (tmp_path / "drive.eds").write_text(f"{format_eds(SERVO)}\n{written}\n")
        for read in (lambda path: read_device(path), lambda path: read_eds_file(path, 5)):
            with pytest.raises(EdsError, match=r"as octal 0x.*, as decimal 0x") if refused else nullcontext():
                read(tmp_path / "drive.eds")


@pytest.mark.parametrize("written", ["64h", "100 ms", "0x"])
def test_invalid_default_is_ignored_and_reported(written: str, tmp_path: Path) -> None:
    text = format_eds(SERVO).replace("[1017]", f"[1017]\nParameterValue={written}")
    device = read_device_text(text, tmp_path)
    assert device.get_default(0x1017) is None
    assert device.ambiguities == (f"1017:00 is written {written}, which is not a number: ignored",)


def test_missing_heartbeat_default_is_unknown_not_zero(tmp_path: Path) -> None:
    variables = [each for each in SERVO if each[0] != 0x1017] + [(0x1017, 0, U16, "rw", 0, None)]
    assert (
        list_capabilities(format_eds(variables), tmp_path, "a.eds")["heartbeat"]
        == "yes: its EDS does not give its period (1017)"
    )


# compact storage

MAPPING = """\
[1A00]
ParameterName=TPDO1 mapping
ObjectType={kind}
DataType=0x0007
AccessType=rw
DefaultValue=0
CompactSubObj=8
[1A00Value]
NrOfEntries=3
1=0x60410010
2=0x60640020
3=0x60610008
[1A00Name]
NrOfEntries=2
1=status
3=mode
"""


def remove_objects(index: int) -> list[Variable]:
    return [each for each in SERVO if each[0] != index]


@pytest.mark.parametrize("kind", ["0x8", "0x9", "0x7"])
def test_compact_value_list_gives_the_mapping(kind: str, tmp_path: Path) -> None:
    device = read_device_text(format_eds(remove_objects(0x1A00)) + MAPPING.format(kind=kind), tmp_path)
    assert device.tpdos[0].mapped == (0x60410010, 0x60640020, 0x60610008)
    assert device.tpdos[0].room == 8
    names = [device.objects[0x1A00, sub].name for sub in (1, 2, 3)]
    assert names == ["TPDO1 mapping: status", "TPDO1 mapping: TPDO1 mapping 2", "TPDO1 mapping: mode"]


def test_value_list_overrides_explicit_sub_objects(tmp_path: Path) -> None:
    text = format_eds(SERVO) + "[1A00Value]\nNrOfEntries=2\n0=1\n1=0x60640020\n[1800Value]\nNrOfEntries=1\n2=1\n"
    place = read_device_text(text, tmp_path).tpdos[0]
    assert (place.mapped, place.kind) == ((0x60640020,), 1)


def test_compact_pdos_follow_device_info(tmp_path: Path) -> None:
    variables = [each for each in SERVO if not 0x1400 <= each[0] < 0x1C00]
    head = "[DeviceInfo]\nCompactPDO=23\nGranularity=8\nNrOfRXPDO=2\nNrOfTXPDO=5\n"
    text = (
        head
        + format_eds(variables)
        + "[1A01Value]\nNrOfEntries=1\n1=0x60640020\n[1A01sub0]\nDataType=5\nDefaultValue=1\n"
    )
    device = read_device_text(text, tmp_path)
    free = PdoSlot(1, 0x200, True, None, 8, (), fixed=False)
    assert device.rpdos[0] == free
    assert [place.cob_base for place in device.tpdos] == [0x180, 0x280, 0x380, 0x480, None]
    assert [place.valid for place in device.tpdos] == [True, True, True, True, False]
    assert device.tpdos[1].mapped == (0x60640020,)
    assert sorted(sub for index, sub in device.objects if index == 0x1800) == [0, 1, 2, 3, 5]


def test_compact_objects_beyond_the_limit_are_refused() -> None:
    head = "[{:04X}]\nParameterName=a\nObjectType=8\nDataType=7\nAccessType=ro\nCompactSubObj=254\n"
    text = "".join(head.format(0x2000 + k) for k in range(MAX_SECTIONS // 254 + 1))
    with pytest.raises(EdsError, match=f"more than {MAX_SECTIONS} objects in compact form"):
        parse_eds(text.encode(), "a.eds")


# fixed mappings


def build_fixed_mapping(kind_access: str) -> list[Variable]:
    found = []
    for index, sub, kind, access, mappable, default in (
        *COMMON,
        *CURRENT,
        *build_pdo_objects(2, access="ro", mapped=TARGETS),
    ):
        type_of_pdo = 0x1400 <= index < 0x1C00 and sub == 2 and kind != U32
        found.append((index, sub, kind, kind_access if type_of_pdo else access, mappable, default))
    return found


def test_fixed_mapping_with_writable_type_is_set_to_every_sync(tmp_path: Path) -> None:
    found = list_capabilities(format_eds(build_fixed_mapping("rw")), tmp_path, "a.eds")
    assert found["listen"].startswith("yes")
    assert found["mapping"] == "yes: RPDO1, TPDO1, TPDO2 must be set up: the defaults differ"


def test_fixed_mapping_with_fixed_type_cannot_be_recorded(tmp_path: Path) -> None:
    found = list_capabilities(format_eds(build_fixed_mapping("ro")), tmp_path, "a.eds")
    assert found["listen"].startswith("no: no TPDO with every SYNC can carry its position")
