"""Late, stale and wrong answers to the drivers of Modbus and SDO, in virtual time: is one ever taken for the right one?

What is asked for changes with every question, so an answer to another question is known by its value. The devices are
the simulated machine's units and a node of two objects; what is driven is fdhil's own drivers, as they are.
"""

from __future__ import annotations

import queue
import random
import struct
from collections import Counter
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import canopen.sdo.client
import serial

from fdhil.config.sensor_sections import ModbusDevice, SerialDevice
from fdhil.drivers.can import sdo_channel
from fdhil.drivers.modbus import rtu_line
from fdhil.drivers.modbus.modbus_line import ModbusRequest
from fdhil.drivers.serial import byte_stream, serial_port
from fdhil.errors import DeviceError
from fdhil.sim.frame_faults import FrameFault, FrameFaults
from fdhil.sim.wire.modbus_answers import answer_request, apply_answer_faults
from fdhil.sim.wire.sensor_faults import SensorFaults
from tests.drivers.serial_peer import build_frame
from tests.machine.virtual_time import VirtualLoop, run_virtual

TIMEOUT_S = 0.2
PROMPT_S = 0.005
COUNTS = (1, 2, 4)
LATE = 0.9  # of the answers take a while, half of them longer than the time-out where they may be twice as late
SPOILT_PERCENT, SPOILT_ALONE_PERCENT = 3.0, 60.0
SDO_LATE_S = (0.55, 0.7, 0.9, 1.2, 1.45, 1.6, 2.2, 6.0)  # each later than the time-out


class Questioned:
    """A device all of whose registers contain the number of the current request."""

    trigger: int | None = None

    def __init__(self) -> None:
        self.question = 0

    def list_words(self) -> dict[int, int]:
        """Return eight registers."""
        return dict.fromkeys(range(8), self.question & 0xFFFF)

    def latch_samples(self) -> None:
        """There is nothing to latch."""


class LatePort(serial_port.SerialPort):
    """A serial port without a line: requests are answered at a random time, and corrupted as ordered."""

    def __init__(
        self, place: SerialDevice, loop: VirtualLoop, rng: random.Random, most_late: float, noise: float
    ) -> None:
        super().__init__(place)
        self.device_now = Questioned()
        self.faults = SensorFaults(draw=rng)
        self.late = self.spoilt = 0
        self._virtual, self._rng, self._most_late, self._noise = loop, rng, most_late, noise

    def open(self, name: str) -> None:
        """Stand open."""
        self._serial = serial.Serial()

    def close(self) -> None:
        """Stay as it is."""

    def send(self, name: str, data: bytes) -> int:
        """Answer in time, or late by up to ``most_late`` time-outs."""
        body = answer_request(self.device_now, self.faults, data[1:-2])
        delay_s = PROMPT_S
        if self._rng.random() < LATE:
            delay_s = TIMEOUT_S * self._rng.uniform(0.0, self._most_late)
            self.late += delay_s > TIMEOUT_S
        pieces = apply_answer_faults(self.faults, build_frame, data[0], body)
        self.spoilt += pieces != [build_frame(data[0], body)]
        for place, piece in enumerate(pieces):
            self._virtual.call_later(delay_s + 0.002 * place, self._arrive, piece)
        if self._rng.random() < self._noise:
            self._virtual.call_later(
                2 * TIMEOUT_S * self._rng.random(), self._arrive, self._rng.randbytes(self._rng.randint(1, 9))
            )
        return self._virtual.monotonic_ns()

    def _arrive(self, data: bytes) -> None:
        self.last_ns = self._virtual.monotonic_ns()
        self._chunks.append(byte_stream.Chunk(data, self.last_ns))
        self._kept += len(data)
        self._came.set()


