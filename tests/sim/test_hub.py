"""The hub against the stock socketcand client of python-can."""

from __future__ import annotations

import contextlib
import logging
import socket
import struct
import time

import can
import pytest
from can.interfaces.socketcand.socketcand import (
    convert_ascii_message_to_can_message,
    convert_can_message_to_ascii_message,
)
from hypothesis import given
from hypothesis import strategies as st

from fdhil.errors import ConnectError
from fdhil.sim.frame_types import EXTENDED
from fdhil.sim.wire import tcp_hub as hub_module
from fdhil.sim.wire.tcp_hub import TcpHub, decode_send_command, encode_frames
from tests.sim.hub_thread import join_clients, receive_frames, run_hub

_DATA = st.binary(max_size=8)
_STANDARD, _EXTENDED = st.integers(0, 0x7FF), st.integers(0, 0x1FFFFFFF)


@given(_STANDARD, _DATA)
def test_client_decodes_frames_of_hub(can_id: int, data: bytes) -> None:
    text = encode_frames([(can_id, data)], 1700000000.25)
    message = convert_ascii_message_to_can_message(text.decode())
    assert (message.arbitration_id, bytes(message.data), message.is_extended_id) == (can_id, data, False)
    assert message.timestamp == 1700000000.25
    assert len(text) == 64


@given(_EXTENDED, _DATA)
def test_29_bit_identifiers_are_distinct_from_11_bit_ones(can_id: int, data: bytes) -> None:
    message = can.Message(arbitration_id=can_id, data=data, is_extended_id=True)
    frame = decode_send_command(convert_can_message_to_ascii_message(message)[:-1].encode())
    assert frame == (can_id | EXTENDED, data)
    back = convert_ascii_message_to_can_message(encode_frames([frame], 0.0).decode())
    assert (back.arbitration_id, bytes(back.data), back.is_extended_id) == (can_id, data, True)


@given(_STANDARD, _DATA)
def test_hub_decodes_frames_of_client(can_id: int, data: bytes) -> None:
    message = can.Message(arbitration_id=can_id, data=data, is_extended_id=False)
    assert decode_send_command(convert_can_message_to_ascii_message(message)[:-1].encode()) == (can_id, data)


@pytest.mark.parametrize(
    "text",
    [
        "< send",
        "< send 181",
        "< send 181 2 0a",
        "< send 181 1 0a 0b",
        "< send 181 9 0 0 0 0 0 0 0 0 0",
        "< send 800 0",
        "< send 181 1 1ff",
        "< send 181 -1",
        "< send xyz 0",
    ],
)
def test_malformed_frames_are_refused(text: str) -> None:
    assert decode_send_command(text.encode()) is None


def test_client_receives_frames_of_others_but_not_its_own() -> None:
    received = []
    hub = TcpHub("can0")
    with run_hub(hub, lambda hub, frame: received.append(frame)), join_clients(hub, 3) as (a, b, c):
        a.send(can.Message(arbitration_id=0x181, data=b"\x0a\xff", is_extended_id=False))
        b.send(can.Message(arbitration_id=0x000, data=b"\x01\x00", is_extended_id=False))
        assert receive_frames(c, 2) == [(0x181, b"\x0a\xff"), (0x000, b"\x01\x00")]
        assert receive_frames(a, 1) == [(0x000, b"\x01\x00")]
        assert receive_frames(b, 1) == [(0x181, b"\x0a\xff")]
        assert a.recv(0.05) is None
    assert received == [(0x181, b"\x0a\xff"), (0x000, b"\x01\x00")]


def test_simulator_answers_in_order_of_frames() -> None:
    """For SYNC, frame, SYNC in one packet, each answer follows its own request."""
    hub = TcpHub("can0")
    with (
        run_hub(hub, lambda hub, frame: hub.queue_frames([(0x181, frame[1])]) if frame[0] == 0x80 else None),
        join_clients(hub, 1) as (listener,),
        socket.create_connection((hub.host, hub.port)) as plain,
    ):
        for command, answer in ((b"", b"< hi >"), (b"< open can0 >", b"< ok >"), (b"< rawmode >", b"< ok >")):
            plain.sendall(command)
            assert plain.recv(64) == answer
        plain.sendall(b"< send 80 1 1 >< send 201 1 7 >< send 80 1 2 >")
        assert receive_frames(listener, 5) == [
            (0x080, b"\1"),
            (0x181, b"\1"),
            (0x201, b"\7"),
            (0x080, b"\2"),
            (0x181, b"\2"),
        ]


