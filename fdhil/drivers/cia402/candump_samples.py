"""Decodes a candump log, such as a black box, into the drives' samples, as the daemon would have."""

import contextlib
import io
from collections.abc import Sequence

import numpy as np

from fdhil.config import MachineConfig
from fdhil.drivers.can.candump_log import parse_line
from fdhil.drivers.can.frame_ring import Frames, pack_frames
from fdhil.drivers.cia402.bus_decoder import BusDecoder
from fdhil.errors import RecordingError
from fdhil.records import AxisSamples

LARGEST_LOG = 64 * 1024 * 1024
BLOCK_FRAMES = 4096


def decode_candump(log: bytes, config: MachineConfig) -> dict[str, AxisSamples]:
    """Return the samples of each axis in a log; RecordingError when it is no candump log, or has no frame.

    A SYNC without a sample is left out: nothing is interpolated.
    """
    blocks: dict[str, list[AxisSamples]] = {axis: [] for axis in config.axis}
    for bus, frames in _parse_frames(log).items():
        decoder = BusDecoder(bus, config)
        for start in range(0, frames.size, BLOCK_FRAMES):
            block = frames[start : start + BLOCK_FRAMES]
            for record in decoder.decode_frames(block, int(block["t_ns"][-1])):
                if isinstance(record, AxisSamples):
                    blocks[record.axis].append(record)
    return {axis: _concatenate_samples(axis, found) for axis, found in blocks.items() if found}


def _parse_frames(log: bytes) -> dict[str, Frames]:
    if len(log) > LARGEST_LOG:
        raise RecordingError(f"the log has more than {LARGEST_LOG >> 20} MiB, it is not read; shorten it")
    rows: dict[str, list[tuple[int, int, bytes]]] = {}
    for line in io.StringIO(log.decode("ascii", "replace")):
        with contextlib.suppress(ValueError, IndexError):  # skips truncated lines
            frame = parse_line(line)
            if frame.fd is None:
                rows.setdefault(frame.bus, []).append((frame.t_ns, frame.can_id, frame.data))
    if not rows:
        raise RecordingError("this is not a candump log, or the bus was silent")
    return {bus: pack_frames(found) for bus, found in rows.items()}


def _concatenate_samples(axis: str, blocks: Sequence[AxisSamples]) -> AxisSamples:
    columns = ("tick", "demand_mm", "position_mm", "speed_rad_s", "current_a", "offset_mm", "statusword")
    joined = {name: np.concatenate([getattr(block, name) for block in blocks]) for name in columns}
    voltages = [block.voltage_v for block in blocks if block.voltage_v is not None]
    voltage = np.concatenate(voltages) if len(voltages) == len(blocks) else None
    return AxisSamples(axis, voltage_v=voltage, lost=sum(block.lost for block in blocks), **joined)
