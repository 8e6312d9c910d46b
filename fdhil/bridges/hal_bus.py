#!/usr/bin/python3
"""Presents LinuxCNC's HAL pins as a CANopen bus, and feeds offsets into HAL's streamer.

LinuxCNC's own Python runs it, loaded by a line at the end of the HAL files (``fdhil init --from-linuxcnc`` writes it):

    loadusr -Wn fdhil-hal /usr/bin/python3 /path/to/hal_bus.py machine.toml

HAL's ``sampler`` records the pins of ``[axis.X.drive.hal]`` in every servo cycle, all axes in one channel. A cycle
becomes a SYNC and the PDOs of profile ``hal`` for each axis, in the text protocol of a socketcand hub. So every
CANopen client works with HAL unchanged. Samples that the sampler dropped are missing in the SYNC count: they are holes,
never interpolated.

Where the HAL file has loaded ``streamer`` for fdhil, offsets (0x60B0) that a client sends go there. Each offset names
the SYNC that it answers, and takes effect ``offset_lead_cycles`` + 1 cycles after it. What reaches the axis is limited
in HAL (``limit3``, ``oneshot``): when nothing comes, the streamer runs empty and the offset goes to zero.
Standard library and LinuxCNC's ``hal`` module only.
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import socket
import struct
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

NAME = "fdhil-hal"
CHANNEL = "hal"
LOOK_S = 0.001
DEPTH = 8192  # of the sampler, in cycles
MOST_PINS = 20  # of one channel of the sampler
MOST_WAITING = 8 << 20  # unsent bytes per client
MOST_COMMAND = 4096
SYNC_RANGE = 240  # of the SYNC counter, 1 to 240
GUARD_SILENT_S = 0.05  # beyond the lead
ENABLED, DISABLED = 0x1237, 0x0250  # statuswords: operation enabled and following, switch on disabled
POSITION_MODE = 8
MODE_EVERY = 10
SYNC, RPDO1, RPDO2, TPDO1, TPDO2, TPDO3, TPDO4, HEARTBEAT = 0x080, 0x200, 0x300, 0x180, 0x280, 0x380, 0x480, 0x700
HAL_TYPES = {"float": "f", "bit": "b", "s32": "s", "u32": "u"}
SHARED = ("fdhil-row", "fdhil-on")  # signals of the generated HAL file: the streamer's row, whether offsets pass


class PinError(Exception):
    """A pin cannot be sampled; ``str`` names the pin, the reason and the next action."""


class Axis(NamedTuple):
    """One axis: its node-ID, its pins by their key in ``[axis.X.drive.hal]``, and its scales."""

    name: str
    node_id: int
    pins: Mapping[str, str]
    scales: Mapping[str, float]
    per_mm: float  # increments, with the axis' sign
    period_s: float
    commanded: bool  # whether the voltage is a command for the coming cycle
    corrected: bool  # whether offsets may be added: the HAL file has the axis' limit3


class Sample(NamedTuple):
    """One axis in one servo cycle, in the units of profile ``hal``."""

    target: int
    position: int
    speed: int
    current: int
    voltage: int
    offset: int
    enabled: bool


def read_axes(document: Mapping[str, Any]) -> list[Axis]:
    """Return the axes of a machine's configuration whose source is HAL, in its order."""
    period_s = float(document["machine"].get("sync_period_s", 0.001))
    axes = []
    for number, (name, table) in enumerate(document["axis"].items(), 1):
        drive = table.get("drive", {})
        if drive.get("source") != "hal":
            continue
        own = drive["hal"]
        sign, turn = drive.get("sign", 1), drive.get("increments_per_rev", 1_000_000)
        current_a = own.get("current_a_per_unit", 1.0)
        if "current" not in own:
            current_a = own.get("torque_nm_per_unit", 1.0) / table["nominal"]["K"]
        position_mm = own.get("position_mm_per_unit", 1.0)
        scales = {"position": position_mm, "speed": own.get("speed_mm_s_per_unit", 1.0), "current": current_a}
        scales["voltage"] = own.get("voltage_v_per_unit", 1.0)
        pins = {key: pin for key, pin in own.items() if isinstance(pin, str) and key != "voltage_is"}
        torque = pins.pop("torque", "")
        pins.setdefault("current", torque)
        pins.setdefault("enabled", "motion.motion-enabled")
        per_mm = sign * turn / table["screw_pitch_mm"]
        commanded, corrected = own.get("voltage_is") == "commanded", "correction" in table
        axes.append(Axis(name, drive.get("node_id", number), pins, scales, per_mm, period_s, commanded, corrected))
    return axes


