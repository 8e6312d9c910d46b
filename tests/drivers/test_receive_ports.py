"""Connections to a bus: the socketcand reader against a hub of plain sockets, its clock, and its end."""

from __future__ import annotations

import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterator

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.commissioning.transmit import TransmitBus
from fdhil.config import CanBus as BusSettings
from fdhil.drivers.can.bus_listener import ListeningBus
from fdhil.drivers.can.filters import build_drive_filters
from fdhil.drivers.can.frame_ring import ERROR_FLAG, EXTENDED_FLAG, FrameRing
from fdhil.drivers.can.port_factory import PORTS
from fdhil.drivers.can.socketcand_port import HubClock, SocketcandPort
from fdhil.errors import ConnectError
from tests.reserved_port import reserve_port


class MiniHub:
    """One bus, one client: sends a greeting, then the frames given; ``commands`` are the client's."""

    def __init__(self, greetings: tuple[bytes, ...] = (b"< hi >", b"< ok >", b"< ok >")) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._server.getsockname()[1])
        self._greetings = greetings
        self.client: socket.socket | None = None
        self.commands = b""
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        self.client, _ = self._server.accept()
        for number, greeting in enumerate(self._greetings):
            if number:
                self.commands += self.client.recv(256)
            self.client.sendall(greeting)

    def send_text(self, text: bytes) -> None:
        self._thread.join()
        assert self.client is not None
        self.client.sendall(text)

    def received_text(self) -> bytes:
        assert self.client is not None
        self.client.settimeout(100)
        return self.client.recv(4096)

    def close_connection(self) -> None:
        self._thread.join()
        if self.client is not None:
            self.client.close()

    def close(self) -> None:
        self.close_connection()
        self._server.close()


@pytest.fixture
def hub() -> Iterator[MiniHub]:
    running = MiniHub()
    yield running
    running.close()


def build_settings(port: int) -> BusSettings:
    return BusSettings(interface="socketcand", port=port)


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 300
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_frame_order_is_independent_of_stream_chunks(hub: MiniHub) -> None:
    text = (
        b"< frame 181 1700000000.000100 1122334455667788 >\n< frame 080 1700000000.000200  >"
        b"< frame 00000123 1700000000.000300 AA BB ><error junk>< frame xyz 1 00 >< error 20000040 1700000000.0004 >"
        b"< frame 281 1700000000.000500 01                     >"
    )
    with ListeningBus("can0", build_settings(hub.port)) as bus:
        for k in range(0, len(text), 7):
            hub.send_text(text[k : k + 7])
        wait_for(lambda: bus.read_counters()["frames"] >= 5)
        frames = bus.drain_frames()
    assert [hex(i) for i in frames["id"]] == [
        "0x181", "0x80", hex(EXTENDED_FLAG | 0x123), hex(ERROR_FLAG | 0x40), "0x281",
    ]  # fmt: skip
    assert frames["dlc"].tolist() == [8, 0, 2, 0, 1]
    assert int(frames["data"][0]) == 0x8877665544332211
    assert int(frames["t_ns"][4] - frames["t_ns"][0]) <= 500_000


def test_nothing_is_sent_on_a_bus_opened_for_listening(hub: MiniHub) -> None:
    with ListeningBus("can0", build_settings(hub.port)) as bus:
        assert not hasattr(bus, "send")
        assert not any(hasattr(port, "send") for port in PORTS.values())


def test_sent_frames_follow_the_socketcand_protocol(hub: MiniHub) -> None:
    with TransmitBus("can0", build_settings(hub.port)) as bus:
        bus.send(0x301, b"\x01\xff")
        bus.send(0x80, b"")
        wait_for(lambda: hub.commands.count(b">") >= 2)
        message = hub.received_text()
    assert hub.commands == b"< open can0 >< rawmode >"
    assert message.startswith(b"< send 301 2 1 ff >")


def test_closed_hub_connection_ends_the_bus(hub: MiniHub) -> None:
    with ListeningBus("can0", build_settings(hub.port)) as bus:
        hub.close_connection()
        wait_for(lambda: bus.end_reason is not None)
        assert bus.end_reason == "the CAN hub ended the connection"


