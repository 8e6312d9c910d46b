"""Frames of a bus into the daemon: a hub's text into the ring, any frames through grid, decoders and watches."""

from __future__ import annotations

import struct
import time
from collections import Counter

import numpy as np

from fdhil.daemon.bus_health import BusHealth
from fdhil.drivers.can.frame_ring import EXTENDED_FLAG, FrameRing, Frames, pack_frames
from fdhil.drivers.can.socketcand_port import HubClock, SocketcandPort
from fdhil.drivers.cia402.bus_decoder import BusDecoder
from fdhil.drivers.moves import load_event_source
from fdhil.records import AxisSamples, TickTimes
from tests.drivers.frame_builder import FrameBuilder, Row, build_machine_config
from tests.fuzz.input_assessment import Target

CONFIG = build_machine_config(axes="X")
FLAGS = (0, 0, 0, 0, 0, 0x20000000, 0x40000000, EXTENDED_FLAG)
_ROW = struct.Struct("<hHBB8s")  # time since the previous frame, identifier, length, flags and unit, data
SILENCES = 8
UNITS_NS = (10_000, 10_000, 1_000_000, 30_000_000)


def taste(data: bytes) -> None:
    """Decode the frames; an even first byte selects a hub's text."""
    decoder, hearing = BusDecoder("can0", CONFIG), BusHealth(CONFIG, 0.0)
    sources = [load_event_source(CONFIG.g0.source)(axis, CONFIG) for axis in decoder.axes]
    hearing.note_source_opened(0.0)
    ring = FrameRing(1 << 10)
    if data and data[0] % 2 == 0:
        _build_hub_text(data[1:], ring)
    else:
        for row in _decode_rows(data[1:])[: 1 << 10]:
            ring.append_frame(*row)
    frames = ring.drain_frames()
    now_ns = 2_000_000_000
    for block in _split_at_silence(frames, len(data) % 2):
        now_ns = max(now_ns + 400_000_000, int(block["t_ns"].max(initial=0)))
        for record in decoder.decode_frames(block, now_ns):
            if isinstance(record, AxisSamples | TickTimes):
                for source in sources:
                    source.detect_moves(record)
            hearing.take_record(record, now_ns * 1e-9)  # type: ignore[arg-type] # inputs and tables pass it by
        hearing.take_counters(Counter({"frames": int(frames.size), "can0.frames": int(frames.size)}), now_ns * 1e-9)
        hearing.build_status(now_ns * 1e-9)
        hearing.find_lasting_troubles({}, now_ns * 1e-9)
    decoder.read_counters()


def _split_at_silence(frames: Frames, halved: int) -> list[Frames]:
    """Split at long silences of the bus, which the daemon detects by a block without a frame, or in halves."""
    silent = np.flatnonzero(np.diff(frames["t_ns"]) > 1_000_000_000)[:SILENCES] + 1
    return np.split(frames, np.repeat(silent, 2) if silent.size else [frames.size // 2] * halved)


def _build_hub_text(data: bytes, ring: FrameRing) -> None:
    port = object.__new__(SocketcandPort)  # it would connect
    port._rest, port._clock, port.malformed = b"", HubClock(), 0
    for piece in (data[: len(data) // 2], data[len(data) // 2 :]):
        port._parse_chunk(piece, ring, time.monotonic_ns())


def _decode_rows(data: bytes) -> list[Row]:
    at_ns, found = 1_000_000_000, []
    for later, can_id, length, flags, payload in _ROW.iter_unpack(data[: len(data) // _ROW.size * _ROW.size]):
        at_ns += UNITS_NS[flags >> 3 & 3] * later
        found.append((at_ns, can_id & 0x7FF | FLAGS[flags % 8], payload[: length % 9]))
    return found


def target() -> Target:
    seeds = []
    for counter in (True, False):
        rows, at_ns, packed = FrameBuilder(6, counter=counter).build_rows(), 1_000_000_000, b""
        for t_ns, can_id, payload in rows:
            packed += _ROW.pack((t_ns - at_ns) // 10_000, can_id, len(payload), 0, payload)
            at_ns = t_ns
        seeds.append(b"\1" + packed)
        text = "".join(f"< frame {i:03X} {t * 1e-9:.6f} {d.hex(' ')} >" for t, i, d in rows[:20])
        seeds.append(b"\0" + text.encode())
    outage = [(2, 5), (2, 5), (2, 5), (2, 5), (200, 5), (2, 0), (2, 5), (200, 5)]  # 60 ms and 6 s, state
    beats = b"".join(_ROW.pack(later, 0x701, 1, 3 << 3, bytes([state])) for later, state in outage)
    emergency = _ROW.pack(1, 0x81, 8, 0, bytes(8)) + _ROW.pack(1, 0x701, 1, 0, b"\0") + _ROW.pack(1, 4, 8, 5, b"\0\x30")
    assert pack_frames([(0, 0x80, b"")]).size == 1
    return Target(
        "hearing",
        [*seeds, b"\1" + emergency, b"\1" + beats],
        taste,
        [b"< frame ", b" >", b"nan", b"inf", b"< error "],
        3000,
    )
