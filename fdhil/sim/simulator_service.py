"""Serves the simulated machine in one loop: its buses, the operator's commands and the clock.

In ``realtime`` the NC's SYNC follows the host's monotonic clock; a late host delays the SYNC, which does not catch up.
In ``lockstep`` the next SYNC is sent as soon as every RPDO of the cycle has arrived, and an idle machine does not run
faster than its period. A sender that stops after a zero offset is awaited briefly; one whose offset is in force is
awaited as long as it may sleep on a busy host, unless it has left the bus.
"""

import math
import os
import select
import tempfile
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import partial
from pathlib import Path
from typing import Any

from fdhil.config import MachineConfig
from fdhil.errors import FdhilError
from fdhil.records import Trajectory
from fdhil.sim.drive import eds_writer
from fdhil.sim.fault_kinds import FaultEntry
from fdhil.sim.frame_faults import Passed
from fdhil.sim.frame_types import BusFrame, Frame
from fdhil.sim.nc.demand_stream import DemandStream, StreamError
from fdhil.sim.operator_commands import MAX_LINE, CommandError, OperatorCommands
from fdhil.sim.simulated_machine import SimulatedMachine
from fdhil.sim.wire.bus_attachment import BusAttachment, Selectable, WakePipe
from fdhil.sim.wire.can_buses import attach_bus
from fdhil.sim.wire.sensor_connections import SensorConnections
from fdhil.sim.wire.stream_port import StreamPort

Loader = Callable[[Path, MachineConfig], Trajectory]
Emit = Callable[[dict[str, Any]], None]

WALL_CLOCK_S = 0.004  # interval of heartbeats and time-outs
ALONE_S = 0.001  # the same while a drive moves by its own clock
IDLE_PERIODS = 4  # SYNC interval of an idle machine in lockstep, to spare the listeners
LOCKSTEP_WAIT_S = 2.0  # how long a machine at rest waits for a delayed guard or SYNC producer
LOCKSTEP_HOLDING_WAIT_S = 8.0  # listeners consider a bus dead after ten seconds without SYNC
_MIN_SPACING = 0.75  # of a period, between two SYNCs after a late one
_CATCH_UP = 0.95  # of a period, between two SYNCs while stream rows pile up
_MAX_WAIT_S = 0.25
_STREAM = Path("-")


class SyncPace:
    """Decides when the next SYNC may be sent; all times are monotonic seconds."""

    def __init__(self, period_s: float, *, lockstep: bool) -> None:
        self._period_s, self._lockstep = period_s, lockstep
        self._next_s = 0.0
        self._last_s = 0.0

    def compute_due_s(self, *, waits: bool, idle: bool, holds: bool = False) -> float:
        """Return the time of the next SYNC.

        ``waits``: an awaited RPDO is missing; ``holds``: an offset is in force, or its program runs; ``idle``: nothing
        is played.
        """
        if self._lockstep and waits:
            return self._last_s + (LOCKSTEP_HOLDING_WAIT_S if holds else LOCKSTEP_WAIT_S)
        if not self._lockstep:
            return self._next_s
        return self._last_s + IDLE_PERIODS * self._period_s if idle else 0.0

    def record_sync(self, now_s: float, *, behind: bool = False) -> None:
        """Record a sent SYNC: the next one is a period later on the grid, unless the host is late.

        ``behind`` the source of the demand, the grid is a little tighter until the machine has caught up. Lockstep has
        no grid: a machine ahead of the clock must not wait for it.
        """
        self._last_s = now_s
        spacing_s = self._period_s * (_CATCH_UP if behind else 1.0)
        self._next_s = max(self._next_s + spacing_s, now_s + _MIN_SPACING * self._period_s)


class DriveClock:
    """The time base of the drives' heartbeats and time-outs.

    It slows down when the host was late: a real drive has no such pauses. In lockstep it advances with SYNC, whichever
    program produces it, until SYNC has been missing for LOCKSTEP_WAIT_S.
    """

    def __init__(self, period_s: float, *, lockstep: bool) -> None:
        self._period_s, self._lockstep = period_s, lockstep
        self._time_s, self._read_s, self._read_tick = 0.0, 0.0, 0
        self._sync_s = -math.inf

    def read_time(self, now_s: float, tick: int) -> float:
        """Return the drives' time, s, at a monotonic time and a SYNC count."""
        passed_s = now_s - self._read_s if self._read_s else WALL_CLOCK_S
        cycles = tick - self._read_tick
        self._read_s, self._read_tick = now_s, tick
        self._sync_s = now_s if cycles else self._sync_s
        if self._lockstep and now_s - self._sync_s < LOCKSTEP_WAIT_S:
            passed_s = min(passed_s, cycles * self._period_s)
        self._time_s += min(passed_s, 2 * WALL_CLOCK_S)
        return self._time_s


