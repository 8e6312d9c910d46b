"""Adapters of python-can are received from: a serial one on a pseudo terminal, and the message where none exists."""

from __future__ import annotations

import os
import select
import time
import tty
from collections.abc import Callable, Iterable, Iterator
from typing import get_args

import numpy as np
import numpy.typing as npt
import pytest

from fdhil.commissioning.transmit import TransmitBus
from fdhil.config import CanBus as BusSettings
from fdhil.config import parse_config
from fdhil.drivers.bus_source import BusSource
from fdhil.drivers.can.bus_listener import ListeningBus
from fdhil.drivers.can.filters import build_drive_filters
from fdhil.drivers.can.frame_ring import EXTENDED_FLAG, REMOTE_FLAG, pack_frames
from fdhil.drivers.can.python_can_port import LISTEN_ONLY, build_bus_arguments
from fdhil.drivers.cia402.bus_decoder import BusDecoder
from fdhil.errors import ConfigError, ConnectError
from fdhil.guard.transmit_socket import open_transmit_socket
from fdhil.records import AxisSamples, Notice
from fdhil.sim.wire.can_buses import attach_bus
from tests.bench import bench_document
from tests.drivers.frame_builder import FrameBuilder, build_machine_config

ADAPTERS = [name for name in get_args(BusSettings.model_fields["interface"].annotation) if name not in (
    "socketcan", "socketcand", "virtual",
)]  # fmt: skip


class SerialAdapter:
    """The far end of a serial line with an adapter that uses the slcan protocol."""

    def __init__(self) -> None:
        self.end, self.line = os.openpty()
        tty.setraw(self.line)
        self.path = os.ttyname(self.line)

    def send_text(self, *lines: str) -> None:
        os.write(self.end, "".join(line + "\r" for line in lines).encode())

    def received_text(self, last: str) -> str:
        """Return what the adapter received up to a line end; a terminal may split it anywhere."""
        message = ""
        while last + "\r" not in message:
            assert select.select([self.end], [], [], 100)[0], message
            message += os.read(self.end, 4096).decode()
        return message

    def close(self) -> None:
        for descriptor in (self.end, self.line):
            os.close(descriptor)


@pytest.fixture
def adapter() -> Iterator[SerialAdapter]:
    running = SerialAdapter()
    yield running
    running.close()


def build_settings(adapter: SerialAdapter, **more: object) -> BusSettings:
    document = {"interface": "slcan", "channel": adapter.path, "options": {"sleep_after_open": 0.0}, **more}
    return BusSettings.model_validate(document)


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 100
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_serial_adapter_receives_and_never_acknowledges(adapter: SerialAdapter) -> None:
    with ListeningBus("can0", build_settings(adapter)) as bus:
        assert "S8\r" in (message := adapter.received_text("L"))  # 1 Mbit/s
        assert "O\r" not in message
        adapter.send_text("t0800", "t18181122334455667788", "T000001232AABB", "r2810")
        wait_for(lambda: bus.read_counters()["frames"] == 4)
        frames = bus.drain_frames()
        assert bus.stamps == "host"
    assert frames["id"].tolist() == [0x80, 0x181, EXTENDED_FLAG | 0x123, REMOTE_FLAG | 0x281]
    assert frames["dlc"].tolist()[:3] == [0, 8, 2]
    assert int(frames["data"][1]) == 0x8877665544332211
    assert sorted(frames["t_ns"].tolist()) == frames["t_ns"].tolist()
    assert 0 <= time.monotonic_ns() - int(frames["t_ns"][-1]) < 100e9


def test_adapter_acknowledges_when_listen_only_is_off(adapter: SerialAdapter) -> None:
    with ListeningBus("can0", build_settings(adapter, listen_only=False, bitrate=500_000)):
        assert "S6\r" in adapter.received_text("O")


def test_adapter_receives_only_filtered_frames(adapter: SerialAdapter) -> None:
    with ListeningBus(
        "can0", build_settings(adapter, frames="drives"), filters=build_drive_filters([1], [0x33])
    ) as bus:
        adapter.send_text("t0800", "t1811AA", "t1821BB", "t0331CC", "t0341DD", "t7011EE", "T000000011FF", "t0011FF")
        wait_for(lambda: bus.read_counters()["frames"] >= 5)
        got = bus.drain_frames()["id"].tolist()
    assert got == [0x80, 0x181, 0x33, 0x701, 0x001]


