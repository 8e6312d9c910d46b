"""Sockets and settings: allowed frames, parsing, and settings that survive their file."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdhil.errors import ConfigError
from fdhil.guard.can_socket import (
    ERROR,
    MOST_FRAMES,
    BusDown,
    ForbiddenFrame,
    RawCan,
    SocketcandText,
    adopt_descriptor,
    decode_controller_states,
)
from fdhil.guard.guard_settings import GuardSettings, decode_settings, encode_settings, load_settings
from tests.guard.simulated_bus import settings


@pytest.fixture
def wire() -> Iterator[tuple[SocketcandText, socket.socket]]:
    server = socket.create_server(("127.0.0.1", 0))
    far = socket.create_connection(server.getsockname())
    near, _ = server.accept()
    server.close()
    can = SocketcandText(near, allowed={0x301, 0x764}, wanted={0x080, 0x181, 0x301})
    yield can, far
    can.close()
    far.close()


def frames_of(can: SocketcandText, far: socket.socket, text: bytes) -> list[tuple[int, bytes]]:
    far.sendall(text)
    far.shutdown(socket.SHUT_WR)
    got = []
    try:
        while True:
            got += [(cob_id, data) for cob_id, data, _ in can.receive()]
    except BusDown:
        return got


class Narrow(socket.socket):
    def send(self, data: object, flags: int = 0) -> int:
        return super().send(bytes(data)[:5], flags)  # type: ignore[call-overload] # bytes are given


def test_partially_sent_frame_sets_the_bus_down() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()):
        near, _ = server.accept()
        with Narrow(fileno=near.detach()) as narrow, pytest.raises(BusDown, match="part of a frame"):
            SocketcandText(narrow, allowed={0x301}, wanted={0x080}).send(0x301, bytes(4))


def test_only_allowed_cob_ids_are_sent(wire: tuple[SocketcandText, socket.socket]) -> None:
    can, far = wire
    assert can.send(0x301, b"\x02\x0a\xff\x00")
    assert far.recv(100) == b"< send 301 4 02 0a ff 00 >"
    for cob_id in range(0x800):
        if cob_id not in (0x301, 0x764):
            with pytest.raises(ForbiddenFrame):
                can.send(cob_id, b"\0")
    assert can.send(0x764, b"\x05")
    assert far.recv(100) == b"< send 764 1 05 >"


def test_socketcand_frames_are_parsed_in_any_notation(wire: tuple[SocketcandText, socket.socket]) -> None:
    text = b"< frame 181 23.424242 11 22 >< frame 080 1.5 >< frame 181 1.0 0AFF                 >"
    text += b"< frame 7FF 1.0 00 >< frame 00000181 1.0 00 >< ok >< frame 181 x 00 >< frame 181 1.0 0 >garbage>"
    text += b"< frame 181 nan 00 >"
    text += b"< error 00000040 1.0 >< error zz 1.0 >< frame 301 1.0 01 >"
    assert frames_of(*wire, text) == [
        (0x181, b"\x11\x22"),
        (0x080, b""),
        (0x181, b"\x0a\xff"),
        (ERROR, b"off"),
        (0x301, b"\x01"),
    ]


def test_split_frames_are_reassembled(wire: tuple[SocketcandText, socket.socket]) -> None:
    can, far = wire
    far.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    got = []
    for byte in b"< frame 181 1.0 1122 >< frame 080 2.0 01 >":
        far.sendall(bytes([byte]))
        got += can.receive()
    while len(got) < 2:
        got += can.receive()
    assert got == [(0x181, b"\x11\x22", 1.0), (0x080, b"\x01", 2.0)]


def babble(can: SocketcandText, far: socket.socket) -> None:
    far.setblocking(False)
    while True:
        with contextlib.suppress(BlockingIOError):
            far.send(b"x" * 4096)
        can.receive()


def listen(can: SocketcandText) -> None:
    while True:
        can.receive()


def pour(can: SocketcandText, frames: int) -> None:
    for _ in range(frames):
        if not can.send(0x301, b"\0\0\0\0"):
            raise BusDown("full")


def test_hub_with_invalid_protocol_sets_the_bus_down(wire: tuple[SocketcandText, socket.socket]) -> None:
    with pytest.raises(BusDown, match="protocol"):
        babble(*wire)


def test_closed_hub_sets_the_bus_down(wire: tuple[SocketcandText, socket.socket]) -> None:
    can, far = wire
    far.close()
    with pytest.raises(BusDown, match="closed"):
        listen(can)
    with pytest.raises(BusDown):
        pour(can, 1_000_000)


def test_full_queue_is_reported(wire: tuple[SocketcandText, socket.socket]) -> None:
    with pytest.raises(BusDown, match=r"part of a frame|full"):
        pour(wire[0], 1_000_000)


class Raw:
    def __init__(self) -> None:
        self.options: list[tuple[int, int]] = []
        self.waiting: list[tuple[bytes, list[tuple[int, int, bytes]]]] = []
        self.sent: list[bytes] = []
        self.error: OSError | None = None
        self.is_there = True

    def getsockname(self) -> tuple[str]:
        return ("can0",)

    def bind(self, address: tuple[str]) -> None:
        assert address == ("can0",)
        if not self.is_there:
            raise OSError(19, "No such device")

    def fileno(self) -> int:
        return 5

    def getsockopt(self, level: int, option: int) -> int:
        assert (level, option) == (socket.SOL_SOCKET, socket.SO_ERROR)
        error, self.error = self.error, None
        return error.errno or 0 if error else 0

    def setblocking(self, flag: bool) -> None:
        assert not flag

    def setsockopt(self, level: int, option: int, value: object) -> None:
        self.options.append((level, option))

    def recvmsg(self, size: int, ancillary: int) -> tuple[bytes, list[tuple[int, int, bytes]], int, None]:
        if not self.waiting:
            raise self.error or BlockingIOError(11, "again")
        data, control = self.waiting.pop(0)
        return data, control, 0, None

    def send(self, data: bytes) -> int:
        if self.error is not None:
            raise self.error
        self.sent.append(data)
        return len(data)


def test_raw_socket_decodes_frames_stamps_drops_and_controller_states() -> None:
    raw = Raw()
    can = RawCan(raw, {0x301}, {0x080})  # type: ignore[arg-type] # this host has no CAN
    stamp = [(socket.SOL_SOCKET, 29, struct.pack("@ll", 12, 500_000))]
    drops = [(socket.SOL_SOCKET, 40, struct.pack("<I", 7))]
    raw.waiting = [
        (struct.pack("=IB3x8s", 0x080, 1, b"\x05"), stamp),
        (struct.pack("=IB3x8s", 0x80000080, 1, b"\x05"), [*stamp, (socket.SOL_SOCKET, 99, b"")]),
        (struct.pack("=IB3x8s", 0x20000004, 8, b"\0\x20"), drops),
        (struct.pack("=IB3x8s", 0x20000140, 8, b""), drops),
    ]
    assert can.receive() == [
        (0x080, b"\x05", 12.5),
        (ERROR, b"passive", 0.0),
        (ERROR, b"off", 0.0),
        (ERROR, b"restarted", 0.0),
    ]
    assert can.lost_frames == 7
    raw.waiting = [(struct.pack("=IB3x8s", 0x080, 1, b"\x05"), stamp)] * (MOST_FRAMES + 3)
    assert [len(can.receive()) for _ in range(3)] == [MOST_FRAMES, 3, 0]  # a flood must not keep the loop
    assert can.send(0x301, b"\x01\0\0\0")
    assert raw.sent == [struct.pack("=IB3x8s", 0x301, 4, b"\x01")]
    with pytest.raises(ForbiddenFrame):
        can.send(0x300, b"")
    raw.error = OSError(105, "No buffer space available")
    assert not can.send(0x301, b"")
    raw.error = OSError(100, "Network is down")
    with pytest.raises(BusDown, match="Network is down"):
        can.send(0x301, b"")
    with pytest.raises(BusDown):
        can.receive()


def test_raw_socket_restarts_after_its_interface_returns(monkeypatch: pytest.MonkeyPatch) -> None:
    raw, flags = Raw(), 0x40
    monkeypatch.setattr("fcntl.ioctl", lambda _file, _request, asked: struct.pack("@16sH22x", asked[:16], flags))
    can = RawCan(raw, {0x301}, {0x080})  # type: ignore[arg-type] # this host has no CAN
    frame: tuple[bytes, list[tuple[int, int, bytes]]] = (struct.pack("=IB3x8s", 0x080, 1, b"\x05"), [])
    raw.is_there = False
    assert not can.try_restore()
    raw.is_there = True
    raw.error = OSError(100, "Network is down")
    assert not can.try_restore()  # it is down
    flags |= 1
    raw.error = OSError(100, "Network is down")  # told when it was bound, and known
    raw.waiting = [frame] * (MOST_FRAMES + 3)
    raw.options.clear()
    assert can.try_restore()
    assert (socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER) in raw.options
    assert can.receive() == []
    raw.waiting = [frame] * 100_000
    assert not can.try_restore()  # a flood is looked at the next time
    monkeypatch.setattr(raw, "getsockopt", lambda *_: 0)
    raw.waiting, raw.error = [], OSError(100, "Network is down")
    assert not can.try_restore()  # down again at once


def test_closed_hub_is_never_restored(wire: tuple[SocketcandText, socket.socket]) -> None:
    assert not wire[0].try_restore()


@pytest.mark.parametrize(
    ("can_id", "detail", "states"),
    [
        (0x20000004, 0x04, ["warning"]),
        (0x20000004, 0x08, ["warning"]),
        (0x20000004, 0x10, ["passive"]),
        (0x20000004, 0x40, ["active"]),
        (0x20000004, 0x00, []),
        (0x20000100, 0x00, ["restarted"]),
        (0x20000008, 0x00, []),
    ],
)
def test_controller_states_are_decoded(can_id: int, detail: int, states: list[str]) -> None:
    assert decode_controller_states(can_id, bytes([0, detail, 0, 0, 0, 0, 0, 0])) == states


def test_settings_survive_their_file() -> None:
    made = settings(token_sha256="ab" * 32, offset_synchronous=False, daemon_uid=7, watching=(8, 9))
    assert decode_settings(encode_settings(made)) == made


def test_modified_settings_file_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "guard.json"
    file.write_text(encode_settings(settings()).replace('"heartbeat_s": 0.02', '"heartbeat_s": 0.03'))
    with pytest.raises(ConfigError, match="damaged or was changed by hand"):
        load_settings(file)


@pytest.mark.parametrize(
    "path",
    [
        ("schema",),
        ("sync_period_s",),
        ("clock",),
        ("axes",),
        ("axes", 0, "limits", "offset"),
        ("axes", 0, "offset", "layout"),
        ("axes", 0, "offset", "cob_id"),
        ("axes", 0, "window"),
        ("axes", 0, "setpoint_delay_cycles"),
        ("heartbeat_s",),
        ("transport",),
    ],
)
@pytest.mark.parametrize("value", [None, -1, "x", [], 0.5, float("nan")])
def test_invalid_settings_are_one_error(path: tuple[str | int, ...], value: object) -> None:
    document = json.loads(encode_settings(settings()))
    inner = document
    for key in path[:-1]:
        inner = inner[key]
    if value == 0.5 and path[-1] in ("sync_period_s", "heartbeat_s"):
        return
    inner[path[-1]] = value
    with pytest.raises(ConfigError, match="fdhil-guard"):
        decode_settings(json.dumps(document))


@given(st.text(max_size=50))
def test_invalid_settings_text_is_refused(text: str) -> None:
    with pytest.raises(ConfigError):
        decode_settings(text)


def test_two_axes_with_one_offset_pdo_are_refused() -> None:
    document = json.loads(encode_settings(settings()))
    document["axes"][1]["offset"]["cob_id"] = document["axes"][0]["offset"]["cob_id"]
    with pytest.raises(ConfigError, match="share"):
        decode_settings(json.dumps(document))


@pytest.mark.parametrize("taken", [("axes", 1, "target"), ("axes", 0, "target"), ("axes", 1, "tpdos", 0)])
def test_offset_pdo_with_a_foreign_id_is_refused(taken: tuple[str | int, ...]) -> None:
    """It would reach the drive as half a set-point, or the NC as a drive's data."""
    document = inner = json.loads(encode_settings(settings()))
    for key in taken:
        inner = inner[key]
    document["axes"][0]["offset"]["cob_id"] = inner["cob_id"]
    with pytest.raises(ConfigError, match="is also used by"):
        decode_settings(json.dumps(document))


