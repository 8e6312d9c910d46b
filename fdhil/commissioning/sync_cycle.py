"""Run the SYNC cycle of the buses that fdhil controls: SYNC, the set-points it latches, and the received frames.

One thread works by absolute deadlines and sends everything that is time-critical. If the program hangs, nothing more is
sent, and the drives' watchdogs react.
"""

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Protocol, Self

from fdhil import cia402
from fdhil.commissioning.bus_watch import BusWatch
from fdhil.commissioning.foreign_master_stop import StoppableDrive, describe_outcome, stop_drives
from fdhil.commissioning.realtime_scheduling import CYCLE_PRIORITY, set_realtime_priority
from fdhil.commissioning.set_points import SetPointGenerator
from fdhil.commissioning.transmit import TransmitBus
from fdhil.config import MachineConfig
from fdhil.errors import DeviceError

LOCKSTEP_WAIT_S = 8.0
GUARD_WAIT_S = 2.0
MOST_CYCLE_US = 20_000
STALL_CYCLES = 20


class CycleMember(StoppableDrive, Protocol):
    """A drive that takes part in the cycle."""

    bus: TransmitBus
    target: int | None

    @property
    def is_awaited(self) -> bool:
        """Whether a simulated drive has yet to answer."""

    @property
    def position(self) -> int | None:
        """Newest position in increments."""

    def receive_frame(self, can_id: int, data: bytes) -> None:
        """Process a frame received on its bus."""

    def send_set_points(self) -> None:
        """Send what the next SYNC latches."""


class Lateness:
    """Histogram, in microseconds, of how late each SYNC was sent; ``skipped``: cycles that the computer missed."""

    def __init__(self) -> None:
        self.counts = [0] * (MOST_CYCLE_US + 1)
        self.cycles = self.skipped = 0
        self.most_us = 0.0

    def count_sync(self, late_s: float) -> None:
        """Count one SYNC."""
        late_us = max(0.0, late_s * 1e6)
        self.counts[min(int(late_us), MOST_CYCLE_US)] += 1
        self.cycles += 1
        self.most_us = max(self.most_us, late_us)

    def compute_quantile_us(self, share: float) -> float:
        """Return the lateness that this share of the SYNCs did not exceed."""
        wanted, seen = share * self.cycles, 0
        for late_us, count in enumerate(self.counts):
            seen += count
            if seen >= wanted and seen:
                return float(late_us)
        return self.most_us


