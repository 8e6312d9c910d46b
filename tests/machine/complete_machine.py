"""The machine of a seed: production code from the operator's request to the drive's offset, one SYNC after another."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import hashlib
import io
import json
import os
import select
import shutil
import socket
import tempfile
from collections.abc import Callable, Coroutine, Iterable, Mapping
from pathlib import Path
from typing import Any, Self

from fdhil import config as machine_config
from fdhil.arming.guard_client import GuardClient
from fdhil.arming.guard_configuration import find_corrected_bus, make_guard_settings
from fdhil.arming.operator_token import get_operator_token, make_run_directory
from fdhil.commissioning.commissioning_record import CommissioningRecord, compute_axis_digest, load_record, save_record
from fdhil.commissioning.void_mark import clear_void_mark, read_void_mark
from fdhil.config import MachineConfig
from fdhil.daemon.daemon_service import DaemonService
from fdhil.daemon.daemon_socket import SOCKET_NAME
from fdhil.drivers import open_machine
from fdhil.guard.event_journal import Clock as GuardClock
from fdhil.guard.event_journal import EventJournal, SystemdNotifier
from fdhil.guard.frame_monitor import FrameMonitor
from fdhil.guard.guard_process import Guard
from fdhil.program import load_trajectory
from fdhil.sim.fault_script import parse_entry as parse_fault
from fdhil.sim.frame_types import BusFrame
from fdhil.sim.simulated_machine import SimulatedMachine as Plant
from tests.bench import bench_axis
from tests.machine.memory_bus import GuardPoll, GuardSocket, MemoryBus
from tests.machine.virtual_time import VirtualClock, VirtualLoop

WALL_CLOCK_S = 0.05  # between two looks of the simulated drives at their own clock
BOOT_S = 10.0
LATER_S = 1000.0  # a machine begins later than the one whose store it takes over


def build_shuttle_program(axes: Iterable[str] = "XY", times: int = 2) -> str:
    """Return a program of rapids from which the daemon identifies every axis."""
    there, back = (" ".join(f"{axis}{place}" for axis in axes) for place in (200, 0))
    return "G21 G90 G94\n" + f"G0 {there}\nG4 P0.3\nG0 {back}\nG4 P0.3\n" * times + "M2\n"


def build_document(axes: str = "XY", **sections: Any) -> dict[str, Any]:
    """Return the configuration of the machine: the bench on a bus in memory."""
    return {
        "machine": {"name": "bench", "sync_period_s": 0.001},
        "axis": {name: bench_axis() for name in axes},
        "bus": {"can0": {"interface": "virtual", "channel": "memory"}},
        **sections,
    }


class CompleteMachine:
    """A complete machine on virtual time; ``config`` is a parsed document, ``store`` an initial store.

    ``log`` is the daemon's log, ``journal`` the guard's; ``wrong`` lists each violated invariant with its time.
    """

    def __init__(
        self,
        seed: int = 1,
        config: Mapping[str, Any] | None = None,
        *,
        folder: Path | None = None,
        store: Path | None = None,
    ) -> None:
        self._temporary = tempfile.TemporaryDirectory(prefix="fdhil-machine-") if folder is None else None
        self.folder = Path(self._temporary.name) if self._temporary is not None else folder or Path()
        made = dict(config or build_document())
        made["sim"] = {"pace": "lockstep", "modbus": False, **made.get("sim", {}), "seed": seed}
        self.config: MachineConfig = machine_config.parse_config(made, folder=self.folder)
        if store is not None:
            shutil.copytree(store, self.config.store.directory)
        self.clock = _MachineClock(self)
        self.clock.time_s += 0.0 if store is None else LATER_S
        self.plant = Plant(self.config)
        self.bus = MemoryBus("can0", self.clock.now_s, self.plant.wires["can0"])
        self.bus.from_guard = self._receive_from_guard
        self.log, self.journal = io.StringIO(), b""
        self.events: list[dict[str, Any]] = []
        self.wrong: list[str] = []
        self.at_sync: Callable[[], None] = lambda: None
        self.at_guard_frame: Callable[[int, bytes], None] = lambda _cob_id, _data: None
        self.at_foreign_frame: Callable[[int, bytes], None] = lambda _cob_id, _data: None
        self.guard: Guard | None = None
        self.guard_exit: int | None = None
        self.service: DaemonService | None = None
        self._loop: VirtualLoop | None = None
        self._serving: asyncio.Task[Any] | None = None
        self._hung_until_s = 0.0
        self._guard_due_s = self._sync_s = self._wall_s = self.clock.now_s()
        make_run_directory(self.config.run_directory)
        self._commission_axes()
        self._put_frame(self.plant.power_on())

    # -- what the operator does

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close_machine()

    def run_for(self, seconds: float) -> None:
        if self._loop is None:
            self.clock.advance(self.clock.now_s() + seconds)
        else:
            self._complete_event(asyncio.sleep(seconds))

    def run_until(self, reached: Callable[[], bool], seconds: float = 60.0, step_s: float = 0.02) -> None:
        """Advance time until a condition holds; RuntimeError when it does not within ``seconds``."""
        end_s = self.clock.now_s() + seconds
        while not reached():
            if self.clock.now_s() >= end_s:
                raise RuntimeError(f"not reached within {seconds:g} s; the log ends with {self.log.getvalue()[-2000:]}")
            self.run_for(step_s)

    def switch_nc(self, on: bool) -> None:
        """Switch the NC on or off, and wait until it controls the drives or has released them."""
        seen = len(self.events)
        self.plant.nc.switch_on_off(on)
        self.run_until(lambda: any(e["event"] in ("nc", "error") for e in self.events[seen:]), BOOT_S)

    def play_program(self, program: str, name: str = "part.ngc", *, wait: bool = True) -> Path:
        """Play a program on the NC; ``wait`` for its end."""
        path = self.write_program(program, name)
        seen = len(self.events)
        self.plant.nc.play_demand(str(path), load_trajectory(path, self.config))
        if wait:
            self.run_until(lambda: self.has_finished(seen), 600.0, 0.1)
        return path

    def has_finished(self, since: int) -> bool:
        """Return whether the NC reported the end of a program or an error after this number of its events."""
        return any(e["event"] in ("finished", "stopped", "error") for e in self.events[since:])

    def write_program(self, program: str, name: str) -> Path:
        path = self.folder / name
        path.write_text(program, "utf-8")
        return path

    def request_daemon(self, what: str, **fields: Any) -> dict[str, Any]:
        """Send a request to the daemon's control socket and return the answer, as ``fdhil`` does."""
        if self._loop is None:
            raise RuntimeError("no daemon runs")
        answer: dict[str, Any] = self._complete_event(self._converse_with_daemon({"request": what, **fields}))
        return answer

    def arm_program(self, program: Path, **fields: Any) -> dict[str, Any]:
        """Arm a program with the operator's token."""
        return self.request_daemon("arm", program=str(program), token=self.read_token, **fields)

    def adopt_offset(self) -> dict[str, Any]:
        """Let the guard adopt the drives' offsets and ramp them to zero."""
        with GuardClient(self.config.guard_directory, clock=self.clock) as client:
            return client.adopt(self.read_token)

    def attest_facts(self) -> None:
        """Attest every drive's record, to the guard and on disk, as ``fdhil check`` does without differences."""
        directory = self.config.store.directory
        marks = {axis: read_void_mark(directory, axis) for axis in self.config.axis}
        records = {axis: load_record(directory, axis) for axis in self.config.axis}
        with GuardClient(self.config.guard_directory, clock=self.clock) as client:
            touched = client.read_touch_counts(self.read_token)
            seen = {axis: record.fingerprint for axis, record in records.items() if record is not None}
            answer = client.report_comparison(self.read_token, seen, touched)
        for axis in set(seen) - {each["axis"] for each in answer.get("refused", [])}:
            clear_void_mark(directory, axis, marks[axis])

    @property
    def read_token(self) -> str:
        """The operator's token."""
        return get_operator_token(self.config.run_directory)

    def inject_fault(self, kind: str, **fields: Any) -> None:
        """Start a named fault of the simulated machine, as the operator's panel does."""
        self.plant.faults.add_entry(parse_fault({"fault": kind, **fields}, tuple(self.plant.units)))

    # -- processes

    def start_processes(self, name: str) -> None:
        """Start the ``daemon`` or the ``guard``."""
        self._start_daemon() if name == "daemon" else self._start_guard()

    def stop_processes(self, name: str) -> None:
        """End a process as SIGTERM does, and wait for its end."""
        if name == "daemon":
            assert self._loop is not None
            assert self._serving is not None
            self._loop.send_signal()
            self._complete_event(asyncio.wait([self._serving]))
            self._end_daemon()
        else:
            self._wake_far.send(b"\x0f")
            self._guard_due_s = self.clock.now_s()
            self.run_until(lambda: self.guard is None)

    def kill_process(self, name: str) -> None:
        """End a process as SIGKILL does: the disk stays as it is, and its connections end."""
        self._kill_daemon() if name == "daemon" else self._kill_guard()

    def hang_process(self, name: str, seconds: float) -> None:
        """Stop a process as SIGSTOP does, and resume it after a time."""
        end_s = self.clock.now_s() + seconds
        if name == "guard":
            self._hung_until_s = end_s
            self.run_for(seconds)
            self._guard_due_s = end_s
        else:
            self.clock.advance(end_s)

    def restart_process(self, name: str) -> None:
        self.stop_processes(name)
        self.start_processes(name)

    def _start_daemon(self) -> None:
        assert self._loop is None
        loop = self._loop = VirtualLoop(self.clock)
        with self._is_current(loop):
            opened = functools.partial(open_machine, open_bus=self.bus.open_listener)
            self.service = DaemonService(self.config, opened, clock=self.clock)
            self._serving = loop.create_task(self.service.run())
        self.run_until(lambda: f"ready: {self.config.machine.name}" in self.log.getvalue()[-20_000:])

    @contextlib.contextmanager
    def _is_current(self, loop: VirtualLoop) -> Any:
        asyncio.set_event_loop(loop)
        asyncio._set_running_loop(loop)
        try:
            yield
        finally:
            asyncio._set_running_loop(None)
            asyncio.set_event_loop(None)

    def _end_daemon(self) -> None:
        assert self._loop is not None
        loop, serving, self._loop, self._serving, self.service = self._loop, self._serving, None, None, None
        with contextlib.redirect_stderr(self.log):
            _cancel_all(loop)
        loop.close()
        if serving is not None and not serving.cancelled() and (error := serving.exception()) is not None:
            self.wrong.append(f"{self.clock.now_s():.3f} s: the daemon ended with {error!r}")

    def _kill_daemon(self) -> None:
        """Keep the present disk content, close what the kernel would close, and prevent any further effect."""
        assert self._loop is not None
        assert self.service is not None
        loop, kept = self._loop, Path(tempfile.mkdtemp(dir=self.folder))
        store, left = self.config.store.directory, self.config.run_directory / SOCKET_NAME
        shutil.copytree(store, kept / "store", symlinks=True, ignore=self._list_foreign_tasks)
        self.service._arming.guard.close()
        loop.dead = True
        service, serving, self.service, self._loop, self._serving = self.service, self._serving, None, None, None
        loop.clock = VirtualClock()
        loop._selector._clock = loop.clock  # type: ignore[attr-defined] # its time no longer is the machine's
        with contextlib.redirect_stderr(io.StringIO()):
            _cancel_all(loop)
        loop.close()
        service._store.close()
        self.bus.listener = None
        for path in store.iterdir():
            if path != self.config.run_directory:
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        shutil.copytree(kept / "store", store, symlinks=True, dirs_exist_ok=True)
        shutil.rmtree(kept)
        assert serving is not None
        serving.exception()
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as stale:
            stale.bind(str(left))

    def _list_foreign_tasks(self, folder: str, names: list[str]) -> set[str]:
        """Return what a killed daemon has not written: sockets and settings of others."""
        run = self.config.run_directory
        return {run.name} if Path(folder) == run.parent and run.name in names else set()

    def _start_guard(self) -> None:
        assert self.guard is None
        run, name = self.config.guard_directory, find_corrected_bus(self.config, "machine")
        digest = hashlib.sha256(get_operator_token(self.config.run_directory).encode()).hexdigest()
        settings = make_guard_settings(self.config, name, run, digest)
        can = GuardSocket(self.bus, settings.sent_ids, FrameMonitor(settings).list_received_ids())
        self._journal_near, journal_far = os.pipe()
        os.set_blocking(self._journal_near, False)
        self._journal_far = journal_far
        wake, self._wake_far = socket.socketpair()
        wake.setblocking(False)
        self._wake_near = wake
        self.bus.guard = can

        def create_poll() -> Any:
            return GuardPoll(can, self._is_guard_idle, self._pass_for_failed_guard)

        journal = EventJournal(journal_far, GuardClock(self.clock.now_s, self.clock.wall_s, create_poll))
        self.guard_exit = None
        self.guard = Guard(settings, can, journal, SystemdNotifier(None), wake)
        self.guard.report_ready()
        self._guard_due_s = self.clock.now_s()

    def _handle_guard_exit(self) -> None:
        self._take_journal()
        self.guard, self.bus.guard = None, None
        for descriptor in (self._journal_near, self._journal_far):
            os.close(descriptor)
        self._wake_near.close()
        self._wake_far.close()

    def _kill_guard(self) -> None:
        guard = self.guard
        assert guard is not None
        for client in guard.control.clients:
            client.release_descriptor()
            client.socket.close()
        guard.control._listener.socket.close()
        guard.control._closer.finish_closing()
        guard._notifier.close()
        guard._can.close()
        self._handle_guard_exit()

    def _take_journal(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while chunk := os.read(self._journal_near, 1 << 16):
                self.journal += chunk

    # -- time

    def _complete_event(self, work: Coroutine[Any, Any, Any]) -> Any:
        assert self._loop is not None
        assert self._serving is not None
        with contextlib.redirect_stderr(self.log):
            result = self._loop.run_until_complete(work)
        if self._serving.done() and self._serving.exception() is not None:
            self._end_daemon()
        return result

    async def _converse_with_daemon(self, request: Mapping[str, Any]) -> dict[str, Any]:
        path = str(self.config.run_directory / SOCKET_NAME)
        reader, writer = await asyncio.open_unix_connection(path)
        try:
            writer.write(json.dumps(request).encode() + b"\n")
            answer: dict[str, Any] = json.loads(await reader.readline())
            return answer
        finally:
            writer.close()

    def pass_until(self, until_s: float) -> None:
        """Run the machine until a time: SYNC, the drives' own clocks, and the guard's turns."""
        clock = self.clock
        while (due_s := self._compute_due_s()) <= until_s:
            clock.time_s = max(clock.time_s, due_s)
            self._run_due_work()
        clock.time_s = max(clock.time_s, until_s)

    def _compute_due_s(self) -> float:
        due_s = min(self._sync_s, self._wall_s) if self.plant.nc.is_on else self._wall_s
        return due_s if self.guard is None else min(due_s, max(self._guard_due_s, self._hung_until_s))

    def _run_due_work(self) -> None:
        now_s, plant = self.clock.time_s, self.plant
        if now_s >= self._wall_s:
            self._wall_s = now_s + WALL_CLOCK_S
            self._put_frame(plant.run_timers(now_s))
        synced = plant.nc.is_on and now_s >= self._sync_s
        if synced:
            self._sync_s = now_s + plant.period_s
            self._put_frame(plant.run_nc_cycle())
        elif not plant.nc.is_on:
            self._sync_s = now_s
        if plant.nc.events or plant.events:
            self.events += plant.take_events()
        self._run_guard_turn()
        if synced:
            self.at_sync()

    def _run_guard_turn(self) -> None:
        guard, can, now_s = self.guard, self.bus.guard, self.clock.time_s
        if guard is None or can is None or now_s < self._hung_until_s:
            return
        if not can.is_readable and now_s < self._guard_due_s:
            return
        self.guard_exit = guard.run_turn()
        if self.guard_exit is not None:
            self._handle_guard_exit()

    def _is_guard_idle(self, seconds: float) -> None:
        self._guard_due_s = self.clock.time_s + max(seconds, 1e-4)

    def _pass_for_failed_guard(self, seconds: float) -> None:
        """Advance time until a frame comes, for a guard whose loop has failed."""
        guard, self.guard = self.guard, None
        end_s, can = self.clock.time_s + seconds, self.bus.guard
        while can is not None and not can.is_readable and (due_s := self._compute_due_s()) <= end_s:
            self.clock.time_s = max(self.clock.time_s, due_s)
            self._run_due_work()
        if can is not None and not can.is_readable:
            self.clock.time_s = max(self.clock.time_s, end_s)
        self.guard = guard

    def wait_readable(self, connection: socket.socket, seconds: float) -> bool:
        """Run the machine until a connection is readable, at most for a given time."""
        end_s = self.clock.time_s + seconds
        if self.guard is not None:
            self._guard_due_s = self.clock.time_s
        while True:
            self._run_guard_turn()
            if _is_readable(connection):
                return True
            due_s = self._compute_due_s()
            if due_s > end_s:
                self.clock.time_s = max(self.clock.time_s, end_s)
                return False
            self.clock.time_s = max(self.clock.time_s, due_s)
            self._run_due_work()

    # -- frames

    def _put_frame(self, frames: list[BusFrame]) -> None:
        faults = self.bus.faults
        if faults.is_idle:
            self.bus.put_frame([frame for _, frame in frames])
            return
        now_s = self.clock.time_s
        passed = [frame for _, each in frames for frame, _ in faults.process_frame(each, "sent", now_s)]
        self.bus.put_frame([*passed, *(frame for frame, _ in faults.release_due("sent", now_s))])
        self._deliver_frame([frame for frame, _ in faults.release_due("received", now_s)])

    def _receive_from_guard(self, cob_id: int, data: bytes) -> bool:
        self.at_guard_frame(cob_id, data)
        frame = (cob_id, data)
        faults = self.bus.faults
        passed = (
            [frame]
            if faults.is_idle
            else [each for each, _ in faults.process_frame(frame, "received", self.clock.time_s)]
        )
        self._deliver_frame(passed, of_guard=True)
        return True

    def send_frame(self, can_id: int, data: bytes) -> None:
        """Send a frame as another node of the bus."""
        self._deliver_frame([(can_id, data)])

    def _deliver_frame(self, frames: list[tuple[int, bytes]], *, of_guard: bool = False) -> None:
        for frame in frames:
            self.bus.put_frame([frame], of_guard=of_guard)
            if not of_guard:
                self.at_foreign_frame(*frame)
            if answers := self.plant.receive_frame("can0", frame):
                self.bus.put_frame(answers)

    @property
    def read_guard_state(self) -> str:
        """The guard's state, ``gone`` if none runs."""
        return "gone" if self.guard is None else self.guard.state.mode.value

    def read_offset_um(self) -> dict[str, float]:
        """Return the offset in force of each drive, um."""
        return {name: unit.drive.offset_mm * 1e3 for name, unit in self.plant.units.items()}

    def _commission_axes(self) -> None:
        """Create the drives' records as ``fdhil commission`` writes them."""
        for name, unit in self.plant.units.items():
            number = unit.drive.dictionary.get_number
            keys = (0x6007, 0x605A, 0x605E, 0x6065, 0x6085, 0x1017)
            entries = unit.drive.dictionary.entries
            options = {f"{index:04X}": number(index, 0) for index in keys if index << 8 in entries}
            vendor, product, revision, serial = (number(0x1018, sub) for sub in (1, 2, 3, 4))
            record = CommissioningRecord(
                axis=name,
                vendor_id=vendor,
                product_code=product,
                revision=revision,
                serial=serial,
                config_digest=compute_axis_digest(self.config, name),
                mapping_fingerprint="as delivered",
                options=options,
                following_error_window_um=1e3 * self.config.axis[name].drive.following_error_window_mm,
                offset_in_feedforward=True,
                sign_test_um=10.0,
                readback_ok=True,
                watchdog="proven",
                created_utc="2026-09-01T00:00:00+00:00",
            )
            save_record(record, self.config.store.directory)

    def close_machine(self) -> None:
        if self._loop is not None:
            self._kill_daemon()
        if self.guard is not None:
            self._kill_guard()
        self.plant.abandon_trace()
        if self._temporary is not None:
            self._temporary.cleanup()


class _MachineClock(VirtualClock):
    """The machine's clock: time advances by the machine's work."""

    def __init__(self, machine: CompleteMachine) -> None:
        super().__init__()
        self._machine = machine

    def advance(self, until_s: float) -> None:
        self._machine.pass_until(until_s)

    def wait_readable(self, connection: socket.socket, seconds: float) -> bool:
        return self._machine.wait_readable(connection, seconds)


def _cancel_all(loop: VirtualLoop) -> None:
    if tasks := asyncio.all_tasks(loop):
        for task in tasks:
            task.cancel()
        loop.run_until_complete(asyncio.wait(tasks))
    loop.run_until_complete(loop.shutdown_asyncgens())


def _is_readable(connection: socket.socket) -> bool:
    poll = select.poll()
    poll.register(connection, select.POLLIN)
    return bool(poll.poll(0))
