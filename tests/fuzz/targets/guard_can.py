"""Frames into the guard, as a hub's text and as binary, through listener and core while an offset is sent.

For any frames, the guard sends whole increments and never exceeds the ceiling.
"""

from __future__ import annotations

import copy
import socket
import struct
from dataclasses import replace
from typing import cast

from fdhil.cia402 import COB_SYNC
from fdhil.guard.can_socket import ERROR, BusDown, SocketcandText, decode_controller_states
from fdhil.guard.frame_monitor import FrameMonitor
from fdhil.guard.guard_protocol import ON_PATH
from fdhil.guard.guard_state import StepOutput
from tests.fuzz.input_assessment import Target
from tests.guard.frame_checks import CEILING
from tests.guard.simulated_bus import Bench, bench

MOST_CYCLES = 5
_RECORD = struct.Struct("<BBB8s")  # identifier, length, number of SYNCs before it, data


class _Hub:
    """Stands in for a connected socket of a hub: delivers its data in two pieces."""

    def __init__(self, data: bytes) -> None:
        self._pieces = [data[: len(data) // 2], data[len(data) // 2 :]]

    def setsockopt(self, *_option: object) -> None:
        pass

    def setblocking(self, _flag: bool) -> None:
        pass

    def recv(self, _most: int) -> bytes:
        return self._pieces.pop(0) if self._pieces else b""


def _build_running_guard() -> Bench:
    made = bench(axes=("X",))
    made.settle()
    assert made.arm() == ()
    made.play()
    made.run(200)
    assert made.mode in ON_PATH
    assert any(made.offsets)
    return made


_SENDING = _build_running_guard()
_IDS = (*_SENDING.listener.list_received_ids(), COB_SYNC, 0x7E5, 0x000)


def _copy_guard() -> Bench:
    """Return a copy of the bench in the middle of a cut; constant parts are shared."""
    made = copy.copy(_SENDING)
    made.listener, received = FrameMonitor(made.settings), made.listener
    for mine, theirs in zip(made.listener._pdos.values(), received._pdos.values(), strict=True):
        vars(mine).update(vars(theirs))
    made.listener._nodes = [copy.copy(node) for node in received._nodes]
    made.listener._counter, made.listener._last_sync_s = received._counter, received._last_sync_s
    made.drives = [replace(drive, queue=list(drive.queue)) for drive in made.drives]
    made.frames, made.held, made.heartbeats, made.alarms, made.outputs = [], [], [], [], made.outputs[-1:]
    return made


def taste(data: bytes) -> None:
    """Deliver the frames with SYNCs between them; an even first byte selects a hub's text."""
    machine, frames = _copy_guard(), _build_records(data[1:])
    if data and data[0] % 2 == 0:
        frames = [(0, cob_id, payload) for cob_id, payload in _build_hub_text(data[1:], machine)]
    cycles = 0
    for before, cob_id, payload in frames[:200]:
        for _ in range(min(before % 4, MOST_CYCLES - cycles)):
            cycles += 1
            _assess_state(machine.run_sync())
        if cob_id == ERROR:
            machine.listener.set_controller_state(payload.decode())
        elif cob_id == COB_SYNC:
            machine.listener.receive_at_sync(payload, machine.tick * 1e-3, machine.tick * 1e-3)
        else:
            machine.inject_frame(cob_id, payload)
    for _ in range(2):
        _assess_state(machine.run_sync())


def _assess_state(output: StepOutput) -> None:
    for offset in output.offsets or ():
        assert type(offset) is int
        assert abs(offset) <= CEILING


def _build_records(data: bytes) -> list[tuple[int, int, bytes]]:
    found = []
    for which, length, before, payload in _RECORD.iter_unpack(data[: len(data) // _RECORD.size * _RECORD.size]):
        if which == 255:
            found += [(before, ERROR, state.encode()) for state in decode_controller_states(length, payload)]
        else:
            found.append((before, _IDS[which % len(_IDS)], payload[: length % 9]))
    return found


def _build_hub_text(data: bytes, machine: Bench) -> list[tuple[int, bytes]]:
    line = SocketcandText(cast(socket.socket, _Hub(data)), (), machine.listener.list_received_ids())
    frames: list[tuple[int, bytes]] = []
    try:
        while True:
            frames += [(cob_id, payload) for cob_id, payload, _ in line.receive()]
    except BusDown:
        return frames


def target() -> Target:
    known = {cob_id: k for k, cob_id in enumerate(_IDS)}
    rows = [
        (0x381, struct.pack("<ii", 1000, 500)),
        (0x301, struct.pack("<i", 800)),
        (0x701, b"\x05"),
        (0x81, b"\x10\x81"),
    ]
    rows += [
        (0x601, bytes.fromhex("23b0600010000000")),
        (0x000, b"\x80\x01"),
        (0x181, bytes(8)),
        (0x201, b"\x0f\0" + bytes(4)),
    ]
    binary = b"\1" + b"".join(_RECORD.pack(known[i], len(d), 1, d) for i, d in rows)
    text = b"".join(b"< frame %03X 23.424242 %s >" % (i, d.hex(" ").encode()) for i, d in rows)
    seeds = [
        binary,
        b"\1" + _RECORD.pack(255, 4, 1, b"\0\x30" + bytes(6)),
        b"\0" + text,
        b"\0< error 40 1.0 >< frame 181 nan 11 >",
    ]
    return Target(
        "guard_can", seeds, taste, [b"< frame ", b" >", b"< error ", b"nan", b"inf", b"1e999", b"301", b"381"], 1500
    )