class AxisReader:
    """Converts the values of an axis' pins to its sample, cycle by cycle. Pure."""

    def __init__(self, axis: Axis) -> None:
        self.axis = axis
        self._before_mm: float | None = None
        self._voltage = 0.0

    def read_sample(self, value: Mapping[str, float]) -> Sample:
        """Return the sample of one cycle; ``value`` has a value for each key of the axis' pins."""
        axis, scale = self.axis, self.axis.scales
        position_mm = value["position_feedback"] * scale["position"]
        before_mm, self._before_mm = self._before_mm, position_mm
        if "speed" in value:
            speed_mm_s = value["speed"] * scale["speed"]
        else:
            speed_mm_s = 0.0 if before_mm is None else (position_mm - before_mm) / axis.period_s
        volts = value.get("voltage", 0.0) * scale["voltage"]
        if axis.commanded:  # profile hal has the mean of the cycle before
            volts, self._voltage = self._voltage, volts
        sign = 1 if axis.per_mm > 0 else -1
        return Sample(
            _round_to_integer(value["position_command"] * scale["position"] * axis.per_mm, 31),
            _round_to_integer(position_mm * axis.per_mm, 31),
            _round_to_integer(speed_mm_s * axis.per_mm, 31),
            _round_to_integer(value["current"] * scale["current"] * sign * 1e5, 31),
            _round_to_integer(volts * sign * 50.0, 15),
            _round_to_integer(value.get("offset", 0.0) * scale["position"] * axis.per_mm, 31),
            bool(value["enabled"]),
        )


def _round_to_integer(value: float, bits: int) -> int:
    """Round to a signed integer with ``bits`` magnitude bits; NaN and overflow become the lowest value."""
    most = (1 << bits) - 1
    return round(value) if -most <= value <= most else -most - 1


def encode_cycle(cycle: int, axes: Sequence[Axis], samples: Sequence[Sample]) -> Iterator[tuple[int, bytes]]:
    """Yield the frames (COB-ID, data) of one servo cycle: set-points, SYNC, and what was sampled at it."""
    for axis, now in zip(axes, samples, strict=True):
        yield RPDO1 + axis.node_id, struct.pack("<Hi", 0x1F if now.enabled else 0, now.target)
    yield SYNC, bytes([get_sync_counter(cycle)])
    for axis, now in zip(axes, samples, strict=True):
        yield TPDO1 + axis.node_id, struct.pack("<ii", now.position, now.speed)
        word = ENABLED if now.enabled else DISABLED
        yield TPDO2 + axis.node_id, struct.pack("<Hih", word, now.current, now.voltage)
        yield TPDO3 + axis.node_id, struct.pack("<ii", _round_to_integer(now.target + now.offset, 31), now.offset)
        if cycle % MODE_EVERY == 0:
            yield TPDO4 + axis.node_id, struct.pack("<b", POSITION_MODE)


def get_sync_counter(cycle: int) -> int:
    """Return the counter byte of a cycle's SYNC.

    >>> get_sync_counter(0), get_sync_counter(239), get_sync_counter(240)
    (1, 240, 1)
    """
    return cycle % SYNC_RANGE + 1


