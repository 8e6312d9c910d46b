"""EDS files with every irregularity found in the field are read; unreadable ones raise one error with the line."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import pytest
from canopen.objectdictionary import import_od
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.eds import INTEGER_TYPES, MAX_BYTES, MAX_OBJECTS, EdsFile, parse_eds, read_eds, read_expression
from fdhil.errors import EdsError
from tests.eds import SHEETS, write_eds

GOOD = """\
[FileInfo]
FileName=a.eds
[DeviceInfo]
VendorName=Some Vendor
VendorNumber=0x12
ProductNumber=0x34
BaudRate_1000=1
NrOfRXPDO=4
[DummyUsage]
Dummy0001=0
Dummy0002=0
Dummy0003=0
Dummy0004=0
Dummy0005=1
Dummy0006=0
Dummy0007=0
[1000]
ParameterName=Device type
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue=0x20192
PDOMapping=0
[1800]
ParameterName=TPDO 1
ObjectType=0x9
SubNumber=2
[1800sub0]
ParameterName=Highest sub-index
DataType=0x0005
AccessType=ro
DefaultValue=1
[1800sub1]
ParameterName=COB-ID
DataType=0x0007
AccessType=rw
DefaultValue=$NODEID+0x40000180
"""

QUIRKS = {
    "windows text": (GOOD.replace("Some Vendor", "\u201cVendor\u201d \u2013 f\u00fcr alle")).encode("cp1252"),
    "byte order mark": b"\xef\xbb\xbf" + GOOD.encode(),
    "incomplete dummies": GOOD.replace("Dummy0001=0\n", "").replace("Dummy0007=0\n", "").encode(),
    "comments miscounted": (GOOD + "[Comments]\nLines=9\nLine1=a\n").encode(),
    "blank numbers": GOOD.replace("VendorNumber=0x12", "VendorNumber=").replace("NrOfRXPDO=4", "NrOfRXPDO=").encode(),
    "leading zeros": GOOD.replace("NrOfRXPDO=4", "NrOfRXPDO=004").replace("PDOMapping=0", "PDOMapping=000").encode(),
    "section twice": (GOOD + "[1000]\nParameterName=Device type\nDataType=7\nAccessType=ro\n").encode(),
    "key twice": GOOD.replace("AccessType=ro\n", "AccessType=ro\nAccessType=ro\n").encode(),
    "comment behind a value": GOOD.replace("ObjectType=0x7", "ObjectType=0x07 # VAR").encode(),
    "semicolon behind a value": GOOD.replace("DataType=0x0007", "DataType=0x0007 ; U32").encode(),
    "keys in other case": GOOD.replace("ParameterName", "parametername").replace("DataType", "DATATYPE").encode(),
    "blank mapping": GOOD.replace("PDOMapping=0", "PDOMapping=").encode(),
    "carriage returns": GOOD.replace("\n", "\r\n").encode(),
    "lines that say nothing": (GOOD + "\n\nrubbish without a sign\n;comment\n#comment\n\0\n").encode(),
    "blank node id": (GOOD + "[DeviceComissioning]\nNodeID=\nBaudrate=\n").encode(),
    "no access type": GOOD.replace("AccessType=rw\n", "").encode(),
}


def collect_defaults(file: EdsFile) -> dict[tuple[int, int], str]:
    """Return the defaults of all entries by (index, sub-index), as written."""
    return {(entry.index, entry.sub): entry.default for item in file.objects for entry in item.entries}


@pytest.mark.parametrize("quirk", QUIRKS)
def test_field_quirk_is_accepted(quirk: str) -> None:
    defaults = collect_defaults(parse_eds(QUIRKS[quirk], "drive.eds"))
    assert read_expression(defaults[0x1800, 1]) == (0x40000180, True)
    assert read_expression(defaults[0x1000, 0]) == (0x20192, False)


def test_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.eds"
    path.write_text(GOOD)
    assert collect_defaults(read_eds(path))[0x1800, 1] == "$NODEID+0x40000180"


@pytest.mark.parametrize("sheet", SHEETS)
def test_reader_agrees_with_the_canopen_library(sheet: str, tmp_path: Path) -> None:
    path = write_eds(sheet, tmp_path)
    dictionary, node_id = import_od(str(path), 5), 5
    for item in read_eds(path).objects:
        for entry in (entry for entry in item.entries if entry.data_type in INTEGER_TYPES):
            found: Any = dictionary[item.index]
            variable = found if item.object_type == 7 else found[entry.sub]
            number, relative = read_expression(entry.default) or (None, False)
            assert variable.default == (number if number is None else number + node_id * relative)
            assert (variable.data_type, variable.access_type) == (entry.data_type, entry.access)
            assert variable.pdo_mappable == entry.mappable


@pytest.mark.parametrize(
    ("raw", "says"),
    [
        (b"", "line 1: it has no object"),
        (b"hello", "line 1: it has no object"),
        (b"\xef\xbb\xbf<?xml version='1.0'?>\n<ISO15745ProfileContainer>\n", "line 1: it is XML (an XDD"),
        (GOOD.replace("ObjectType=0x7", "ObjectType=banana").encode(), "line 19: ObjectType is 'banana'"),
        (GOOD.replace("DataType=0x0007\n", "", 1).encode(), "line 17: [1000] has no DataType"),
        (GOOD.replace("[1800]", "[1801]").encode(), "[1800sub0] belongs to no object"),
        (b"[1000]\nParameterName=a\nObjectType=8\nCompactSubObj=999999999\n", "line 4: CompactSubObj is 999999999"),
        (b"[1000]\n" + b"x" * 5000, "line 2 is longer"),
        (b" " * (MAX_BYTES + 1), "larger than 2 MiB"),
        ("".join(f"[{i:04X}]\nDataType=7\n" for i in range(MAX_OBJECTS + 1)).encode(), "more than"),
    ],
)
@pytest.mark.fault("G5")
def test_unreadable_file_is_one_error_with_its_line(raw: bytes, says: str) -> None:
    with pytest.raises(EdsError, match=r"bad\.eds") as caught:
        parse_eds(raw, "bad.eds")
    assert says in str(caught.value)


def test_missing_file_is_an_eds_error(tmp_path: Path) -> None:
    with pytest.raises(EdsError, match="cannot be read"):
        read_eds(tmp_path / "none.eds")


@pytest.mark.usefixtures("real_time")
@settings(deadline=None, max_examples=60)
@given(st.data())
@pytest.mark.fault("G5")
def test_damaged_file_raises_only_eds_errors(data: st.DataObject) -> None:
    raw = bytearray(GOOD.encode())
    for _ in range(data.draw(st.integers(1, 6))):
        at = data.draw(st.integers(0, len(raw) - 1))
        raw[at : at + data.draw(st.integers(0, 20))] = data.draw(st.binary(max_size=6))
    found = None
    with contextlib.suppress(EdsError):
        found = parse_eds(bytes(raw), "bad.eds")
    assert found is None or isinstance(found, EdsFile)