class SyncCycle:
    """Runs the cycle of some buses in its own thread; a context manager.

    Nothing is sent before ``produce_sync``, except by the members. ``path`` supplies the members' set-points, in their
    order; ``failure`` is what ended the thread. With ``guard_runs``, which returns whether a guard is running, only a
    guard sends offsets. ``offsets_received`` are those received since the last SYNC. If another master is detected, the
    thread stops the drives and sends nothing more. ``realtime`` requests a real-time priority; ``scheduling`` is what
    was granted.
    """

    def __init__(
        self,
        config: MachineConfig,
        buses: Iterable[str],
        *,
        realtime: bool = False,
        guard_runs: Callable[[], bool] | None = None,
    ) -> None:
        self.config = config
        self.period_s = config.machine.sync_period_s
        self.offsets_by_guard = guard_runs is not None
        self.guard_runs = guard_runs or (lambda: False)
        watches = [BusWatch.create_from_config(name, config, self.guard_runs) for name in buses]
        self.buses = {watch.name: TransmitBus(watch.name, config.bus[watch.name], watch) for watch in watches}
        self.offsets_received: set[int] = set()
        self.members: list[CycleMember] = []
        self.path: SetPointGenerator | None = None
        self.heartbeat: int | None = None
        self.heartbeat_s = config.guard.heartbeat_s
        self.count = 0
        self.lateness = Lateness()
        self.failure: DeviceError | None = None
        self.scheduling = ""
        self._realtime = realtime
        self.lockstep = config.guard.clock == "sync"
        self._sync_counter = 0
        self._sync_overflow: int | None = None
        self._sent_s = 0.0
        self._offsets_before: set[int] = set()
        self._landing: Iterator[bool] | None = None
        self._sync_lands: bool | None = True
        self._heartbeat_due = 0.0
        self._landed = threading.Event()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run_thread, name="fdhil-cycle", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def _run_thread(self) -> None:
        if self._realtime:
            self.scheduling = set_realtime_priority(CYCLE_PRIORITY)
        due = time.monotonic()
        try:
            while not self._stopping.is_set():
                due = self._run_one_cycle(due)
        except DeviceError as error:
            self.failure = error
        finally:
            self._landed.set()

    def _run_one_cycle(self, due: float) -> float:
        """Run one cycle that is due at ``due``; wait for the next deadline and return it."""
        if self.lockstep:
            self._receive_frames()
        if self.foreign_master_bus is None:
            self._send_cycle_frames(due)
        elif self.failure is None:
            self._bring_drives_to_rest(self.foreign_master_bus)
        if not self.lockstep:
            self._receive_frames()
        due += self.period_s
        now = time.monotonic()
        if now > due + self.period_s:  # missed SYNCs are not sent in a burst
            self._count_missed_cycles(int((now - due) / self.period_s))
            due = now
        time.sleep(max(0.0, due - now))
        return due

    def _send_cycle_frames(self, due: float) -> None:
        self._send_heartbeat()
        if self._sync_overflow is not None and self._is_waiting_for_others():
            self.lateness.skipped += 1
        elif self._sync_overflow is not None:
            self._send_sync()
            self.lateness.count_sync(time.monotonic() - due)
            self._send_set_points()

    def _bring_drives_to_rest(self, taken: TransmitBus) -> None:
        """Stop the drives, one SYNC per call; afterwards the thread only listens."""
        led = [member for member in self.members if member.is_led and self.is_producing_sync]
        if self.path is not None:
            self.path.brake_to_rest(f"another master sends {taken.watch.sign} on bus {taken.name}")
        if self._landing is None:
            self._landing = stop_drives(led, lambda: self.path is not None and not self.path.is_resting)
        if led and self._sync_lands:
            self._send_heartbeat()  # without it a braking drive would stop by its watchdog
            self._send_sync()
        self._sync_lands = next(self._landing, None)
        if self._sync_lands:
            self._send_set_points()
        elif self._sync_lands is None:
            written = {each for bus in self.buses.values() for each in bus.watch.written}
            self.failure = taken.watch.build_refusal(describe_outcome(led, written))
            self._landed.set()

    def _count_missed_cycles(self, periods: int) -> None:
        """Hold the path if this computer slept: the drives have stopped by now and must not be jerked on."""
        self.lateness.skipped += periods
        if periods > STALL_CYCLES and self.path is not None and not self.lockstep:
            self.path.hold_last_row(f"this computer was late by {periods} SYNC; reduce its load")

    def _is_waiting_for_others(self) -> bool:
        """Return whether a simulated drive has yet to answer the last SYNC, or a guard to send its offset as before.

        Time is the SYNC count, and the other processes may sleep. One that has not answered within ``LOCKSTEP_WAIT_S``,
        or ``GUARD_WAIT_S``, is ignored until it has answered every SYNC it missed: otherwise one more SYNC than is
        answered would stay in flight for good.
        """
        now = time.monotonic()
        if not self.lockstep or now >= self._sent_s + LOCKSTEP_WAIT_S:
            return False
        if any(member.is_awaited for member in self.members):
            return True
        return bool(self._offsets_before - self.offsets_received) and now < self._sent_s + GUARD_WAIT_S

    def _send_heartbeat(self) -> None:
        now = time.monotonic()
        if self.heartbeat is not None and now >= self._heartbeat_due:
            self._heartbeat_due = now + self.heartbeat_s
            for bus in self.buses.values():
                bus.send(cia402.COB_HEARTBEAT + self.heartbeat, bytes([cia402.Nmt.OPERATIONAL]))

    def _send_sync(self) -> None:
        data = b""
        if self._sync_overflow:
            self._sync_counter = self._sync_counter % self._sync_overflow + 1
            data = bytes([self._sync_counter])
        for bus in self.buses.values():
            if not bus.watch.has_new_sync():  # another master's SYNC replaces ours
                bus.send(cia402.COB_SYNC, data)
        self.count += 1
        self._sent_s = time.monotonic()
        self._offsets_before, self.offsets_received = self.offsets_received, set()

    def _send_set_points(self) -> None:
        path = self.path
        if path is not None:
            targets = path.advance_cycle([member.position for member in self.members])
            for member, target in zip(self.members, targets, strict=True):
                member.target = target
        for member in self.members:
            member.send_set_points()

    def _receive_frames(self) -> None:
        for bus in self.buses.values():
            frames = bus.drain_frames()
            if not frames.size:
                continue
            members = [member for member in self.members if member.bus is bus]
            columns = (frames[name].tolist() for name in ("id", "dlc", "data"))
            for can_id, length, data in zip(*columns, strict=True):
                payload = data.to_bytes(8, "little")[:length]
                for member in members:
                    member.receive_frame(can_id, payload)

    # requests from other threads -----------------------------------------------------------------------------

    def produce_sync(self, overflow: int) -> None:
        """Send SYNC from now on, with a counter up to ``overflow`` (0: without)."""
        self._sync_overflow = overflow

    @property
    def is_producing_sync(self) -> bool:
        """Whether SYNC is sent."""
        return self._sync_overflow is not None

    @property
    def is_running(self) -> bool:
        """Whether set-points are sent."""
        return self.is_producing_sync and not self.is_lost and self._thread.is_alive()

    def stop_sync(self) -> None:
        """Stop sending SYNC and set-points."""
        self._sync_overflow = None

    @property
    def foreign_master_bus(self) -> TransmitBus | None:
        """A bus on which another master was detected; None without one."""
        return next((bus for bus in self.buses.values() if bus.watch.sign is not None), None)

    @property
    def is_lost(self) -> bool:
        """Whether a bus has ended or accepts no frames."""
        return self.failure is not None or any(bus.end_reason is not None for bus in self.buses.values())

    def raise_if_failed(self) -> None:
        """Raise what ended the thread or a bus; with another master only after the drives have stopped."""
        self._await_drives_stopped()
        if self.failure is not None:
            raise self.failure
        for bus in self.buses.values():
            if bus.end_reason is not None:
                raise DeviceError(f"bus {bus.name}", f"{bus.end_reason}; start again when the bus is back")

    def _await_drives_stopped(self) -> None:
        if self.foreign_master_bus is not None and self._thread.is_alive():
            self._landed.wait()

    def close(self) -> None:
        """Stop sending and release the buses; with another master only after the drives have stopped."""
        self._await_drives_stopped()
        self._stopping.set()
        self._thread.join(timeout=2.0)
        for bus in self.buses.values():
            bus.close()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()