class OffsetQueue:
    """Assigns offsets to servo cycles: returns the rows to be written to the streamer now. Pure.

    The streamer passes one row to HAL in each cycle. A row's number comes back through the sampler, so that the cycle
    of every later row is known. ``rows`` are (number, offsets in HAL's unit of each axis); before the first answer the
    queue is filled with zeros. A cycle without an offset keeps the one before; a late offset is dropped.
    """

    def __init__(self, axes: Sequence[Axis], lead: int) -> None:
        self._axes = {axis.node_id: place for place, axis in enumerate(axes)}
        self._per_unit = [axis.per_mm * axis.scales["position"] for axis in axes]
        self._lead = lead
        self.dropped = self.restarts = 0
        self._reset()

    def _reset(self) -> None:
        self._next = 1  # the number of the row to be written next
        self._zero: int | None = None  # the cycle in which row 0 would have taken effect
        self._held = [0.0] * len(self._per_unit)
        self._answers: dict[int, dict[int, float]] = {}
        self._newest = -1

    @property
    def is_running(self) -> bool:
        """Whether rows were written to the streamer."""
        return self._next > 1

    def check_applied_row(self, cycle: int, row: int, empty: bool) -> None:
        """Take the row that the sampler saw in effect in a cycle. An empty streamer restarts the queue."""
        self._newest = cycle
        if not self.is_running or not row:
            return
        if self._zero is None and not empty and row < self._next:
            self._zero = cycle - row
        elif self._zero is not None and (empty or cycle - row != self._zero):
            self.restarts += 1
            self._reset()

    def take_offset(self, node_id: int, data: bytes) -> None:
        """Take the offset of an axis, with the counter of the SYNC that it answers."""
        place = self._axes.get(node_id)
        if place is None or len(data) != 5 or self._newest < 0:
            return
        increments, counter = struct.unpack("<iB", data)
        cycle = self._newest - (self._newest - (counter - 1)) % SYNC_RANGE
        self._answers.setdefault(cycle + 1 + self._lead, {})[place] = increments / self._per_unit[place]

    def take_rows(self) -> Iterator[tuple[int, list[float]]]:
        """Yield the rows to be written now."""
        if not self._answers:
            return
        if not self.is_running:
            for _ in range(self._lead):
                yield self._next_row()
        if self._zero is None:
            self._answers.clear()  # until the first row came back
            return
        for target in sorted(self._answers):
            if len(self._answers[target]) < len(self._per_unit) and target == max(self._answers):
                return  # the rest is still to come
            number = target - self._zero
            offsets = self._answers.pop(target)
            if number < self._next:
                self.dropped += 1
                continue
            while self._next < number:
                yield self._next_row()
            for place, offset in offsets.items():
                self._held[place] = offset
            yield self._next_row()

    def _next_row(self) -> tuple[int, list[float]]:
        self._next += 1
        return self._next - 1, list(self._held)


class HubClient:
    """One connection of a socketcand client."""

    def __init__(self, wire: socket.socket) -> None:
        wire.setblocking(False)
        wire.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.wire = wire
        self.out = bytearray(b"< hi >")
        self.raw = self.gone = False
        self._in = b""

    def read_commands(self) -> Iterator[list[bytes]]:
        """Yield the words of each received command."""
        try:
            came = self.wire.recv(1 << 16)
        except BlockingIOError:
            return
        except OSError:
            came = b""
        self.gone = self.gone or not came
        *whole, self._in = (self._in + came).split(b">")
        self.gone = self.gone or len(self._in) > MOST_COMMAND
        for command in whole:
            yield command.split()

    def flush_output(self) -> None:
        """Send as much as the client takes; drop a client that reads nothing."""
        try:
            while self.out:
                del self.out[: self.wire.send(self.out[: 1 << 16])]
        except BlockingIOError:
            self.gone = self.gone or len(self.out) > MOST_WAITING
        except OSError:
            self.gone = True