class SimulatorService:
    """The simulated machine with its ports open. :meth:`run` serves it until :meth:`stop`, then closes everything.

    ``emit`` receives every event, the first one is ``ready``. ``load`` reads a file to play (a demand CSV or a
    program). ``panel_fd`` is the source of commands, None for none. ConnectError when a port or bus cannot be opened.
    """

    def __init__(
        self,
        config: MachineConfig,
        emit: Emit,
        load: Loader,
        *,
        panel_fd: int | None = None,
        faults: Sequence[FaultEntry] = (),
    ) -> None:
        self.config = config
        self.machine = SimulatedMachine(config)
        self._emit, self._load = emit, load
        self._panel = OperatorCommands(self.machine, self._load_and_play, self.stop)
        self._panel_fd = panel_fd
        self._line = b""
        self._stream: DemandStream | None = None
        self._streaming = False
        self.serving = False  # until then the file to play is read, which may be an endless pipe
        self._ending = False
        self._wall_s = 0.0
        self._loads: list[tuple[Path, Future[Trajectory]]] = []
        self._queued: deque[tuple[str, Future[str]]] = deque()
        self._closed = False
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="ThreadPoolExecutor-sim")
        self._pipe = WakePipe()
        self._known_leavers = 0
        lockstep = config.sim.pace == "lockstep"
        self._pace = SyncPace(config.machine.sync_period_s, lockstep=lockstep)
        self._drive_clock = DriveClock(config.machine.sync_period_s, lockstep=lockstep)
        self._buses: dict[str, BusAttachment] = {}
        self._sensors: SensorConnections | None = None
        self._streams: dict[str, StreamPort] = {}
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        try:
            for entry in faults:
                self.machine.faults.add_entry(entry)
            self._open_ports()
        except BaseException:
            self.close_ports()
            raise

    def _open_ports(self) -> None:
        for name in self.machine.buses:
            self._buses[name] = attach_bus(name, self.config.bus[name])
            self._buses[name].apply_faults = partial(self._filter_arriving_frame, name)
        if self.config.sim.modbus:
            units = self.machine.units
            positions = {axis: partial(getattr, unit.drive, "table_mm") for axis, unit in units.items()}
            sensors = SensorConnections(self.config, {axis: unit.sensor for axis, unit in units.items()}, positions)
            sensors.start()
            self._sensors = sensors
        for axis in self.machine.tables.accelerometers:
            section = self.config.axis[axis].accelerometer
            assert section is not None
            self._streams[axis] = StreamPort(f"accelerometer {axis}", section.device)

    def _filter_arriving_frame(self, bus: str, frame: Frame, sender: object) -> list[Passed]:
        passed = self.machine.wires[bus].process_frame(frame, "received", time.monotonic(), sender)
        if frame[0] not in [can_id for (can_id, _), _ in passed]:
            self.machine.mark_frame_lost(bus, frame[0])
        return passed

    def _receive_frame(self, bus: str, frame: Frame) -> None:
        answers = self.machine.receive_frame(bus, frame)
        if answers:
            self._send_on_bus(bus, answers)

    def _send_on_bus(self, bus: str, frames: Sequence[Frame]) -> None:
        wire = self.machine.wires[bus]
        if not wire.is_idle:
            now_s = time.monotonic()
            frames = [each for frame in frames for each, _ in wire.process_frame(frame, "sent", now_s)]
        self._buses[bus].queue_frames(frames)

    def _release_delayed_frames(self, now_s: float) -> None:
        for name, wire in self.machine.wires.items():
            if wire.is_idle:
                continue
            bus = self._buses[name]
            if wire.down:
                bus.disconnect_clients()
            bus.queue_frames([frame for frame, _ in wire.release_due("sent", now_s)])
            for frame, sender in wire.release_due("received", now_s):
                bus.relay_frame(frame, sender)
                self._receive_frame(name, frame)

    def build_ready_event(self) -> dict[str, Any]:
        """Return the ready event and write the EDS files that it names."""
        return {
            "event": "ready",
            "buses": {name: bus.settings for name, bus in self._buses.items()},
            "modbus": self._sensors.ready if self._sensors is not None else {},
            "accelerometers": {axis: port.path for axis, port in self._streams.items()},
            **self.machine.describe_drives(self._write_eds()),
            "pace": self.config.sim.pace,
            "sync_period_s": self.config.machine.sync_period_s,
        }

    def _write_eds(self) -> dict[str, Path]:
        """Write the EDS files to the run directory if it is writable, else to a temporary folder."""
        run = self.config.store.run_directory
        if run is not None and run.is_dir() and os.access(run, os.W_OK):
            folder = run / "eds"
        else:
            self._folder = tempfile.TemporaryDirectory(prefix="fdhil-sim-")
            folder = Path(self._folder.name)
        return {
            axis: eds_writer.write_eds(unit.drive, folder / f"fdhil_twin_{axis}.eds").resolve()
            for axis, unit in self.machine.units.items()
        }

    def close_ports(self) -> None:
        """Close every port and end every thread; an unfinished trace is discarded."""
        self._pool.shutdown(wait=True, cancel_futures=True)
        if self._sensors is not None:
            self._sensors.stop()
            self._sensors = None
        for stream in self._streams.values():
            stream.close()
        self._streams.clear()
        for bus in self._buses.values():
            bus.close()
        self._buses.clear()
        self.machine.abandon_trace()
        if self._folder is not None:
            self._folder.cleanup()
        self._pipe.close()
        self._closed = True

    def stop(self) -> None:
        """Request the end of the loop; may be called from a signal handler or another thread."""
        self._ending = True
        self._pipe.wake_reader()

    @property
    def has_clients(self) -> bool:
        return any(bus.has_clients for bus in self._buses.values())

    def run(self, play: Path | None = None, trace: Path | None = None) -> None:
        """Report ready and serve until stopped. ``play`` is played at once, recorded to ``trace``.

        ``-`` is a demand on the panel's descriptor, among the commands, until its end; with its first rows the NC takes
        the bus.
        """
        try:
            if play == _STREAM:
                self._stream = DemandStream(tuple(self.config.axis), self.config.machine.sync_period_s)
            demand = None if play is None or play == _STREAM else self._load(play, self.config)
            self._send_frames(self.machine.power_on())
            self.serving = True
            self._emit(self.build_ready_event())
            self._serve_panel()
            if trace is not None:
                self.machine.record_next_file(trace)
            if demand is not None or self.config.sim.nc:
                self.machine.nc.switch_on_off(True)
            if demand is not None:
                self.machine.nc.play_demand(str(play), demand)
            while not self._ending:
                self._run_turn()
        finally:
            self.close_ports()

    def _run_turn(self) -> None:
        buses = self._buses.values()
        readers: list[int | Selectable] = [self._pipe]
        if self._panel_fd is not None and not (self._stream is not None and self._stream.is_full):
            readers.append(self._panel_fd)
        writers: list[Selectable] = []
        for bus in buses:
            readers += bus.list_readers()
            writers += bus.list_writers()
        timeout_s = self._compute_timeout_s()
        ready, _, _ = select.select(readers, writers, (), timeout_s)
        if not ready and timeout_s > 0.0:  # this process may have slept: handle what arrived meanwhile first
            ready, _, _ = select.select(readers, writers, (), 0.0)
        if ready:
            self._read_ready(ready)
        self._play_loaded_files()
        now_s = time.monotonic()
        if now_s >= self._wall_s:
            self._run_drive_timers(now_s)
        if self._compute_sync_due_s() <= now_s:
            self._pace.record_sync(now_s, behind=self._stream is not None and self._stream.is_behind)
            self._known_leavers = self._count_senders_left()
            self._send_frames(self.machine.run_nc_cycle())
        for axis, stream in self._streams.items():
            stream.send_lines(self.machine.tables.accelerometers[axis].take_lines())
        for event in self.machine.take_events():
            self._emit(event)
        self._release_delayed_frames(now_s)
        for bus in buses:
            bus.flush_frames(now_s)

    def _read_ready(self, ready: Sequence[object]) -> None:
        if self._pipe in ready:
            self._pipe.clear_wakes()
            self._execute_queued_commands()
        if self._panel_fd is not None and self._panel_fd in ready:
            self._serve_panel()
        for name, bus in self._buses.items():
            bus.receive_frames(ready, partial(self._receive_frame, name))

    def _compute_timeout_s(self) -> float:
        now_s = time.monotonic()
        deadlines = [self._wall_s, self._compute_sync_due_s(), now_s + _MAX_WAIT_S]
        deadlines += [wire.find_next_due_s() for wire in self.machine.wires.values()]
        deadlines += [at for bus in self._buses.values() if (at := bus.find_deadline_s()) is not None]
        return max(0.0, min(deadlines) - now_s)

    def _compute_sync_due_s(self) -> float:
        """Return when the NC's next cycle may run: never without NC, nor while a bus is congested."""
        machine = self.machine
        if not machine.nc.is_on or any(bus.is_congested for bus in self._buses.values()):
            return float("inf")
        waits = machine.is_waiting_for_rpdo() and self._count_senders_left() == self._known_leavers
        idle, dry = not machine.nc.is_busy, False
        if self._stream is not None:
            idle, dry = idle or self._stream.is_waiting, self._stream.runs_dry
        return self._pace.compute_due_s(
            waits=waits or dry, idle=idle, holds=waits and (machine.nc.is_busy or machine.has_offset_in_force())
        )

    def _count_senders_left(self) -> int:
        return sum(bus.senders_left for bus in self._buses.values())

    def _run_drive_timers(self, now_s: float) -> None:
        frames = self.machine.run_timers(self._drive_clock.read_time(now_s, self.machine.tick))
        self._wall_s = now_s + (ALONE_S if self.machine.is_self_clocked else WALL_CLOCK_S)
        if frames:
            self._send_frames(frames)

    def _send_frames(self, frames: Sequence[BusFrame]) -> None:
        if len(self._buses) == 1:
            self._send_on_bus(next(iter(self._buses)), [frame for _, frame in frames])
            return
        for name in self._buses:
            self._send_on_bus(name, [frame for where, frame in frames if where == name])

    def _serve_panel(self) -> None:
        """Execute the commands received on the panel's descriptor; its end does not end the machine."""
        if self._panel_fd is None or not select.select([self._panel_fd], (), (), 0)[0]:
            return
        try:
            chunk = os.read(self._panel_fd, 1 << 16)
        except BlockingIOError:
            return
        except OSError:  # the terminal was closed
            chunk = b""
        *lines, self._line = (self._line + chunk).split(b"\n")
        if not chunk:
            self._panel_fd = None
        if not chunk or len(self._line) > MAX_LINE:
            lines, self._line = [*lines, self._line], b""
        for line in lines:
            self._execute_line(line.decode("utf-8", "replace"))
        if self._stream is not None:
            self._serve_stream(self._stream)

    def _serve_stream(self, stream: DemandStream) -> None:
        """Start a stream once it has enough rows; it ends with standard input."""
        if self._panel_fd is None:
            stream.close_stream()
        if self._streaming:
            return
        if stream.start_mm is not None:
            self._streaming = True
            self.machine.nc.switch_on_off(True)
            self.machine.nc.play_demand("standard input", stream)
        elif stream.has_ended:
            self._emit({"event": "error", "text": "standard input ended before the first row of the demand"})

    def execute_command(self, line: str) -> str:
        """Execute one panel command in the loop and wait for it. For other threads.

        Return why the command is invalid (also an event), "" when it is valid.
        """
        result: Future[str] = Future()
        self._queued.append((line, result))
        self._pipe.wake_reader()
        while not result.done() and not self._closed:
            wait([result], _MAX_WAIT_S)
        return result.result() if result.done() else ""

    def _execute_queued_commands(self) -> None:
        """Execute the commands of other threads between two turns, when the machine is consistent."""
        while self._queued:
            line, result = self._queued.popleft()
            result.set_result(self._execute_line(line))

    def _execute_line(self, line: str) -> str:
        try:
            if self._stream is None or line.startswith("{"):
                self._panel.execute_line(line)
            else:
                self._stream.receive_line(line)
        except (CommandError, StreamError) as error:
            self._emit({"event": "error", "text": str(error)})
            return str(error)
        return ""

    def _load_and_play(self, file: Path) -> None:
        """Load a file in another thread, so that SYNC continues, then play it."""
        future = self._pool.submit(self._load, file, self.config)
        self._loads.append((file, future))
        future.add_done_callback(lambda _: self._pipe.wake_reader())

    def _play_loaded_files(self) -> None:
        """Play the loaded files; after a stop, wait until the axes are at rest."""
        while self._loads and self._loads[0][1].done() and not self.machine.nc.is_stopping:
            file, future = self._loads.pop(0)
            try:
                self.machine.nc.play_demand(str(file), future.result())
            except FdhilError as error:
                self._emit({"event": "error", "text": f"{file} cannot be played: {error}"})
