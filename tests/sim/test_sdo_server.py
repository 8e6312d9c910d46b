"""The SDO server against the `canopen` library's client, and frame by frame for invalid requests."""

from __future__ import annotations

import binascii

import canopen
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.sim.drive.object_dictionary import (
    U32,
    AbortCode,
    DataType,
    DictionaryObject,
    Entry,
    ObjectDictionary,
    create_record,
    create_var,
)
from fdhil.sim.drive.sdo_server import SdoServer
from tests.sim.canopen_peer import connect_directly, connect_over_virtual_bus
from tests.sim.drive_rig import Abort, DriveRig

DOMAIN, STRING = DataType.DOMAIN, DataType.VISIBLE_STRING


def create_server(*objects: DictionaryObject) -> SdoServer:
    return SdoServer(ObjectDictionary(objects))


def build_header(command: int, index: int, sub: int = 0) -> bytes:
    return bytes([command]) + index.to_bytes(2, "little") + bytes([sub])


def read_abort_code(answers: list[bytes]) -> int:
    (answer,) = answers
    assert answer[0] == 0x80
    return int.from_bytes(answer[4:8], "little")


def create_domain(content: bytes) -> SdoServer:
    return create_server(create_var(0x2000, "Text", DOMAIN, "rw", content))


def read_segments(sdo: SdoServer) -> bytes:
    first = sdo.answer_request(build_header(0x40, 0x2000) + bytes(4))[0]
    assert first[0] == 0x41
    data, toggle = b"", 0
    while True:
        (answer,) = sdo.answer_request(bytes([0x60 | toggle << 4]) + bytes(7))
        assert answer[0] >> 4 & 1 == toggle
        data += answer[1 : 8 - (answer[0] >> 1 & 7)]
        toggle ^= 1
        if answer[0] & 1:
            assert len(data) == int.from_bytes(first[4:8], "little")
            return data


# -- against the library


@pytest.mark.parametrize("content", [b"", b"12345", b"x" * 7, b"y" * 8, bytes(range(256))])
def test_segmented_upload_returns_object(content: bytes) -> None:
    assert read_segments(create_domain(content)) == (content if content else b"")


def test_strings_and_numbers_read_as_the_library_expects() -> None:
    node, _ = connect_directly(DriveRig().drive)
    assert node.sdo[0x1008].raw == "fdhil twin drive"
    assert node.sdo[0x1018][1].raw == 0x46444849
    assert node.sdo[0x60C2][2].raw == -3
    assert node.sdo[0x607D][1].raw == -(2**31)


@pytest.mark.usefixtures("long_computation")
@settings(deadline=None, max_examples=40)
@given(st.integers(-(2**31), 2**31 - 1), st.booleans())
def test_downloaded_value_is_uploaded(value: int, segmented: bool) -> None:
    node, _ = connect_directly(RIG.drive)
    data = value.to_bytes(4, "little", signed=True)
    node.sdo.download(0x607A, 0, data, force_segment=segmented)
    assert node.sdo.upload(0x607A, 0) == data
    assert node.sdo[0x607A].raw == value


RIG = DriveRig()


@pytest.mark.usefixtures("long_computation")
@settings(deadline=None, max_examples=15)
@given(st.integers(0, 1400), st.integers(1, 127), st.booleans())
def test_library_block_upload_returns_object(cycles: int, block_size: int, crc: bool) -> None:
    rig = DriveRig()
    trace = rig.drive.feedback.trace
    for n in range(cycles):
        trace.append_row(n, -n, n, 3 * n, n % 100, -n % 100)
    node, _ = connect_directly(rig.drive)
    canopen.sdo.client.BlockUploadStream.blksize = block_size
    with node.sdo.open(0x2120, 0, "rb", block_transfer=True, request_crc_support=crc) as stream:
        data = stream.read()
    assert data == trace.read_rows()
    assert len(data) == 20 * min(cycles, 1024)


def test_lost_segment_is_repeated() -> None:
    content = bytes(range(200)) * 3
    sdo = create_domain(content)
    (first,) = sdo.answer_request(build_header(0xA4, 0x2000) + bytes([20, 0, 0, 0]))
    assert first[0] == 0xC6
    segments = sdo.answer_request(bytes([0xA3]) + bytes(7))
    assert [frame[0] for frame in segments] == list(range(1, 21))
    received = b"".join(frame[1:] for frame in segments[:11])
    again = sdo.answer_request(bytes([0xA2, 11, 30]) + bytes(5))  # the 12th was lost, and 30 per block from now on
    assert len(again) == 30
    received += b"".join(frame[1:] for frame in again)
    while len(received) < len(content):
        again = sdo.answer_request(bytes([0xA2, len(again), 127]) + bytes(5))
        received += b"".join(frame[1:] for frame in again)
    assert again[-1][0] & 0x80
    (end,) = sdo.answer_request(bytes([0xA2, len(again), 127]) + bytes(5))
    unused = end[0] >> 2 & 7
    assert end[0] & 0xE3 == 0xC1
    assert received[: len(received) - unused] == content
    assert int.from_bytes(end[1:3], "little") == binascii.crc_hqx(content, 0)
    assert sdo.answer_request(bytes([0xA1]) + bytes(7)) == []