def test_invalid_frame_or_unplugged_adapter_ends_the_bus(adapter: SerialAdapter) -> None:
    with ListeningBus("can0", build_settings(adapter)) as bus:
        adapter.send_text("t1zz0")
        wait_for(lambda: bus.end_reason is not None)
        assert bus.end_reason is not None
        assert "is gone, or sent an invalid frame" in bus.end_reason
    gone = SerialAdapter()
    with ListeningBus("can0", build_settings(gone)) as bus:
        gone.close()
        wait_for(lambda: bus.end_reason is not None)


def format_slcan(can_id: int, data: bytes) -> str:
    return f"t{can_id:03X}{len(data)}{data.hex().upper()}"


@pytest.mark.usefixtures("real_time")
def test_drive_is_sampled_through_a_serial_adapter(adapter: SerialAdapter, monkeypatch: pytest.MonkeyPatch) -> None:
    """Time stamps in bursts lose no sample and cause no notice of a second SYNC producer."""
    monkeypatch.setattr("fdhil.drivers.cia402.bus_decoder._SYNC_SILENCE_NS", 300e9)  # a host that is held up
    monkeypatch.setattr("fdhil.drivers.bus_source.SILENCE_S", 300.0)
    wire = FrameBuilder(n=400, counter=False)
    config = build_machine_config(bus=build_settings(adapter).model_dump())
    lines = [format_slcan(can_id, data) for _, can_id, data in wire.build_rows()]
    expected = decode_samples(BusDecoder("can0", config).decode_frames(pack_frames(wire.build_rows()), 0))
    source = BusSource("can0", config)
    source.open()
    try:
        got: list[object] = []
        for first in range(0, len(lines), 60):
            adapter.send_text(*lines[first : first + 60])
            wait_for(lambda: source.read_counters()["frames"] == min(first + 60, len(lines)))  # noqa: B023 - it is asked now
            got += source.process_frames(time.monotonic_ns())
    finally:
        source.close()
    assert np.array_equal(decode_samples(got), expected)
    assert expected.shape[1] > 380
    reported = [record for record in got if isinstance(record, Notice)]
    assert [notice.code for notice in reported] == ["CoarseStamps"]
    assert "some 10 ms late" in reported[0].text
    assert source.read_counters()["lost"] == 0


def decode_samples(records: Iterable[object]) -> npt.NDArray[np.float64]:
    """Return tick, demand, position, speed and current of all samples, a column each."""
    samples = [record for record in records if isinstance(record, AxisSamples)]
    return np.hstack([np.stack([s.tick, s.demand_mm, s.position_mm, s.speed_rad_s, s.current_a]) for s in samples])


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("interface", ADAPTERS)
def test_missing_adapter_is_reported(interface: str) -> None:
    settings = BusSettings.model_validate({"interface": interface, "channel": "0"})
    with pytest.raises(ConnectError, match=f"the {interface} adapter 0 cannot be opened .*or use SocketCAN") as message:
        ListeningBus("can0", settings)
    assert "\n" not in str(message.value)


@pytest.mark.parametrize("interface", ADAPTERS)
def test_bus_arguments_follow_the_configuration(interface: str) -> None:
    document = {"interface": interface, "channel": "1", "bitrate": 500_000, "options": {"bitrate": 250_000, "x": "y"}}
    asked = build_bus_arguments(BusSettings.model_validate(document))
    assert asked == {
        "interface": interface,
        "channel": 1,
        "bitrate": 250_000,
        "x": "y",
        **LISTEN_ONLY.get(interface, {}),
    }
    assert "listen_only" not in build_bus_arguments(BusSettings.model_validate(document | {"listen_only": False}))


@pytest.mark.parametrize("interface", ADAPTERS)
def test_python_can_adapters_refuse_to_send(interface: str) -> None:
    settings = BusSettings.model_validate({"interface": interface, "channel": "0"})
    with pytest.raises(ConnectError, match="does not send on"):
        TransmitBus("can0", settings)
    with pytest.raises(ConnectError, match="for listening only"):
        open_transmit_socket("can0", settings)
    with pytest.raises(ConnectError, match="do not support the interface"):
        attach_bus("can0", settings)


def test_correction_on_a_receive_only_bus_is_refused() -> None:
    document = bench_document("X") | {"bus": {"can0": {"interface": "pcan", "channel": "PCAN_USBBUS1"}}}
    with pytest.raises(ConfigError, match=r"axis\.X\.correction: bus can0 is receive-only \(pcan\)"):
        parse_config(document)
    del document["axis"]["X"]["correction"]
    assert not parse_config(document).bus["can0"].may_send