def test_guard_heartbeat_with_a_drives_id_is_refused() -> None:
    document = json.loads(encode_settings(settings()))
    document["node_id"] = document["axes"][1]["node_id"]
    with pytest.raises(ConfigError, match="is also used by"):
        decode_settings(json.dumps(document))


def test_duplicate_axes_are_refused() -> None:
    document = json.loads(encode_settings(settings()))
    document["axes"][1]["tpdos"] = document["axes"][0]["tpdos"]
    with pytest.raises(ConfigError, match="two axes share a name"):
        decode_settings(json.dumps(document))


def test_settings_derive_allowed_ids_and_silence() -> None:
    made: GuardSettings = settings()
    assert made.sent_ids == {0x301, 0x302, 0x764}
    assert made.silence_s == 10.0
    assert settings(clock="monotonic").silence_s == pytest.approx(0.004)
    assert made.heartbeat_cycles == 20


def test_quiet_hub_does_not_block_and_a_broken_one_is_reported(wire: tuple[SocketcandText, socket.socket]) -> None:
    can, far = wire
    assert can.receive() == []
    far.sendall(b"< frame 181 1.0 " + b"00" * 30_000 + b" >")  # longer than any frame, and taken in pieces
    got: list[tuple[int, bytes, float]] = []
    while not got:
        got = can.receive()
    assert len(got[0][1]) == 30_000
    far.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    far.close()  # resets the connection
    with pytest.raises(BusDown, match="reset"):
        listen(can)


def test_descriptor_is_adopted_by_its_kind() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()) as near:
        can = adopt_descriptor("socketcand", os.dup(near.fileno()), {0x301}, {0x080})
        assert isinstance(can, SocketcandText)
        can.close()
        with pytest.raises(OSError, match=r"Errno"):
            adopt_descriptor("can_raw", near.detach(), {0x301}, {0x080})


def test_special_file_as_settings_does_not_block(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "link").symlink_to(tmp_path / "fifo")
    (tmp_path / "bytes").write_bytes(b"\xff\xfe")
    for name in ("fifo", "link", "bytes", "missing", "."):
        with pytest.raises(ConfigError, match="run fdhil-guard"):
            load_settings(tmp_path / name)
    (tmp_path / "good").write_text(encode_settings(settings()))
    assert load_settings(tmp_path / "good") == settings()