class SocketcandHub:
    """The bus on a TCP port: samples go to all clients; a client's frames go to the others, except offsets.

    Offsets are for HAL alone: their effect is read back from there.
    """

    def __init__(self, host: str, port: int) -> None:
        self._listener = socket.create_server((host, port))
        self._listener.setblocking(False)
        self._clients: list[HubClient] = []

    def receive_frames(self) -> list[tuple[int, bytes]]:
        """Accept clients and return the frames that they sent."""
        with contextlib.suppress(OSError):  # no client is waiting
            self._clients.append(HubClient(self._listener.accept()[0]))
        frames = []
        for client in self._clients:
            for words in client.read_commands():
                frame = self._execute_command(client, words)
                if frame is not None:
                    frames.append(frame)
        return frames

    def _execute_command(self, client: HubClient, words: Sequence[bytes]) -> tuple[int, bytes] | None:
        match list(words):
            case [b"<", b"open", *_]:
                client.out += b"< ok >"
            case [b"<", b"rawmode"]:
                client.out += b"< ok >"
                client.raw = True
            case [b"<", b"echo"]:
                client.out += b"< echo >"
            case [b"<", b"send", name, _length, *data]:
                try:
                    frame = int(name, 16), bytes(int(byte, 16) for byte in data)
                except ValueError:
                    return None
                if not RPDO2 < frame[0] < RPDO2 + 0x80:
                    self.send_text(_encode_frames([frame], time.time()), but=client)
                return frame
        return None

    def send_text(self, text: bytes, but: HubClient | None = None) -> None:
        """Send to every client in raw mode."""
        for client in self._clients:
            if client.raw and client is not but:
                client.out += text
            client.flush_output()
            if client.gone:
                client.wire.close()
        self._clients = [client for client in self._clients if not client.gone]


def _encode_frames(frames: Sequence[tuple[int, bytes]], stamp_s: float) -> bytes:
    stamp = f"{stamp_s:.6f}"
    return "".join(f"< frame {cob_id:03X} {stamp} {data.hex().upper()} >" for cob_id, data in frames).encode()


class HalSampler:
    """HAL's sampler on the axes' pins; PinError for a pin that cannot be sampled."""

    def __init__(self, hal: Any, component: Any, axes: Sequence[Axis], options: argparse.Namespace) -> None:
        channel, thread, more = options.channel, options.thread, options.also
        kinds = {pin.name: pin for pin in map(HalPin, _run_halcmd("-s", "show", "pin").splitlines()) if pin.name}
        functions = [
            words for line in _run_halcmd("-s", "show", "funct").splitlines() if len(words := line.split()) == 6
        ]
        self.corrected = SHARED[0] in _run_halcmd("-s", "show", "sig").split()
        self._places: list[dict[str, int]] = []
        wanted: dict[str, int] = {}
        for axis in axes:
            pins = dict(axis.pins)
            if self.corrected and axis.corrected:
                pins["offset"] = f"fdhil-limit-{axis.name.lower()}.out"
            for key, pin in pins.items():
                _require_pin(
                    pin, kinds, functions, f"axis.{axis.name}.drive.hal.{key}", "bit" if key == "enabled" else "float"
                )
            self._places.append({key: wanted.setdefault(pin, len(wanted)) for key, pin in pins.items()})
        if self.corrected:
            self._shared = [wanted.setdefault(pin, len(wanted)) for pin in ("streamer.0.pin.0", "streamer.0.empty")]
        if len(wanted) >= MOST_PINS:
            raise PinError(
                f"{len(wanted)} pins are too many for one sampler, which has {MOST_PINS}; leave out speed pins"
            )
        types = "".join(HAL_TYPES[kinds[pin].kind] for pin in wanted) + "s"
        if not hal.component_exists("sampler"):
            depths, kinds_of_all = [str(DEPTH)] * (1 + len(more)), [types, *more]
            _run_halcmd("loadrt", "sampler", f"depth={','.join(depths)}", f"cfg={','.join(kinds_of_all)}")
        for pin, place in wanted.items():
            _run_halcmd(
                "net",
                kinds[pin].signal or f"fdhil-{pin.replace('.', '-')}",
                pin,
                "=>",
                f"sampler.{channel}.pin.{place}",
            )
        _run_halcmd("net", "fdhil-lost", f"sampler.{channel}.overruns", "=>", f"sampler.{channel}.pin.{len(wanted)}")
        threads = _run_halcmd("-s", "show", "thread")
        if f"sampler.{channel}" not in threads.split():
            _run_halcmd("addf", f"sampler.{channel}", thread)
        self._stream = hal.stream(component, hal.sampler_base + channel, types)

    def read_cycles(self) -> Iterator[tuple[int, list[dict[str, float]], int, bool]]:
        """Yield each new cycle: its number, the axes' values, the streamer's row, whether the streamer is empty."""
        while self._stream.readable:
            row = self._stream.read()
            if row is None:
                return
            values = [{key: row[place] for key, place in places.items()} for places in self._places]
            applied, empty = (row[k] for k in self._shared) if self.corrected else (0, True)
            yield self._stream.sampleno + row[-1], values, applied, empty  # lost samples count, too