def measure_modbus(
    questions: int, seed: int, most_late: float, kinds: tuple[str, ...] = (), noise: float = 0.0
) -> Counter[str]:
    """Send requests over a line whose answers are late by up to ``most_late`` time-outs, and corrupted by ``kinds``.

    ``noise``: how often something is on the line that is no answer.

    Counts what was asked, answered, ``wrong``, late (than the time-out), spoilt, and the faults that the driver told.
    """
    loop, rng = VirtualLoop(), random.Random(seed)
    place = ModbusDevice(device="/dev/virtual", timeout_s=TIMEOUT_S, baud_rate=115200)
    wire = LatePort(place, loop, rng, most_late, noise)
    wire.faults.answers.update(dict.fromkeys(kinds, SPOILT_PERCENT if len(kinds) > 1 else SPOILT_ALONE_PERCENT))
    clock = SimpleNamespace(monotonic_ns=loop.monotonic_ns)
    seen: Counter[str] = Counter()

    async def ask() -> None:
        line = rtu_line.RtuLine(place)
        await line.connect("sensor", TIMEOUT_S)
        for question in range(questions):
            wire.device_now.question = question
            count = rng.choice(COUNTS)
            seen["asked"] += 1
            try:
                got = await line.send_request(ModbusRequest("sensor", 1, 4, 0, count, TIMEOUT_S))
            except DeviceError:
                seen["refused"] += 1
                continue
            seen["answered"] += 1
            seen["wrong"] += got.registers != (question & 0xFFFF,) * count
        seen.update(line.fault_counts)

    with (
        patch.object(rtu_line, "SerialPort", lambda _place: wire),
        patch.object(rtu_line, "time", clock),
        patch.object(byte_stream, "time", clock),
    ):
        run_virtual(ask(), loop)
    seen["late"], seen["spoilt"] = wire.late, wire.spoilt
    return seen


class Node:
    """A CANopen node with two objects whose value is the number of the question; the way to it has faults."""

    def __init__(self, faults: FrameFaults) -> None:
        self.question, self.now_s = 0, 0.0
        self._faults = faults
        self.link: sdo_channel.SdoChannel | None = None

    def send(self, _can_id: int, data: bytes) -> None:
        """Answer an expedited upload; an abort has no answer."""
        if data[0] == 0x40:
            reported = b"\x43" + data[1:4] + struct.pack("<I", self.question)
            self._deliver(self._faults.process_frame((0x581, reported), "received", self.now_s))

    def _deliver(self, passed: list[Any]) -> None:
        assert self.link is not None
        for (_, data), _ in passed:
            self.link.deliver_response(data)

    def sleep(self, seconds: float) -> None:
        """Let time pass; what is late arrives meanwhile."""
        until_s = self.now_s + seconds
        while (at_s := self._faults.find_next_due_s()) <= until_s:
            self.now_s = max(self.now_s, at_s)
            self._deliver(self._faults.release_due("received", self.now_s))
        self.now_s = until_s


def _waiting_in(node: Node) -> type[queue.Queue[bytes]]:
    class Waiting(queue.Queue[bytes]):
        """Waits in the node's time."""

        def get(self, block: bool = True, timeout: float | None = None) -> bytes:
            step_s = 0.01
            waited_s = 0.0
            while self.empty() and waited_s < (timeout or 0.0):
                node.sleep(step_s)
                waited_s += step_s
            return super().get(block=False)

    return Waiting


def measure_sdo_reads(questions: int, seed: int, most_late_s: float) -> Counter[str]:
    """Read two objects repeatedly, with answers that are late, doubled or lost; count as above."""
    late = [FrameFault("late", seconds, percent=6) for seconds in SDO_LATE_S if seconds <= most_late_s]
    faults = FrameFaults([*late, FrameFault("duplicate", percent=3), FrameFault("drop", percent=3)], seed)
    node, rng, seen = Node(faults), random.Random(seed), Counter[str]()
    queues = SimpleNamespace(Queue=_waiting_in(node), Empty=queue.Empty)
    clock = SimpleNamespace(sleep=node.sleep, monotonic=lambda: node.now_s)
    with (
        patch.object(sdo_channel, "queue", queues),
        patch.object(canopen.sdo.client, "queue", queues),
        patch.object(sdo_channel, "time", clock),
    ):
        node.link = link = sdo_channel.SdoChannel("drive", 1, node.send)
        for question in range(questions):
            node.question = question
            seen["asked"] += 1
            try:
                value = link.read_int(rng.choice((0x6041, 0x60B0)))
            except DeviceError:
                seen["refused"] += 1
                continue
            seen["answered"] += 1
            seen["wrong"] += value != question
    seen["late"] = faults.total("late")
    return seen