@pytest.mark.parametrize("greetings", [(b"HTTP/1.1 400 Bad Request>",), (b"< hi >", b"< error no such bus >")])
def test_server_that_is_not_a_hub_is_reported(greetings: tuple[bytes, ...]) -> None:
    hub = MiniHub(greetings)
    with pytest.raises(ConnectError, match="check host, port and channel"):
        ListeningBus("can0", build_settings(hub.port))
    hub.close()


def test_unreachable_hub_is_reported() -> None:
    with reserve_port() as port, pytest.raises(ConnectError, match="cannot be reached"):
        ListeningBus("can0", build_settings(port))


def test_missing_can_interface_is_reported() -> None:
    with pytest.raises(ConnectError, match=r"ip link|no CAN"):
        ListeningBus("can9", BusSettings(interface="socketcan", channel="nocan9"))


@pytest.mark.usefixtures("real_time")
def test_full_ring_applies_back_pressure_to_the_hub(hub: MiniHub) -> None:
    line = b"< frame 181 1700000000.000100 1122334455667788 >"
    with ListeningBus("can0", build_settings(hub.port), ring_frames=64) as bus:
        sender = threading.Thread(target=hub.send_text, args=(line * 20_000,))
        sender.start()
        got = 0
        while got < 20_000:
            got += bus.drain_frames().size
            time.sleep(0.0005)
        sender.join()
        assert bus.read_counters()["lost"] == 0


def test_virtual_bus_returns_received_frames() -> None:
    channel = uuid.uuid4().hex
    with can.Bus(interface="virtual", channel=channel) as other:
        with TransmitBus("can0", BusSettings(interface="virtual", channel=channel)) as bus:
            other.send(can.Message(arbitration_id=0x181, data=[1, 2], is_extended_id=False))
            wait_for(lambda: bus.read_counters()["frames"] == 1)
            (frame,) = bus.drain_frames()
            bus.send(0x601, b"\x40")
        message = other.recv(100)
    assert (int(frame["id"]), int(frame["data"])) == (0x181, 0x0201)
    assert message is not None
    assert message.arbitration_id == 0x601


def test_filters_apply_to_hub_frames(hub: MiniHub) -> None:
    with ListeningBus("can0", build_settings(hub.port), filters=build_drive_filters([1], [0x33])) as bus:
        for name in ("080", "181", "182", "033", "034", "00000001"):
            hub.send_text(f"< frame {name} 1700000000.0001 11 >".encode())
        hub.send_text(b"< error 20000040 1700000000.0002 >")
        wait_for(lambda: bus.read_counters()["frames"] >= 7)
        assert bus.drain_frames()["id"].tolist() == [0x080, 0x181, 0x033, ERROR_FLAG | 0x40]
        assert bus.read_counters()["frames"] == 7


def test_hub_clock_uses_the_quickest_reading() -> None:
    clock = HubClock()

    def ahead(stamp_s: float, now_s: float) -> float | None:
        return clock.track_ahead_s([f"< frame 181 {stamp_s:.6f} 00"], int(now_s * 1e9))

    assert ahead(1000.0, 10.005) == pytest.approx(989.995)
    assert ahead(1000.1, 10.101) == pytest.approx(989.999)
    assert ahead(1000.2, 10.250) == pytest.approx(989.999, abs=1e-6)
    assert ahead(500.0, 10.3) == pytest.approx(489.7)  # the hub's clock was set
    assert clock.track_ahead_s(["rubbish"], 0) == pytest.approx(489.7)


@settings(max_examples=60)
@given(st.lists(st.binary(max_size=40), max_size=6))
def test_malformed_lines_are_counted_not_raised(pieces: list[bytes]) -> None:
    port = SocketcandPort.__new__(SocketcandPort)
    port._rest, port._clock, port.malformed = b"", HubClock(), 0
    ring = FrameRing(64)
    for piece in pieces:
        port._parse_chunk(piece + b" >", ring, 1)
    port._parse_chunk(b"< frame 181 1.0 01 >", ring, 1)
    assert int(ring.drain_frames()["id"][-1]) == 0x181
