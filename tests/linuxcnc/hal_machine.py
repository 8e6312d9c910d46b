"""A machine with HAL pins and no CANopen drive: its LinuxCNC files, fdhil's configuration and HAL file for it."""

from __future__ import annotations

import math
import os
import socket
import struct
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import numpy as np

from fdhil import config as machine_config
from fdhil.bridges import hal_bus
from fdhil.cli.demo.toml_writer import format_toml
from fdhil.commissioning.init.hal_file import find_insertions, format_correction_hal
from fdhil.commissioning.init.linuxcnc_text import HalNetlist, Ini, parse_hal
from fdhil.config.axis_section import HAL_INCREMENTS
from fdhil.records import Float
from tests.linuxcnc.hal_plant import (
    CURRENT_KI,
    CURRENT_KP,
    MOTOR,
    PITCH_MM,
    POSITION_GAIN,
    SPEED_KP,
    write_machine_hal,
)
from tests.linuxcnc.linuxcnc_process import LinuxCnc

RTAPI = "/usr/bin/rtapi_app"
LEAD_CYCLES = 150  # the test computer is busy


def write_plant_hal(text: str) -> HalNetlist:
    hal = HalNetlist()
    parse_hal(text, Ini({}), lambda _name: "", hal)
    return hal


def build_hal_pins(axis: str, joint: int, hal: HalNetlist) -> dict[str, Any]:
    def source(name: str) -> str:
        return next(pin for pin in hal.nets[f"{axis.lower()}-{name}"] if pin.endswith(".out"))

    return {
        "position_command": f"joint.{joint}.motor-pos-cmd",
        "position_feedback": source("position"),
        "speed": source("speed-shown"),
        "speed_mm_s_per_unit": PITCH_MM / (2 * math.pi),  # the plant's unit is rad/s
        "current": source("current-shown"),
        "voltage": source("voltage-shown"),
        "enabled": f"joint.{joint}.amp-enable-out",
    }


def build_document(folder: Path, bus_port: int, nc_port: int, axes: str = "XY", **correction: float) -> dict[str, Any]:
    regulators = {
        "structure": "linuxcnc_pid",
        "pid_output": "current",
        "position_gain_per_s": POSITION_GAIN,
        "position_derivative": 1.0,
        "speed_feedforward": 0.0,
        "error_previous_target": False,
        "speed_kp": SPEED_KP,
        "speed_ki": 0.0,
        "speed_period_s": 0.001,
        "current_limit_a": 150.0,
        "current_kp": CURRENT_KP,
        "current_ki": CURRENT_KI,
        "voltage_limit_v": 300.0,
    }
    hal = write_plant_hal(write_machine_hal(axes, dict.fromkeys(axes, MOTOR)))
    limits = {"max_offset_um": 250.0, "max_speed_mm_s": 20.0, "max_acceleration_mm_s2": 1000.0}
    axis = {
        "screw_pitch_mm": PITCH_MM,
        "rapid_speed_mm_s": 500.0,
        "max_acceleration_mm_s2": 2000.0,
        "nominal": {**MOTOR},
        "regulators": regulators,
        "correction": {**limits, **correction},
    }
    return {
        "machine": {"name": "hal", "sync_period_s": 0.001},
        "nc": {"profile": "linuxcnc"},
        "g0": {"source": "linuxcnc"},
        "nc_source": {"linuxcnc": {"port": nc_port}},
        "bus": {
            "hal": {"interface": "socketcand", "channel": "hal", "port": bus_port, "offset_lead_cycles": LEAD_CYCLES}
        },
        "store": {"directory": str(folder / "store")},
        "axis": {
            letter: {**axis, "drive": {"source": "hal", "bus": "hal", "hal": build_hal_pins(letter, joint, hal)}}
            for joint, letter in enumerate(axes)
        },
    }


class HalMachine(LinuxCnc):
    """LinuxCNC with the plant, fdhil's offsets inserted, and both bridges."""

    def __init__(self, file: Path, text: dict[str, Any], motors: Mapping[str, Mapping[str, float]]) -> None:
        file.write_text(format_toml(text))
        axes = "".join(motors)
        base = write_machine_hal(axes, motors)
        config, hal = machine_config.load_config(file), write_plant_hal(base)
        splices = find_insertions(hal, {letter: joint for joint, letter in enumerate(axes)}, axes)
        text_of_hal = format_correction_hal(config, "{folder}/machine.toml", len(axes), splices, hal)
        adjacent = {"fdhil.hal": text_of_hal, "machine.toml": file.read_text()}
        super().__init__(axes=axes, base=base, hal="source fdhil.hal\n", beside=adjacent)

    def find_pids(self, program: str) -> list[int]:
        found = []
        for place in Path("/proc").glob("[0-9]*/cmdline"):
            with suppress(OSError):
                words = place.read_bytes().decode().split("\0")
                if program in words and (program == RTAPI or any(str(self.folder) in word for word in words)):
                    found.append(int(place.parent.name))
        return found

    def prioritise(self, *others: int) -> None:
        """Give LinuxCNC, the bridge and others real-time priority, as on a machine, if permitted."""
        programs = (RTAPI, "milltask", hal_bus.__file__)
        for pid in (*others, *(pid for program in programs for pid in self.find_pids(program))):
            for task in Path(f"/proc/{pid}/task").glob("*"):
                with suppress(OSError):
                    os.sched_setscheduler(int(task.name), os.SCHED_FIFO, os.sched_param(10))


class HalTrace:
    """A client of the bridge that records demand and position of each axis; a context manager."""

    def __init__(self, port: int, nodes: int) -> None:
        self._nodes = nodes
        self._wire = socket.create_connection(("127.0.0.1", port))
        self._came: list[bytes] = []
        self._reading = threading.Thread(target=self._read_thread, name="trace")

    def __enter__(self) -> Self:
        for text in (b"< open hal >", b"< rawmode >"):
            self._wire.sendall(text)
        self._reading.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._wire.shutdown(socket.SHUT_RDWR)
        self._reading.join()
        self._wire.close()

    def _read_thread(self) -> None:
        with suppress(ConnectionError):  # the bridge drops unread data
            while came := self._wire.recv(1 << 20):
                self._came.append(came)

    def read_rows_mm(self) -> tuple[Float, Float, Float]:
        """Return demand, position and applied offset (n, axes) in mm of each complete servo cycle."""
        per_mm = HAL_INCREMENTS / PITCH_MM
        now: dict[int, bytes] = {}
        rows = []
        for piece in b"".join(self._came).split(b">"):
            words = piece.split()
            if len(words) < 5 or words[1] != b"frame":
                continue
            cob_id = int(words[2], 16)
            if cob_id == hal_bus.RPDO1 + 1 and len(now) == 3 * self._nodes:
                rows.append(self._convert_row(now))
                now = {}
            if cob_id & 0x780 in (hal_bus.RPDO1, hal_bus.TPDO1, hal_bus.TPDO3):
                now[cob_id] = bytes.fromhex(words[4].decode())
        table = np.array(rows, float) / per_mm
        return table[:, 0], table[:, 1], table[:, 2]

    def _convert_row(self, now: Mapping[int, bytes]) -> list[list[int]]:
        kinds = ((hal_bus.RPDO1, "<Hi", 1), (hal_bus.TPDO1, "<ii", 0), (hal_bus.TPDO3, "<ii", 1))
        nodes = range(1, self._nodes + 1)
        return [[struct.unpack(form, now[base + node])[at] for node in nodes] for base, form, at in kinds]