def test_block_upload_works_over_virtual_bus() -> None:
    rig = DriveRig()
    for _ in range(300):
        rig.send_sync()
    with connect_over_virtual_bus(rig.drive) as node:
        assert node.sdo[0x1000].raw == 0x00020192
        node.sdo[0x6081].raw = 12345
        assert node.sdo[0x6081].raw == 12345
        with node.sdo.open(0x2120, 0, "rb", block_transfer=True) as stream:
            assert len(stream.read()) == 300 * 20
        with pytest.raises(canopen.SdoAbortedError) as abort:
            node.sdo.upload(0x5000, 0)
        assert abort.value.code == 0x06020000


# -- every abort code


@pytest.mark.parametrize(
    ("index", "sub", "value", "size", "code"),
    [
        (0x6041, 0, 1, 2, 0x06010002),
        (0x1018, 0, 1, 1, 0x06010002),
        (0x5FFF, 0, 1, 1, 0x06020000),
        (0x1018, 9, 1, 1, 0x06090011),
        (0x6040, 0, 1, 4, 0x06070010),
        (0x607A, 0, 1, 2, 0x06070010),
        (0x6060, 0, 7, 1, 0x06090030),
        (0x6060, 0, -1, 1, 0x06090030),
        (0x605A, 0, 3, 2, 0x06090030),
        (0x605E, 0, 3, 2, 0x06090030),
        (0x60C2, 1, 0, 1, 0x06090030),
        (0x1019, 0, 241, 1, 0x06090030),
        (0x1005, 0, 0x40000080, 4, 0x06090030),
        (0x1014, 0, 0x20000081, 4, 0x06090030),
        (0x1003, 0, 1, 1, 0x06090030),
        (0x1010, 1, 0x12345678, 4, 0x08000020),
        (0x1400, 1, 0x00000201, 4, None),
        (0x1400, 1, 0x00000202, 4, 0x08000022),
        (0x1400, 2, 241, 1, 0x06090030),
        (0x1801, 3, 5, 2, 0x08000022),
        (0x1600, 1, 0x60400010, 4, 0x08000022),
        (0x1403, 1, 0x00000601, 4, 0x06090030),
        (0x1403, 1, 0x20000501, 4, 0x06090030),
        (0x1603, 0, 9, 1, 0x06040042),
        (0x1603, 0, 1, 1, 0x06040041),
        (0x1603, 1, 0x60410010, 4, 0x06040041),
        (0x1603, 1, 0x60400008, 4, 0x06040041),
        (0x1603, 1, 0x10180120, 4, 0x06040041),
        (0x1603, 1, 0x50000020, 4, 0x06040041),
        (0x1603, 1, 0x00070020, 4, None),
        (0x1603, 1, 0x00060020, 4, 0x06040041),
        (0x1016, 1, 0x00800064, 4, 0x06090030),
    ],
)
def test_invalid_writes_are_refused(index: int, sub: int, value: int, size: int, code: int | None) -> None:
    rig = DriveRig()
    if code is None:
        rig.write_object(index, sub, value, size)
        return
    with pytest.raises(Abort) as abort:
        rig.write_object(index, sub, value, size)
    assert f"{abort.value.code:08X}" == f"{code:08X}"


def test_invalid_reads_are_refused() -> None:
    rig = DriveRig()
    for index, sub, code in ((0x2121, 0, 0x06010001), (0x3000, 0, 0x06020000), (0x6041, 1, 0x06090011)):
        with pytest.raises(Abort) as abort:
            rig.read_object(index, sub)
        assert abort.value.code == code
    with pytest.raises(Abort) as abort:
        rig.read_object(0x1003, 1)
    assert abort.value.code == 0x08000024


