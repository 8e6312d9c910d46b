"""Turns the cycle of the buses that fdhil runs itself: SYNC, the set-points that the next SYNC latches, what came.

One thread does it all by absolute deadlines, and everything that is sent in time leaves from its turn, so a program
that hangs sends nothing more: the drives' own watchdogs see that.
"""

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Protocol, Self

from fdhil import cia402
from fdhil.commissioning.bus_watch import BusWatch
from fdhil.commissioning.landing import Landed, land, outcome
from fdhil.commissioning.realtime import CYCLE, prioritise
from fdhil.commissioning.set_points import SetPoints
from fdhil.commissioning.transmit import TransmitBus
from fdhil.config import MachineConfig
from fdhil.errors import DeviceError

LOCKSTEP_WAIT_S = 8.0
GUARD_WAIT_S = 2.0
MOST_CYCLE_US = 20_000
STALL_CYCLES = 20


class Member(Landed, Protocol):
    """A drive that takes part in the cycle."""

    bus: TransmitBus
    target: int | None

    @property
    def awaited(self) -> bool:
        """Whether a simulated drive has yet to answer."""

    @property
    def position(self) -> int | None:
        """Its newest position in increments."""

    def take(self, can_id: int, data: bytes) -> None:
        """Take a frame that was heard on its bus."""

    def send_set_points(self) -> None:
        """Send what the next SYNC latches."""


class Lateness:
    """How late each SYNC left after its deadline, counted by microseconds; ``skipped``: cycles the computer missed."""

    def __init__(self) -> None:
        self.counts = [0] * (MOST_CYCLE_US + 1)
        self.cycles = self.skipped = 0
        self.most_us = 0.0

    def add(self, late_s: float) -> None:
        """Count one SYNC."""
        late_us = max(0.0, late_s * 1e6)
        self.counts[min(int(late_us), MOST_CYCLE_US)] += 1
        self.cycles += 1
        self.most_us = max(self.most_us, late_us)

    def quantile_us(self, share: float) -> float:
        """Return the lateness that this share of the SYNCs kept."""
        wanted, seen = share * self.cycles, 0
        for late_us, count in enumerate(self.counts):
            seen += count
            if seen >= wanted and seen:
                return float(late_us)
        return self.most_us


