"""Inputs of the largest accepted size: the answer is as fast, and as short, as for any other."""

from __future__ import annotations

import pytest

from fdhil.eds import MAX_OBJECTS, MAX_SECTIONS
from tests.fuzz.input_assessment import assess_input
from tests.fuzz.targets import load_target

pytestmark = pytest.mark.usefixtures("long_computation")

HEAD = "[DeviceInfo]\n[1000]\nParameterName=x\nObjectType=7\nDataType=7\nAccessType=ro\n"
OBJECT = "[{:04X}]\nParameterName=x\nObjectType=8\nDataType=7\nAccessType=ro\nCompactSubObj=254\n"
LARGE = {
    "eds of many keys": HEAD + "".join(f"a{k}=1\n" for k in range(180_000)),
    "eds of many sections": HEAD + "".join(f"[s{k}]\n" for k in range(180_000)),
    "eds of as many sections as it may have": HEAD + "".join(f"[s{k}]\n" for k in range(MAX_SECTIONS - 3)),
    "eds of as many objects as it may have": HEAD + "".join(OBJECT.format(0x2000 + k) for k in range(MAX_OBJECTS - 2)),
    "machine_toml of many axes": "".join(f"[axis.A{k}]\n" for k in range(15_000)),
    "machine_toml of one number": "a = " + "9" * 250_000,
    "fault_script of many wrong entries": '[[fault]]\nfault = "x"\n' * 11_000,
    "fault_script with a long key": "a" * 250_000 + " = 1",
    "daemon_socket of one word": '\0{"request": "' + "a" * 64_000 + '"}',
    "modbus_rtu that babbles": "\0\0\0" + "\1\4\2" * 5_000,
    "nc_lines of many chunks": "\1HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n" + "1\r\na\r\n" * 100_000,
}


@pytest.mark.fault("G5", "G7")
@pytest.mark.parametrize("case", LARGE)
def test_largest_inputs_are_answered_in_time(case: str) -> None:
    finding = assess_input(load_target(case.partition(" ")[0]), LARGE[case].encode())
    assert finding is None, finding