class HalPin:
    """A line of ``halcmd -s show pin``: owner, type, direction, value, name, and linked signal."""

    def __init__(self, line: str) -> None:
        words = line.split()
        self.owner, self.name, self.kind, self.signal = "", "", "", ""
        if len(words) >= 5 and words[1] in HAL_TYPES:
            self.owner, self.kind, self.name = words[0], words[1], words[4]
            self.signal = words[6] if len(words) > 6 else ""


def _require_pin(pin: str, pins: Mapping[str, HalPin], functions: Sequence[Sequence[str]], key: str, kind: str) -> None:
    """Raise PinError unless HAL has the pin, with this type, and a thread computes it.

    ``functions`` are the words of ``halcmd -s show funct``: owner, two addresses, floating point, users, name.
    """
    found = pins.get(pin)
    owner = pin.rpartition(".")[0]
    if found is None:
        near = [name for name in pins if name.rpartition(".")[0] == owner]
        known = f"{owner} has {', '.join(near[:8])}" if near else f"no component {owner} is loaded"
        raise PinError(f"{key}: HAL has no pin {pin}; {known}. Correct {key}, or load the bridge after that component")
    if found.kind != kind:
        raise PinError(f"{key}: pin {pin} is of type {found.kind}, and {key} needs {kind}. Name another pin")
    used = {words[5]: words[4] != "0" for words in functions if words[0] == found.owner}
    own = {name: runs for name, runs in used.items() if name == owner or name.startswith(f"{owner}.")} or used
    if not any(own.values()):
        why = f"function {next(iter(own))} is in no thread; addf it" if own else "its component runs in userspace"
        raise PinError(f"{key}: pin {pin} is not computed in the servo thread: {why}, or name another pin")


