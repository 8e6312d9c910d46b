"""Examines the PC: CAN interfaces and hubs, clock, processors."""

import json
import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from fdhil.cli.doctor.trouble import Trouble
from fdhil.config import CanBus, MachineConfig

INTERFACES = Path("/sys/class/net")
LARGEST_RECEIVE_BUFFER = Path("/proc/sys/net/core/rmem_max")
GOVERNOR = Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
ENOUGH_BUFFER_BYTES = 1 << 20  # the kernel's default holds some 300 frames: 35 ms of a fully loaded bus
HUB_S = 2.0
TOOL_S = 5.0
UP = 1  # IFF_UP
RELEASED_S = 1_767_225_600.0  # 1 January 2026, before this program was written
NO_CAN_ADDRESS = "the kernel does not support CAN (AF_CAN)"
BAD_STATES: Mapping[str, tuple[str, str]] = {
    "BUS-OFF": ("is bus-off", "nothing is sent or received there until it is restarted"),
    "ERROR-PASSIVE": ("is error-passive", "frames are lost, and it may go bus-off"),
}


def examine_buses(config: MachineConfig, offline: bool) -> dict[str, list[Trouble]]:
    """Return, per CAN bus in use, the problems of this PC that prevent reception.

    ``offline`` does not connect to a hub of CAN frames.
    """
    used = dict.fromkeys(axis.drive.bus for axis in config.axis.values())
    return {name: list(_examine_bus(f"bus {name}", config.bus[name], offline)) for name in used}


def _examine_bus(place: str, bus: CanBus, offline: bool) -> Iterator[Trouble]:
    if bus.interface == "socketcand":
        yield from _examine_hub(place, bus, offline)
    elif bus.interface == "socketcan":
        yield from _examine_interface(place, bus)


def _examine_hub(place: str, bus: CanBus, offline: bool) -> Iterator[Trouble]:
    means = "no drive can be received"
    if bus.port == 0:
        what = "the configuration has no port for the CAN hub"
        yield Trouble("NoPort", place, what, means, "write the port that the hub or `fdhil sim` prints")
        return
    if offline:
        return
    try:
        with socket.create_connection((bus.host, bus.port), HUB_S):
            pass
    except OSError as error:
        what = f"the CAN hub {bus.host}:{bus.port} cannot be reached ({error.strerror or error})"
        yield Trouble("HubAway", place, what, means, f"start the hub (socketcand or `fdhil sim`) or correct [{place}]")


def _examine_interface(place: str, bus: CanBus) -> Iterator[Trouble]:
    means, there = "no drive can be received", INTERFACES / bus.channel
    if not hasattr(socket, "AF_CAN") or not _can_open_socket():
        mend = "load the kernel modules can, can_raw and that of the adapter, or use a kernel that has them"
        yield Trouble("NoKernelCan", place, NO_CAN_ADDRESS, means, mend)
    elif not there.exists():
        what = f"there is no CAN interface {bus.channel}"
        mend = f"plug the adapter in, load its driver, then: {_format_bring_up_command(bus)}"
        yield Trouble("InterfaceMissing", place, what, means, mend)
    elif not int((there / "flags").read_text(), 16) & UP:
        what = f"the CAN interface {bus.channel} is down"
        yield Trouble("InterfaceDown", place, what, means, _format_bring_up_command(bus))
    else:
        yield from _examine_controller(place, bus, read_link_details(bus.channel))
        yield from _examine_receive_buffer(place)


def _can_open_socket() -> bool:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    return True


def _format_bring_up_command(bus: CanBus) -> str:
    return f"sudo ip link set {bus.channel} up type can bitrate {bus.bitrate} restart-ms 100"


