"""The guard's shell: one loop over the bus, the daemon's socket and the signals; all decisions are the core's.

At a SYNC the offset frames leave in the same turn and before anything else is done. Nothing here waits.
"""

from __future__ import annotations

import select
import signal
import socket
import time
from collections import deque
from pathlib import Path as FilePath
from typing import Any

from fdhil.cia402 import COB_HEARTBEAT, COB_SYNC, Nmt, pack
from fdhil.guard import core, table
from fdhil.guard.can_socket import ERROR, BusDown, CanSocket
from fdhil.guard.control import Client, Control
from fdhil.guard.feedforward import FeedMode
from fdhil.guard.frames import Listener
from fdhil.guard.interlocks import FACTS, WITHDRAWABLE, Alarm
from fdhil.guard.journal import Journal, Notifier
from fdhil.guard.path import Path
from fdhil.guard.requests import parse_request
from fdhil.guard.settings import Settings
from fdhil.guard.shadow import Shadow
from fdhil.guard.state import Inputs, Mode, Output, Request, initial

TABLE_NAME = "guard.table"
IDLE_S = 0.05
ROWS_PER_TURN = 64
ROWS_PER_IDLE_TURN = 1024
MAX_RUNNING_PIECE_BYTES = 1 << 18


class Guard:
    """The process; ``run`` returns its exit code: 0 off, 3 when it had to stop with an offset perhaps applied."""

    def __init__(self, settings: Settings, can: CanSocket, journal: Journal, notifier: Notifier) -> None:
        self.settings = settings
        self.state = initial(settings)
        self.control = Control(FilePath(settings.run_directory))
        self._can = can
        self._journal = journal
        self._notifier = notifier
        self._listener = Listener(settings)
        self._entries = [axis.offset.entries for axis in settings.axes]
        self._path: Path | None = None
        self._loading: tuple[table.Loading, Client, dict[str, Any]] | None = None
        self._requests: deque[tuple[Client | None, dict[str, Any], Request]] = deque()
        self._owner: Client | None = None
        self._withdrawn: tuple[Alarm, ...] = ()
        self._transmitted = True
        self._inputs: Inputs | None = None
        self._shadow = Shadow()
        self._last_sync_s = time.monotonic()
        self._stepped_s = 0.0
        self._silent = True
        self._stopping = False
        self._lost_seen = 0
        self.wake, self._signalled = socket.socketpair()

    # --- the loop ---

    def run(self) -> int:
        """Serve until a signal asks to stop and the offset is at zero, or cannot be brought there."""
        self._catch_signals()
        self._notifier.tell("READY=1")
        self._journal.write("ready", bus=self.settings.bus, axes=[axis.name for axis in self.settings.axes])
        while not (self._stopping and not self.state.sending and not self._requests):
            self._turn()
        off = self.state.mode is Mode.OFF
        self._journal.write("stopped", state=self.state.mode.value, offset_um=self._offsets_um())
        self.control.close()
        return 0 if off else 3

    def _turn(self) -> None:
        now_s = time.monotonic()
        self._notifier.alive(now_s)
        ready = self._wait()
        if self._can.fileno() in ready:
            self._bus()
        self._local_timer()
        if self.control.fileno() in ready:
            self.control.accept(time.monotonic())
        for client in self.control.clients:
            if client.fileno() in ready:
                self._client(client)
        self.control.drop_gone()
        if self.wake.fileno() in ready:
            self._stop()
        self._load()

    def _wait(self) -> set[int]:
        poll = select.poll()
        if self._listener.bus_state != "down":
            poll.register(self._can, select.POLLIN)
        poll.register(self.control, select.POLLIN)
        poll.register(self.wake, select.POLLIN)
        for client in self.control.clients:
            poll.register(client, select.POLLIN | (select.POLLOUT if client.outbox else 0))
        busy = self.state.sending or self._requests
        wait_s = 0.0 if self._loading else min(IDLE_S, self.settings.sync_period_s) if busy else IDLE_S
        return {descriptor for descriptor, _ in poll.poll(wait_s * 1000)}

    def _catch_signals(self) -> None:
        self.wake.setblocking(False)
        self._signalled.setblocking(False)
        signal.set_wakeup_fd(self._signalled.fileno(), warn_on_full_buffer=False)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: None)

    def _stop(self) -> None:
        self.wake.recv(64)
        if not self._stopping:
            self._stopping = True
            self._notifier.tell("STOPPING=1")
            self._requests.append((None, {}, Request("stop")))

    # --- the bus ---

    def _bus(self) -> None:
        try:
            frames = self._can.receive()
        except BusDown as error:
            self._bus_down(error)
            return
        self._listener.lost_frames += self._can.lost_frames - self._lost_seen
        self._lost_seen = self._can.lost_frames
        now_s = time.monotonic()
        last_sync = max([k for k, frame in enumerate(frames) if frame[0] == COB_SYNC], default=-1)
        for k, (cob_id, data, stamp_s) in enumerate(frames):
            if cob_id == COB_SYNC:
                self._sync(data, stamp_s, now_s, late=k < last_sync)
            elif cob_id == ERROR:
                self._listener.error(data.decode())
            else:
                self._listener.take(cob_id, data, now_s)

    def _bus_down(self, error: BusDown) -> None:
        self._listener.error("down")
        self._journal.write("bus_down", text=str(error))
        self._in_silence(time.monotonic())

    def _sync(self, data: bytes, stamp_s: float, now_s: float, late: bool) -> None:
        self._last_sync_s, self._silent = now_s, False
        axes, bus = self._listener.at_sync(data, stamp_s, now_s)
        self._advance(Inputs(True, axes, bus), late, now_s)

    def _local_timer(self) -> None:
        """Without SYNC for too long the core steps on the wall clock: it freezes, or ramps an event-driven RPDO."""
        now_s = time.monotonic()
        if now_s - self._last_sync_s <= self.settings.silence_s or self._frames_wait():
            return
        if not self._silent:
            self._silent = True
            self._listener.forget_sync()
        busy = self.state.sending or self._requests
        if busy and now_s - self._stepped_s >= self.settings.sync_period_s:
            self._in_silence(now_s)

    def _frames_wait(self) -> bool:
        """Whether it was this process that slept, and not the bus: then its frames are waiting."""
        if self._listener.bus_state == "down":
            return False
        poll = select.poll()
        poll.register(self._can, select.POLLIN)
        return bool(poll.poll(0))

    def _in_silence(self, now_s: float) -> None:
        """A step without SYNC."""
        axes, bus = self._listener.in_silence(now_s, silent=True)
        self._advance(Inputs(False, axes, bus), late=False, now_s=now_s)

    def _advance(self, seen: Inputs, late: bool, now_s: float) -> None:
        """Run one step of the core and send what it says; answer and journal after that."""
        client, document, request = self._requests.popleft() if self._requests and not late else (None, {}, None)
        arming = request is not None and request.kind in ("arm", "feedforward")
        alive, alarms = self._alive(client if arming else self._owner, now_s), self._listener.alarms()
        told = (late, self._transmitted, alive, alarms, self._withdrawn, self._path, request)
        inputs = Inputs(seen.sync, seen.axes, seen.bus, *told)
        before = self.state.axes
        self.state, output = core.step(self.state, inputs, self.settings)
        self._transmitted = self._send(output)
        self._inputs, self._stepped_s = inputs, now_s
        if inputs.sync:
            self._shadow.follow(self.state, self._path)
        if arming and not output.refused:
            self._owner, self._withdrawn = client, ()
        if output.refused is not None and client is not None:
            self._answer(client, document, output.refused)
        if output.transition is not None and not {*output.transition[:2]} <= {Mode.RAMPING, Mode.ACTIVE}:
            self._tell(*output.transition)
        if output.feed_transition is not None:
            self._tell_feed(*output.feed_transition)
        for own, was, axis in zip(self.settings.axes, before, self.state.axes, strict=True):
            if axis.record_void and not was.record_void:
                self._journal.write("record_void", axis=own.name, text=Alarm("RecordVoid", own.name).sentence())

    def _alive(self, owner: Client | None, now_s: float) -> bool:
        """Whether the daemon that armed is connected and says so often enough."""
        return owner is not None and not owner.gone and now_s - owner.heard_s <= self.settings.daemon_lost_s

    def _send(self, output: Output) -> bool:
        sent = True
        try:
            if output.offsets is not None:
                for axis, entries, offset in zip(self.settings.axes, self._entries, output.offsets, strict=True):
                    sent = self._can.send(axis.offset.cob_id, pack(entries, (offset,))) and sent
            if output.feed is not None:
                for feed, pair in zip(self.settings.feeds, output.feed, strict=True):
                    sent = self._can.send(feed.pdo.cob_id, pack(feed.pdo.entries, pair)) and sent
            if output.heartbeat:
                self._can.send(COB_HEARTBEAT + self.settings.node_id, bytes([Nmt.OPERATIONAL]))
        except BusDown as error:
            self._listener.error("down")
            self._journal.write("bus_down", text=str(error))
            return False
        return sent

    def _tell(self, before: Mode, mode: Mode, cause: Alarm | None) -> None:
        off = mode is Mode.OFF
        told = {"code": cause.code, "axis": cause.axis, "text": cause.sentence(off)} if cause else {}
        self._journal.write(
            "state",
            before=before.value,
            state=mode.value,
            tick=self.state.tick,
            offset_um=self._offsets_um(),
            missed=self.state.missed,
            **told,
        )
        self._notifier.tell(f"STATUS={mode.value}" + (f": {cause.cause}" if cause else ""))

    def _tell_feed(self, before: FeedMode, mode: FeedMode) -> None:
        cause = self.state.feed.cause
        told = {"code": cause.code, "axis": cause.axis, "text": cause.sentence(mode is FeedMode.OFF)} if cause else {}
        self._journal.write("feedforward", before=before.value, state=mode.value, tick=self.state.tick, **told)
        self._notifier.tell(f"STATUS=feed-forward {mode.value}" + (f": {cause.cause}" if cause else ""))

    def _offsets_um(self) -> dict[str, float]:
        """What is applied per axis as far as is known, in the axis' direction."""
        return self._in_um(tuple([axis.offset for axis in self.state.axes]))

    def _in_um(self, offsets: tuple[int, ...]) -> dict[str, float]:
        pairs = zip(self.settings.axes, offsets, strict=True)
        return {s.name: round(s.sign * offset / s.increments_per_mm * 1e3, 3) for s, offset in pairs}

    # --- the daemon ---

    def _client(self, client: Client) -> None:
        client.flush()
        for document in client.read(time.monotonic()):
            kind = document.get("request")
            if kind == "status":
                client.reply(document, ok=True, **self.status())
            elif kind == "alive":
                self._withdraw(client, document)
            elif kind == "table":
                self._begin_loading(client, document)
            elif kind in ("arm", "feedforward", "disarm", "adopt", "compared"):
                self._requests.append((client, document, parse_request(kind, document, self.settings)))
            else:
                text, advice = f"{kind!r} is no request", "use status, alive, table, arm, disarm, adopt or compared"
                client.reply(document, ok=False, code="BadRequest", text=text, advice=advice)

    def _withdraw(self, client: Client, document: dict[str, Any]) -> None:
        """The daemon's keep-alive; what it no longer vouches for ends the correction."""
        facts = document.get("facts")
        if client is self._owner and isinstance(facts, dict):
            self._withdrawn = tuple(Alarm(FACTS[f]) for f in WITHDRAWABLE if f in facts and facts[f] is not True)

    def _answer(self, client: Client, document: dict[str, Any], refused: tuple[Alarm, ...]) -> None:
        if not refused:
            client.reply(document, ok=True, state=self.state.mode.value)
            return
        told = list(map(_told, refused))
        client.reply(document, ok=False, state=self.state.mode.value, **told[0], refused=told)

    def status(self) -> dict[str, Any]:
        """Return what the guard knows, for the daemon's status."""
        state, path, cause = self.state, self._path, self.state.cause or self.state.feed.cause
        shadow = self._shadow.offsets()
        not_good: tuple[Alarm, ...] = (Alarm("SyncLost"),)
        if self._inputs is not None and not self._silent:
            not_good = core.standing(state, self._inputs, self.settings)
        return {
            "state": state.mode.value if state.feed.mode is FeedMode.OFF else "FEEDFORWARD",
            "cause": _told(cause) if cause else None,
            "feedforward": {
                "state": state.feed.mode.value,
                "cause": _told(state.feed.cause) if state.feed.cause else None,
                "limited_cycles": state.feed.limited,
                "applied": {s.name: list(p) for s, p in zip(self.settings.axes, state.feed.applied, strict=False)},
            },
            "sync_heard": not self._silent,
            "tick": state.tick,
            "good_for": state.good_for,
            "row": state.places[0].row if state.places else None,
            "rows": [path.first, path.end] if path else None,
            "table_sequence": path.sequence if path else 0,
            "program_digest": path.program_digest if path else "",
            "offset_um": self._offsets_um(),
            "shadow_um": None if shadow is None else self._in_um(shadow),
            "missed_cycles": state.missed,
            "late_frames": {s.name: a.late_echoes for s, a in zip(self.settings.axes, state.axes, strict=True)},
            "emergencies": self._listener.emergencies,
            "journal_dropped": self._journal.dropped,
            "not_good": [_told(alarm) for alarm in not_good],
            "events": list(self._journal.recent),
        }

    # --- the table ---

    def _begin_loading(self, client: Client, document: dict[str, Any]) -> None:
        running = self.state.sending or self.state.mode is not Mode.OFF
        loaded = self._path
        found = table.read(FilePath(self.settings.run_directory) / TABLE_NAME, loaded.sequence if loaded else 0)
        try:
            if found is None:
                raise table.TableRefused("CorruptFile", "the run directory holds no new valid table; write it again")
            if self._loading is not None or (running and len(found[1]) > MAX_RUNNING_PIECE_BYTES):
                raise table.TableRefused("TableBusy", Alarm("TableBusy").cause)
            keep = self.state.places[0].row - 2 if running and self.state.places else 0
            axes = self.settings.axes
            limits, travel = tuple(axis.limits for axis in axes), tuple(axis.travel for axis in axes)
            loading = table.begin(found[1], found[0], [axis.name for axis in axes], limits, loaded, keep, travel)
            if running and loading.joined.first == 0 and loading.next_row == 0:
                raise table.TableRefused("TableBusy", Alarm("TableBusy").cause)
        except table.TableRefused as refusal:
            self._refuse_table(client, document, refusal)
            return
        self._loading = (loading, client, document)

    def _load(self) -> None:
        """Check the next rows of the table on its way in; a few at a time while frames have to leave in time."""
        if self._loading is None:
            return
        loading, client, document = self._loading
        try:
            loading.check(ROWS_PER_TURN if self.state.sending else ROWS_PER_IDLE_TURN)
        except table.TableRefused as refusal:
            self._loading = None
            self._refuse_table(client, document, refusal)
            return
        if loading.done:
            self._loading, self._path = None, loading.joined
            client.reply(
                document, ok=True, sequence=loading.joined.sequence, rows=[loading.joined.first, loading.joined.end]
            )

    def _refuse_table(self, client: Client, document: dict[str, Any], refusal: table.TableRefused) -> None:
        self._journal.write("table_refused", code=refusal.code, text=str(refusal))
        advice = Alarm(refusal.code).action
        client.reply(document, ok=False, code=refusal.code, text=str(refusal), advice=advice)


def _told(alarm: Alarm) -> dict[str, str]:
    return {"code": alarm.code, "axis": alarm.axis, "text": alarm.cause, "advice": alarm.action}
