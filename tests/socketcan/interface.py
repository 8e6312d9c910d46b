"""SocketCAN interfaces for tests: frames on vcan0, up and down, a serial adapter on a pty."""

from __future__ import annotations

import fcntl
import os
import select
import socket
import struct
import tty
from typing import Self

import pytest

CAN_FRAME = struct.Struct("=IB3x8s")
_IFREQ = struct.Struct("@16sh22x")
_SIOCGIFFLAGS, _SIOCSIFFLAGS, _SIOCGIFNAME = 0x8913, 0x8914, 0x8910
_TIOCSETD, _N_SLCAN = 0x5423, 17
_IFF_UP = 1


def raw_socket(channel: str = "vcan0") -> socket.socket:
    raw = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    raw.bind((channel,))
    return raw


def send(raw: socket.socket, number: int, can_id: int = 0x181) -> None:
    raw.send(CAN_FRAME.pack(can_id, 8, struct.pack("<Q", number)))


def set_up(channel: str, up: bool) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        name, flags = _IFREQ.unpack(fcntl.ioctl(any_socket, _SIOCGIFFLAGS, _IFREQ.pack(channel.encode(), 0)))
        flags = flags | _IFF_UP if up else flags & ~_IFF_UP
        fcntl.ioctl(any_socket, _SIOCSIFFLAGS, _IFREQ.pack(name, flags))


class SerialAdapter:
    def __init__(self) -> None:
        self._end, self._line = os.openpty()
        tty.setraw(self._line)
        try:
            fcntl.ioctl(self._line, _TIOCSETD, struct.pack("i", _N_SLCAN))
        except OSError as error:
            pytest.skip(f"this kernel has no slcan line discipline ({error.strerror})")
        name = fcntl.ioctl(self._line, _SIOCGIFNAME, bytes(16))
        self.channel = name.split(b"\0")[0].decode()
        set_up(self.channel, True)

    def say(self, line: str) -> None:
        os.write(self._end, f"{line}\r".encode())

    def drain(self, wait_s: float = 0.0) -> int:
        frames = 0
        while select.select([self._end], [], [], 0.0 if frames else wait_s)[0]:
            frames += os.read(self._end, 1 << 16).count(b"\r")
        return frames

    def unplug(self) -> None:
        for descriptor in (self._end, self._line):
            if descriptor >= 0:
                os.close(descriptor)
        self._end = self._line = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.unplug()