def _run_halcmd(*words: str) -> str:
    done = subprocess.run(["halcmd", *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise PinError(f"halcmd {' '.join(words)}: {done.stderr.strip() or done.stdout.strip()}")
    return done.stdout


class HalBridge:
    """Carries samples to the bus and offsets to the streamer, in one loop."""

    def __init__(self, hal: Any, component: Any, options: argparse.Namespace) -> None:
        document = tomllib.loads(Path(options.config).read_text("utf-8"))
        self.axes = read_axes(document)
        if not self.axes:
            raise PinError(f'{options.config} has no axis with source = "hal"')
        bus = document["bus"][
            next(t for t in document["axis"].values() if t["drive"].get("source") == "hal")["drive"]["bus"]
        ]
        self._readers = [AxisReader(axis) for axis in self.axes]
        self._hub = SocketcandHub(options.host, int(bus["port"]))
        self._sampler = HalSampler(hal, component, self.axes, options)
        lead, corrected = int(bus.get("offset_lead_cycles", 0)), [axis for axis in self.axes if axis.corrected]
        self._queue = OffsetQueue(corrected, lead) if self._sampler.corrected and lead else None
        self._component = component
        if self._queue is not None:
            _run_halcmd("net", "fdhil-beat", f"{NAME}.heartbeat", "=>", "fdhil-watchdog.in")
            self._streamer = hal.stream(component, hal.streamer_base, "s" + "f" * len(corrected))
        self._silent_s = GUARD_SILENT_S + lead * self.axes[0].period_s
        self._guard_s = -self._silent_s
        self._started_s = time.time()

    def run_turn(self) -> None:
        """Run one turn: send samples, receive frames, feed the streamer."""
        text = bytearray()
        for cycle, values, row, empty in self._sampler.read_cycles():
            if self._queue is not None:
                self._queue.check_applied_row(cycle, row, empty)
            samples = [reader.read_sample(value) for reader, value in zip(self._readers, values, strict=True)]
            stamp_s = self._started_s + cycle * self.axes[0].period_s
            text += _encode_frames(list(encode_cycle(cycle, self.axes, samples)), stamp_s)
        self._hub.send_text(bytes(text))
        for cob_id, data in self._hub.receive_frames():
            if RPDO2 < cob_id < RPDO2 + 0x80 and self._queue is not None:
                self._queue.take_offset(cob_id - RPDO2, data)
                self._guard_s = time.monotonic()
        if self._queue is not None:
            for number, offsets in self._queue.take_rows():
                if self._streamer.writable:
                    self._streamer.write((number, *offsets))
            if time.monotonic() - self._guard_s < self._silent_s:
                self._component["heartbeat"] = not self._component["heartbeat"]
            self._component["dropped"], self._component["restarts"] = self._queue.dropped, self._queue.restarts


def serve_bus(hal: Any, component: Any, options: argparse.Namespace) -> NoReturn:
    """Set up and run until LinuxCNC ends."""
    bridge = HalBridge(hal, component, options)
    component.ready()
    sys.stderr.write(f"{NAME}: presents axes {', '.join(axis.name for axis in bridge.axes)} as a CANopen bus\n")
    while True:
        bridge.run_turn()
        time.sleep(LOOK_S)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run until LinuxCNC ends; a pin that cannot be sampled is reported, and does not keep LinuxCNC from starting."""
    parser = argparse.ArgumentParser(description="Presents HAL pins to fdhil; loaded by LinuxCNC's HAL file.")
    parser.add_argument("config", help="the machine's configuration, with [axis.X.drive.hal]")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at; 0.0.0.0: also for another computer")
    parser.add_argument("--channel", type=int, default=0, help="sampler channel, where HAL has loaded sampler already")
    parser.add_argument("--also", nargs="*", default=(), help="types of further sampler channels, for other programs")
    parser.add_argument("--thread", default="servo-thread", help="the thread of the motion controller")
    options = parser.parse_args(arguments)
    here = Path(__file__).resolve().parent
    sys.path[:] = [folder for folder in sys.path if Path(folder).resolve() != here]  # it contains linuxcnc.py
    import hal  # type: ignore[import-not-found]  # LinuxCNC's own

    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    component = hal.component(NAME)
    component.newpin("heartbeat", hal.HAL_BIT, hal.HAL_OUT)
    for name in ("dropped", "restarts"):  # offsets that came too late, times that the streamer ran empty
        component.newpin(name, hal.HAL_S32, hal.HAL_OUT)
    try:
        serve_bus(hal, component, options)
    except KeyboardInterrupt:
        return 0
    except Exception as error:  # noqa: BLE001 - an error here must not end LinuxCNC
        sys.stderr.write(f"{NAME}: fdhil receives and corrects nothing ({error}); LinuxCNC starts without it\n")
        component.ready()
        time.sleep(1.0)  # halcmd must see that the component was ready
        return 0
    finally:
        component.exit()


if __name__ == "__main__":
    sys.exit(main())