def test_protocol_errors_abort_transfer() -> None:
    content = b"a segmented string"
    sdo = create_domain(content)
    sdo.answer_request(build_header(0x40, 0x2000) + bytes(4))
    assert read_abort_code(sdo.answer_request(bytes([0x70]) + bytes(7))) == AbortCode.TOGGLE
    assert (
        read_abort_code(sdo.answer_request(bytes([0x60]) + bytes(7))) == AbortCode.COMMAND
    )  # nothing goes on any more
    assert read_abort_code(sdo.answer_request(bytes([0xE0]) + bytes(7))) == AbortCode.COMMAND
    assert read_abort_code(sdo.answer_request(bytes([0x00]) + bytes(7))) == AbortCode.COMMAND
    assert (
        read_abort_code(sdo.answer_request(build_header(0xC1, 0x2000) + bytes(4))) == AbortCode.COMMAND
    )  # the end of no block download
    assert read_abort_code(sdo.answer_request(build_header(0xA4, 0x2000) + bytes(4))) == AbortCode.BLOCK_SIZE
    assert read_abort_code(sdo.answer_request(bytes([0xA3]) + bytes(7))) == AbortCode.COMMAND
    sdo.answer_request(build_header(0xA4, 0x2000) + bytes([5, 0, 0, 0]))
    sdo.answer_request(bytes([0xA3]) + bytes(7))
    assert read_abort_code(sdo.answer_request(bytes([0xA2, 9, 5]) + bytes(5))) == AbortCode.COMMAND
    sdo.answer_request(build_header(0xA4, 0x2000) + bytes([5, 0, 0, 0]))
    sdo.answer_request(bytes([0xA3]) + bytes(7))
    assert read_abort_code(sdo.answer_request(bytes([0xA2, 1, 0]) + bytes(5))) == AbortCode.BLOCK_SIZE
    sdo.answer_request(build_header(0xA4, 0x2000) + bytes([5, 0, 0, 0]))
    assert read_abort_code(sdo.answer_request(bytes([0xA2, 1, 5]) + bytes(5))) == AbortCode.COMMAND  # not started
    sdo.answer_request(build_header(0x40, 0x2000) + bytes(4))
    assert sdo.answer_request(build_header(0x80, 0x2000) + bytes(4)) == []  # the client gives up
    assert read_abort_code(sdo.answer_request(bytes([0x60]) + bytes(7))) == AbortCode.COMMAND


def test_segmented_download_is_checked() -> None:
    sdo = create_server(create_var(0x2000, "Number", U32, "rw"))
    assert (
        read_abort_code(sdo.answer_request(build_header(0x21, 0x2000) + (5).to_bytes(4, "little"))) == AbortCode.LENGTH
    )
    sdo.answer_request(build_header(0x21, 0x2000) + (4).to_bytes(4, "little"))
    assert read_abort_code(sdo.answer_request(bytes([0x11]) + bytes(7))) == AbortCode.TOGGLE
    sdo.answer_request(build_header(0x20, 0x2000) + bytes(4))
    assert sdo.answer_request(bytes([0x01 | 3 << 1, 1, 2, 3, 4]) + bytes(3)) == [bytes([0x20]) + bytes(7)]
    sdo.answer_request(build_header(0x20, 0x2000) + bytes(4))
    assert read_abort_code(sdo.answer_request(bytes([0x01, 1, 2, 3, 4, 5, 6, 7]))) == AbortCode.LENGTH
    text = create_domain(b"")
    text.answer_request(build_header(0x21, 0x2000) + (3).to_bytes(4, "little"))
    assert read_abort_code(text.answer_request(bytes([0x00]) + b"1234567")) == AbortCode.LENGTH
    text.answer_request(build_header(0x21, 0x2000) + (10).to_bytes(4, "little"))
    text.answer_request(bytes([0x00]) + b"1234567")
    text.answer_request(bytes([0x11 | 4 << 1]) + b"890" + bytes(4))
    assert read_segments(text) == b"1234567890"


def test_unannounced_size_is_object_size() -> None:
    sdo = create_server(create_record(0x2000, "Pair", Entry(0x2000, 1, "A", DataType.INTEGER16, "rw")))
    sdo.answer_request(build_header(0x22, 0x2000, 1) + b"\xfe\xff\x55\x55")
    assert (
        sdo.answer_request(build_header(0x40, 0x2000, 1) + bytes(4))[0]
        == build_header(0x4B, 0x2000, 1) + b"\xfe\xff\0\0"
    )


def test_small_object_switches_to_expedited_transfer() -> None:
    sdo = create_domain(b"1234567")
    (answer,) = sdo.answer_request(build_header(0xA0, 0x2000) + bytes([10, 7, 0, 0]))
    assert answer[0] == 0x41


@settings(deadline=None, max_examples=200)
@given(st.lists(st.binary(max_size=8), max_size=12))
def test_server_survives_arbitrary_requests(requests: list[bytes]) -> None:
    rig = RIG
    for request in requests:
        for can_id, data in rig.send_frame(0x600 + rig.node, request):
            assert can_id in (0x580 + rig.node, 0x080 + rig.node)
            assert len(data) == 8
    rig.send_frame(0x600 + rig.node, bytes([0x80]) + bytes(7))
    assert rig.read_object(0x1000) == 0x00020192


@settings(deadline=None, max_examples=60)
@given(st.binary(max_size=600), st.integers(1, 127), st.lists(st.integers(0, 127), max_size=20))
def test_block_upload_survives_any_acknowledgement(content: bytes, size: int, acknowledged: list[int]) -> None:
    sdo = create_domain(content)
    sdo.answer_request(build_header(0xA4, 0x2000) + bytes([size, 0, 0, 0]))
    block = sdo.answer_request(bytes([0xA3]) + bytes(7))
    for count in acknowledged:
        block = sdo.answer_request(bytes([0xA2, min(count, len(block)), size]) + bytes(5))
        if not block or block[0][0] & 0xE3 == 0xC1:
            return
        assert all(frame[0] & 0x7F == n for n, frame in enumerate(block, 1))