class Cycle:
    """The thread that runs some buses; a context manager. Nothing is sent before ``produce_sync`` or by the members.

    ``path`` gives the members' set-points while it is there, in their order; ``failure`` is what ended the thread.
    ``guard_runs``: where it is given a guard alone sends offsets, and no member does; it tells whether one is there.
    ``offsets_heard`` are those that came since the last SYNC. Where another master is heard the thread brings the
    drives to rest, and sends no more.
    ``realtime``: it asks for a real-time priority; ``scheduling`` says what it was given.
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
        self.beside_guard = guard_runs is not None
        self.guard_runs = guard_runs or (lambda: False)
        watches = [BusWatch.of(name, config, self.guard_runs) for name in buses]
        self.buses = {watch.name: TransmitBus(watch.name, config.bus[watch.name], watch) for watch in watches}
        self.offsets_heard: set[int] = set()
        self.members: list[Member] = []
        self.path: SetPoints | None = None
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
        self._thread = threading.Thread(target=self._run, name="fdhil-cycle", daemon=True)

    def start(self) -> None:
        """Begin to turn."""
        self._thread.start()

    def _run(self) -> None:
        if self._realtime:
            self.scheduling = prioritise(CYCLE)
        due = time.monotonic()
        try:
            while not self._stopping.is_set():
                due = self._turn(due)
        except DeviceError as error:
            self.failure = error
        finally:
            self._landed.set()

    def _turn(self, due: float) -> float:
        """Send what is due at ``due``, take what came, and return the next deadline after having waited for it."""
        if self.lockstep:
            self._receive()
        if self.taken is None:
            self._send_in_time(due)
        elif self.failure is None:
            self._land(self.taken)
        if not self.lockstep:
            self._receive()
        due += self.period_s
        now = time.monotonic()
        if now > due + self.period_s:  # no SYNC is sent twice as fast to catch up
            self._missed(int((now - due) / self.period_s))
            due = now
        time.sleep(max(0.0, due - now))
        return due

    def _send_in_time(self, due: float) -> None:
        self._send_heartbeat()
        if self._sync_overflow is not None and self._awaits_others():
            self.lateness.skipped += 1
        elif self._sync_overflow is not None:
            self._send_sync()
            self.lateness.add(time.monotonic() - due)
            self._send_set_points()

    def _land(self, taken: TransmitBus) -> None:
        """Send what brings the drives to rest by one SYNC more; afterwards the thread only listens."""
        led = [member for member in self.members if member.led and self.producing]
        if self.path is not None:
            self.path.stop(f"another master sends {taken.watch.sign} on bus {taken.name}")
        if self._landing is None:
            self._landing = land(led, lambda: self.path is not None and not self.path.resting)
        if led and self._sync_lands:
            self._send_heartbeat()  # a drive that misses it while it brakes stops by itself
            self._send_sync()
        self._sync_lands = next(self._landing, None)
        if self._sync_lands:
            self._send_set_points()
        elif self._sync_lands is None:
            written = {each for bus in self.buses.values() for each in bus.watch.written}
            self.failure = taken.watch.refusal(outcome(led, written))
            self._landed.set()

    def _missed(self, periods: int) -> None:
        """This computer slept; drives that stand at their last set-point by now are not jerked on."""
        self.lateness.skipped += periods
        if periods > STALL_CYCLES and self.path is not None and not self.lockstep:
            self.path.hold(f"this computer was late by {periods} SYNC; take load off it")

    def _awaits_others(self) -> bool:
        """Whether a simulated drive has yet to answer the last SYNC, or a guard to send its offset, as it did before.

        Their processes may sleep, and time is the SYNC count. One that has not answered in ``LOCKSTEP_WAIT_S``, or
        ``GUARD_WAIT_S``, is not waited for until it answers again, and then until it has answered all that it slept
        through: else there would be one SYNC on the way more than is answered, for good.
        """
        now = time.monotonic()
        if not self.lockstep or now >= self._sent_s + LOCKSTEP_WAIT_S:
            return False
        if any(member.awaited for member in self.members):
            return True
        return bool(self._offsets_before - self.offsets_heard) and now < self._sent_s + GUARD_WAIT_S

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
            if not bus.watch.sync_came():  # one of another master is as good, and two are one too many
                bus.send(cia402.COB_SYNC, data)
        self.count += 1
        self._sent_s = time.monotonic()
        self._offsets_before, self.offsets_heard = self.offsets_heard, set()

    def _send_set_points(self) -> None:
        path = self.path
        if path is not None:
            targets = path.step([member.position for member in self.members])
            for member, target in zip(self.members, targets, strict=True):
                member.target = target
        for member in self.members:
            member.send_set_points()

    def _receive(self) -> None:
        for bus in self.buses.values():
            frames = bus.drain()
            if not frames.size:
                continue
            members = [member for member in self.members if member.bus is bus]
            columns = (frames[name].tolist() for name in ("id", "dlc", "data"))
            for can_id, length, data in zip(*columns, strict=True):
                payload = data.to_bytes(8, "little")[:length]
                for member in members:
                    member.take(can_id, payload)

    # what is asked of it --------------------------------------------------------------------------------------

    def produce_sync(self, overflow: int) -> None:
        """Send SYNC from now on, with a counter up to ``overflow`` (0: without)."""
        self._sync_overflow = overflow

    @property
    def producing(self) -> bool:
        """Whether SYNC is being sent."""
        return self._sync_overflow is not None

    @property
    def turning(self) -> bool:
        """Whether set-points leave."""
        return self.producing and not self.lost and self._thread.is_alive()

    def stop_sync(self) -> None:
        """Send SYNC and set-points no more."""
        self._sync_overflow = None

    @property
    def taken(self) -> TransmitBus | None:
        """A bus on which another master was heard, None where there is none."""
        return next((bus for bus in self.buses.values() if bus.watch.sign is not None), None)

    @property
    def lost(self) -> bool:
        """Whether a bus has ended, or takes nothing more."""
        return self.failure is not None or any(bus.ended is not None for bus in self.buses.values())

    def check(self) -> None:
        """Raise what ended the thread or a bus; beside another master that is done when the drives are at rest."""
        self._await_landing()
        if self.failure is not None:
            raise self.failure
        for bus in self.buses.values():
            if bus.ended is not None:
                raise DeviceError(f"bus {bus.name}", f"{bus.ended}; start again when the bus is back")

    def _await_landing(self) -> None:
        if self.taken is not None and self._thread.is_alive():
            self._landed.wait()

    def close(self) -> None:
        """Stop sending and release the buses; where another master was heard the drives are at rest before."""
        self._await_landing()
        self._stopping.set()
        self._thread.join(timeout=2.0)
        for bus in self.buses.values():
            bus.close()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()