def read_link_details(channel: str) -> Mapping[str, Any]:
    """Return state, bit timing and restart setting of a CAN controller from ``ip``; empty if unavailable."""
    tool = shutil.which("ip")
    if tool is None:
        return {}
    command = [tool, "-details", "-json", "link", "show", channel]
    with suppress(OSError, ValueError, KeyError, IndexError, TypeError, subprocess.SubprocessError):
        answer = subprocess.run(command, capture_output=True, timeout=TOOL_S, check=True)
        details = json.loads(answer.stdout)[0]["linkinfo"]["info_data"]
        return details if isinstance(details, dict) else {}
    return {}


def _examine_controller(place: str, bus: CanBus, details: Mapping[str, Any]) -> Iterator[Trouble]:
    # a virtual interface has no controller, and no details
    bitrate = details.get("bittiming", {}).get("bitrate")
    if bitrate and bitrate != bus.bitrate:
        what = f"{bus.channel} runs at {bitrate} bit/s, the configuration has {bus.bitrate}"
        mend = (
            f"correct [{place}] bitrate, or: sudo ip link set {bus.channel} down, then {_format_bring_up_command(bus)}"
        )
        yield Trouble("BitrateDiffers", place, what, "nodes with different bit rates corrupt each other's frames", mend)
    if (state := str(details.get("state"))) in BAD_STATES:
        what, means = BAD_STATES[state]
        bring_up = _format_bring_up_command(bus)
        mend = f"check plugs, wiring, the two terminating resistors and the bit rate, then: {bring_up}"
        yield Trouble("BusOff" if state == "BUS-OFF" else "BusPassive", place, f"{bus.channel} {what}", means, mend)
    if details.get("restart_ms") == 0:
        what = f"{bus.channel} does not restart automatically after a bus-off"
        means = "one disturbance stops all reception until it is restarted manually"
        yield Trouble("NoRestart", place, what, means, _format_bring_up_command(bus), grave=False)


def _examine_receive_buffer(place: str) -> Iterator[Trouble]:
    with suppress(OSError, ValueError):
        largest = int(LARGEST_RECEIVE_BUFFER.read_text())
        if largest < ENOUGH_BUFFER_BYTES:
            what = f"the kernel's receive buffers are at most {largest} bytes"
            means = "a busy computer loses frames, and the windows concerned are refused"
            mend = f"sudo sysctl -w net.core.rmem_max={8 * ENOUGH_BUFFER_BYTES}"
            yield Trouble("SmallBuffer", place, what, means, mend, grave=False)


def examine_clock(newest_record_s: float | None) -> Iterator[Trouble]:
    """Compare the PC's clock with the release date and with the newest record (s since 1970) of the history."""
    now_s, shown = time.time(), time.strftime("%Y-%m-%d %H:%M", time.gmtime())
    means = "new records would be sorted wrongly into the history"
    mend = "set the clock, or enable its synchronisation: sudo timedatectl set-ntp true"
    if now_s < RELEASED_S:
        yield Trouble(
            "ClockNotSet", "clock", f"this PC's clock shows {shown} UTC, before the release of fdhil", means, mend
        )
    elif newest_record_s is not None and newest_record_s > now_s + 60.0:
        ahead = (newest_record_s - now_s) / 3600.0
        what = f"this PC's clock shows {shown} UTC, {ahead:.1f} h before the newest record"
        yield Trouble("ClockBehind", "clock", what, means, mend)


def examine_processors() -> Iterator[Trouble]:
    """Detect overload and power saving of the processors."""
    cores, load = os.cpu_count() or 1, os.getloadavg()[1]
    if load > 1.5 * cores:
        what = f"{load:.1f} processes wait for {cores} processors (mean of five minutes)"
        means = "identification takes longer, and the guard may be late and ramp every correction to zero"
        yield Trouble("BusyHost", "processors", what, means, "end programs that the machine does not need", grave=False)
    with suppress(OSError):
        if GOVERNOR.read_text().strip() == "powersave":
            means = "frames are read late after a pause"
            mend = "sudo cpupower frequency-set -g performance"
            yield Trouble("PowerSaving", "processors", "they run at their lowest speed", means, mend, grave=False)