def test_clients_join_busy_bus(caplog: pytest.LogCaptureFixture) -> None:
    """The client reads each greeting with one recv: frames behind the last one would be taken for a wrong answer."""
    hub = TcpHub("can0")
    caplog.set_level(logging.WARNING)
    with run_hub(hub) as thread:
        thread.each_turn = lambda hub: hub.queue_frames([(0x80, b"\1"), (0x181, bytes(8))])
        for _ in range(10):
            with join_clients(hub, 1) as (bus,):
                assert len(receive_frames(bus, 4)) == 4
    assert not [record for record in caplog.records if "ncomplete" in record.message]


def test_late_client_reads_greeting_without_frames() -> None:
    hub = TcpHub("can0")
    with run_hub(hub) as thread, socket.create_connection((hub.host, hub.port)) as late:
        thread.each_turn = lambda hub: hub.queue_frames([(0x80, b"\1"), (0x181, bytes(8))])
        assert late.recv(256) == b"< hi >"
        late.sendall(b"< open can0 >")
        assert late.recv(256) == b"< ok >"
        late.sendall(b"< rawmode >")
        time.sleep(0.2)
        assert late.recv(256) == b"< ok >"
        assert late.recv(8) == b"< frame "


def test_slow_reader_loses_no_frame() -> None:
    """20000 frames against a queue of 4 kB: the hub accepts no frames until the slow reader has read."""
    count = 20000
    hub = TcpHub("can0", queue_bytes=4096)
    with run_hub(hub), join_clients(hub, 2) as (slow, fast), socket.create_connection((hub.host, hub.port)) as sender:
        for command in (b"", b"< open can0 >", b"< rawmode >"):
            sender.sendall(command)
            sender.recv(64)
        sender.setblocking(False)
        text = b"".join(b"< send 201 4 %x %x %x %x >" % tuple(struct.pack("<I", k)) for k in range(count))
        received: dict[int, list[int]] = {0: [], 1: []}
        saw_congestion = False
        deadline = time.monotonic() + 300
        while min(map(len, received.values())) < count and time.monotonic() < deadline:
            with contextlib.suppress(BlockingIOError):
                text = text[sender.send(text[: 1 << 18]) :]
            saw_congestion |= hub.is_congested
            for place, bus in enumerate((slow, fast)):
                for _ in range(100 if place else 50):
                    message = bus.recv(0)
                    if message is not None:
                        received[place].append(int.from_bytes(message.data, "little"))
    assert received[0] == received[1] == list(range(count))
    assert saw_congestion
    assert hub.lost_clients == 0


def test_client_that_never_reads_is_disconnected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hub_module, "STALL_S", 0.05)
    hub = TcpHub("can0", queue_bytes=1 << 16)
    with run_hub(hub) as thread, join_clients(hub, 1):
        thread.each_turn = lambda hub: None if hub.is_congested else hub.queue_frames([(0x181, bytes(8))] * 2000)
        deadline = time.monotonic() + 300
        while not hub.lost_clients and time.monotonic() < deadline:
            time.sleep(0.01)
        thread.each_turn = lambda hub: None
        assert hub.lost_clients == 1
        while hub.clients:
            time.sleep(0.01)


def test_non_socketcand_client_does_not_disturb_others() -> None:
    hub = TcpHub("can0")
    with run_hub(hub), join_clients(hub, 2) as (a, b):
        with socket.create_connection((hub.host, hub.port)) as stranger:
            stranger.recv(64)
            stranger.sendall(b"GET / HTTP/1.1\r\n" + b"x" * 5000)
            assert _read_until_closed(stranger) == b""
        with socket.create_connection((hub.host, hub.port)) as stranger:
            assert stranger.recv(64) == b"< hi >"
            stranger.sendall(b"< open can7 >")
            assert stranger.recv(64) == b"< error could not open bus >"
            stranger.sendall(b"< echo >")
            assert stranger.recv(64) == b"< echo >"
        a.send(can.Message(arbitration_id=0x701, data=b"\0", is_extended_id=False))
        assert receive_frames(b, 1) == [(0x701, b"\0")]
    assert hub.malformed == 1


def _read_until_closed(connection: socket.socket) -> bytes:
    try:
        return connection.recv(64)
    except ConnectionResetError:
        return b""


def test_port_in_use_is_reported_in_one_sentence() -> None:
    hub = TcpHub("can0")
    try:
        with pytest.raises(ConnectError, match=rf"bus can0: TCP port {hub.port} .* cannot be opened"):
            TcpHub("can0", port=hub.port)
    finally:
        hub.close()
