"""A drive on a test rig: raw frames in and out, no thread, no clock."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Any

import numpy as np

from fdhil import config
from fdhil.sim.drive.servo_drive import SimulatedDrive
from fdhil.sim.frame_types import Frame
from tests.bench import bench_document

NO_NOISE = {"voltage_v": 0.0, "current_a": 0.0, "speed_rad_s": 0.0}


class Abort(Exception):
    def __init__(self, code: int) -> None:
        self.code = code
        super().__init__(f"{code:08X}")


def build_machine_config(axes: str = "X", noise: bool = False, **sim_axis: Any) -> config.MachineConfig:
    """Return the bench with simulator settings; noiseless sensors unless ``noise``."""
    document = bench_document(axes)
    document["sim"] = {"axis": {axes[0]: sim_axis}} | ({} if noise else {"noise": NO_NOISE})
    return config.parse_config(document)


class DriveRig:
    """One drive and the frames it sent; ``drive`` is powered on."""

    def __init__(self, machine_config: config.MachineConfig | None = None, axis: str = "X", seed: int = 1) -> None:
        self.drive = SimulatedDrive(axis, machine_config or build_machine_config(), np.random.default_rng(seed))
        self.node = self.drive.node_id
        self.boot = self.drive.power_on()

    @classmethod
    def wrap_drive(cls, drive: SimulatedDrive) -> DriveRig:
        """Wrap a drive that is already powered on."""
        rig = cls.__new__(cls)
        rig.drive, rig.node, rig.boot = drive, drive.node_id, []
        return rig

    def send_frame(self, can_id: int, data: bytes) -> list[Frame]:
        return self.drive.receive_frame(can_id, data)

    def send_nmt(self, command: int) -> list[Frame]:
        return self.send_frame(0x000, bytes([command, self.node]))

    def write_object(self, index: int, sub: int, value: int, size: int) -> None:
        data = value.to_bytes(size, "little", signed=value < 0).ljust(4, b"\0")
        self.request_sdo(bytes([0x23 | (4 - size) << 2]) + struct.pack("<HB", index, sub) + data)

    def read_object(self, index: int, sub: int = 0, *, signed: bool = False) -> int:
        answer = self.request_sdo(bytes([0x40]) + struct.pack("<HB", index, sub) + bytes(4))
        return int.from_bytes(answer[4 : 8 - (answer[0] >> 2 & 3)], "little", signed=signed)

    def request_sdo(self, request: bytes) -> bytes:
        (answer,) = [
            data for can_id, data in self.send_frame(0x600 + self.node, request) if can_id == 0x580 + self.node
        ]
        if answer[0] == 0x80:
            raise Abort(int.from_bytes(answer[4:8], "little"))
        return answer

    def send_sync(self, data: bytes = b"") -> list[Frame]:
        return self.send_frame(0x080, data)

    def run_cycle(self, target: int, offset: int | None = None, word: int = 0x0F) -> list[Frame]:
        """Run one SYNC with its RPDOs in time."""
        self.send_frame(0x200 + self.node, struct.pack("<Hi", word, target))
        if offset is not None:
            self.send_frame(0x300 + self.node, struct.pack("<i", offset))
        return self.send_sync()

    def enable_drive(self, target: int = 0, mode: int = 8) -> None:
        """Start by NMT, set the mode, 06 07 0F, and wait until the delay is over."""
        self.send_nmt(0x01)
        self.write_object(0x6060, 0, mode, 1)
        for word in (0x06, 0x07, 0x0F, 0x0F, 0x0F, 0x0F):
            self.run_cycle(target, word=word)

    def follow_targets(
        self, targets: Iterable[int], offsets: Iterable[int] | None = None
    ) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Send one target per SYNC; return the true table position (n,) in mm at those SYNCs."""
        positions = []
        for target, offset in zip(targets, offsets if offsets is not None else _ignore_frames(), strict=False):
            self.run_cycle(target, offset)
            positions.append(self.drive.table_mm)
        return np.array(positions)

    @property
    def status(self) -> int:
        return self.drive.dictionary.get_number(0x6041)


def _ignore_frames() -> Iterable[None]:
    while True:
        yield None


def list_emergency_codes(frames: list[Frame], node: int = 1) -> list[int]:
    """Return the error codes of the EMCY frames, all of 8 bytes."""
    assert all(len(data) == 8 for can_id, data in frames if can_id == 0x080 + node)
    return [int.from_bytes(data[:2], "little") for can_id, data in frames if can_id == 0x080 + node]
