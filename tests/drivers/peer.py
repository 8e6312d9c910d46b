"""A simulated drive on a bus inside this process: a thread that exchanges frames."""

from __future__ import annotations

import threading
import time
from types import TracebackType
from typing import Self

import can
import numpy as np

from fdhil.config import MachineConfig
from fdhil.sim.drive.servo_drive import SimulatedDrive


class DrivePeer:
    """Runs a twin drive on the ``virtual`` bus of the config; ``sent`` counts its frames, ``heard`` those of others."""

    def __init__(self, config: MachineConfig, axis: str = "X") -> None:
        self.drive = SimulatedDrive(axis, config, np.random.default_rng(1))
        self._bus = can.Bus(interface="virtual", channel=next(iter(config.bus.values())).channel)
        self._stopping = threading.Event()
        self.heard: list[int] = []
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        """The drive's time never jumps: when the computer was late, it continues more slowly."""
        drive_s, last_s = 0.0, time.monotonic()
        while not self._stopping.is_set():
            message = self._bus.recv(0.001)
            now_s = time.monotonic()
            drive_s, last_s = drive_s + min(now_s - last_s, 0.008), now_s
            self._send(self.drive.run_timers(drive_s))
            if message is not None:
                self.heard.append(message.arbitration_id)
                self._send(self.handle_frame(message.arbitration_id, bytes(message.data)))

    def handle_frame(self, can_id: int, data: bytes) -> list[tuple[int, bytes]]:
        """Give one frame to the drive and return its answers."""
        return self.drive.receive_frame(can_id, data)

    def _send(self, frames: list[tuple[int, bytes]]) -> None:
        for can_id, data in frames:
            self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def __enter__(self) -> Self:
        self._send(self.drive.power_on())  # before the thread runs: what a test spoils then stays spoilt
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stopping.set()
        self._thread.join(timeout=5)
        self._bus.shutdown()
