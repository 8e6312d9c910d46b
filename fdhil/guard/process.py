"""Runs the guard's one loop over the bus, the daemon's socket and the signals; the core makes all decisions.

At a SYNC the offset frames leave in the same turn, before anything else. Nothing here waits for a client: after each
request the clients pause, so that however many requests they send, every SYNC finds the loop waiting.
"""

import select
import socket
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from fdhil.cia402 import COB_HEARTBEAT, COB_SYNC, Nmt, pack
from fdhil.guard import core, status
from fdhil.guard.can_socket import ERROR, BusDown, CanSocket
from fdhil.guard.control import Client, Control
from fdhil.guard.frames import Listener
from fdhil.guard.intake import Intake
from fdhil.guard.interlocks import FACTS, WITHDRAWABLE, Alarm
from fdhil.guard.journal import Journal, Notifier
from fdhil.guard.landing import land
from fdhil.guard.peers import Access, Peer
from fdhil.guard.protocol import FeedMode, Mode
from fdhil.guard.requests import Document, parse_request
from fdhil.guard.settings import Settings
from fdhil.guard.shadow import Shadow
from fdhil.guard.state import Inputs, Output, Request, initial
from fdhil.guard.turn_times import TurnTimes

IDLE_S = 0.05
REST_S = 0.001
RESTORE_S = 0.5
REFUSED_S = 1.0  # one journal line for all refusals in that time: they cannot fill it
DECIDED = ("arm", "feedforward", "disarm", "adopt", "compared")


class Guard:
    """The process; ``run`` returns its exit code: 0 when certainly no offset is applied, 3 otherwise.

    ``wake`` becomes readable when a signal requests a stop. The journal's clock is also the clock of the loop.
    """

    def __init__(
        self, settings: Settings, can: CanSocket, journal: Journal, notifier: Notifier, wake: socket.socket
    ) -> None:
        self._now_s = journal.clock.now_s
        self.settings = settings
        self.state = initial(settings)
        access = Access(settings.daemon_uid, settings.watching)
        self.control = Control(Path(settings.run_directory), access, self._tell_refused)
        self.intake = Intake(settings, journal)
        self._can = can
        self._journal = journal
        self._notifier = notifier
        self._listener = Listener(settings)
        self._turns = TurnTimes(settings)
        self._entries = [axis.offset.entries for axis in settings.axes]
        self._requests: deque[tuple[Client | None, Document, Request]] = deque()
        self._disarms = 0
        self._owner: Client | None = None
        self._withdrawn: tuple[Alarm, ...] = ()
        self._unsent: tuple[int, ...] = ()
        self._unfed: tuple[int, ...] = ()
        self._inputs: Inputs | None = None
        self._shadow = Shadow()
        self._last_sync_s = self._now_s()
        self._stepped_s = 0.0
        self._rested_s = 0.0
        self._silent, self._put_off = True, False
        self._stopping = False
        self._lost = ""
        self._lost_seen = 0
        self._restore_s = 0.0
        self._refused_s, self._refused = -REFUSED_S, 0
        self._wake = wake

    # --- the loop ---

    def run(self) -> int:
        """Serve until a signal requests a stop and the offset is zero or cannot be ramped to zero."""
        self.begin()
        while (code := self.turn()) is None:
            pass
        return code

    def begin(self) -> None:
        """Report that the loop is ready."""
        self._notifier.tell("READY=1")
        self._journal.write("ready", bus=self.settings.bus, axes=[axis.name for axis in self.settings.axes])

    def turn(self) -> int | None:
        """Run one turn of the loop; return the exit code when it was the last one, None otherwise."""
        try:
            if self.state.sending or self._requests or not self._stopping:
                self._turn()
                return None
        except Exception as error:  # noqa: BLE001 - the guard's supervisor: whatever failed, the offset goes to zero
            self._failed(error)
            return 3
        standing_um = status.may_stand_um(self.state, self.settings)
        self._stopped(standing_um, status.offset_um(self.state, self.settings))
        return 3 if self.state.feed.may_stand or any(um != 0 for um in standing_um.values()) else 0

    def _failed(self, error: Exception) -> None:
        """Ramp to zero from the last sent offset without serving any client; journal the error."""
        cause = Alarm("InternalError", detail=f"{type(error).__name__}: {error}"[:200])
        effect = "the offset is ramped to zero from what was sent last, and the guard ends"
        text = f"{cause.cause}; {effect}; {cause.action}"
        self._journal.write("failed", code=cause.code, state=self.state.mode.value, text=text)
        self._notifier.tell("STOPPING=1")
        sending, clock = self.state.sending, self._journal.clock
        sent = land(self.state, self._unsent, self.settings, self._can, clock)
        standing_um = status.may_stand_um(self.state, self.settings)
        if sending:  # nothing was read back during the ramp
            standing_um = dict.fromkeys(standing_um)
        self._stopped(standing_um, status.in_um(sent, self.settings))

    def _stopped(self, standing_um: Mapping[str, float | None], sent_um: Mapping[str, float | None]) -> None:
        left = status.sentence(standing_um, self.state.feed)
        text = {"text": f"the guard has stopped; {left}; hold the feed, start it again and adopt"} if left else {}
        state = self.state.mode.value
        self._journal.write("stopped", state=state, offset_um=sent_um, may_stand_um=standing_um, **text)
        self.control.close()
        self._notifier.close()
        self._can.close()

    def _turn(self) -> None:
        now_s = self._now_s()
        self._notifier.alive(now_s)
        rest_s = self._rested_s - now_s
        ready = self._wait(rest_s)
        if self._can.fileno() in ready:
            self._bus()
        elif self._listener.bus_state == "down":
            self._restore(now_s)
        self._local_timer()
        if self._wake.fileno() in ready:
            self._stop()
        if self.control.lost != self._lost:
            self._unreachable()
        if rest_s <= 0:
            self._serve(ready - {self._can.fileno(), self._wake.fileno()})

    def _unreachable(self) -> None:
        """Ramp to zero when the control socket has no file: no client could request it any more."""
        self._lost = self.control.lost
        if self._lost:
            text = (
                f"the control socket is gone and cannot be created again ({self._lost}): the offset is ramped to zero"
            )
            self._journal.write("unreachable", text=f"{text}; restore the run directory")
            self._requests.append((None, {}, Request("disarm")))

    def _wait(self, rest_s: float) -> set[int]:
        """Wait for the bus and for signals; for the clients too, unless they pause."""
        poll = self._journal.clock.new_poll()
        poll.register(self._wake, select.POLLIN)
        if self._listener.bus_state != "down":
            poll.register(self._can, select.POLLIN)
        busy = self.state.sending or self._requests
        wait_s = min(IDLE_S, self.settings.sync_period_s) if busy else IDLE_S
        if rest_s > 0:
            wait_s = min(wait_s, rest_s)
        else:
            self.control.register(poll)
            wait_s = 0.0 if self.intake.busy or self.control.pending else wait_s
        return {descriptor for descriptor, _ in poll.poll(wait_s * 1000)}

    def _stop(self) -> None:
        self._wake.recv(64)
        if not self._stopping:
            self._stopping = True
            self._notifier.tell("STOPPING=1")
            for waits in list(self._requests):
                owner, asked, other = waits
                if owner is not None and other.kind != "disarm":
                    self._requests.remove(waits)
                    self._answer(owner, asked, (Alarm("Stopped"),))
            self._requests.append((None, {}, Request("stop")))

    # --- the bus ---

    def _bus(self) -> None:
        try:
            frames = self._can.receive()
        except BusDown as error:
            self._bus_down(error)
            self._in_silence(self._now_s())
            return
        self._listener.lost_frames += self._can.lost_frames - self._lost_seen
        self._lost_seen = self._can.lost_frames
        now_s = self._now_s()
        newer = sum(frame[0] == COB_SYNC for frame in frames)
        for cob_id, data, stamp_s in frames:
            if cob_id == COB_SYNC:
                newer -= 1
                self._sync(data, stamp_s, now_s, late=newer > self.settings.lead // 2)
            elif cob_id == ERROR:
                self._listener.error(data.decode())
            else:
                self._listener.take(cob_id, data, now_s)

    def _bus_down(self, error: BusDown) -> None:
        self._listener.error("down")
        self._journal.write("bus_down", text=str(error))

    def _restore(self, now_s: float) -> None:
        """Check periodically whether a lost bus is back; what the drives hold by then is unknown."""
        if now_s < self._restore_s:
            return
        self._restore_s = now_s + RESTORE_S
        if self._can.restored():
            self._listener.error("restarted")
            self._listener.forget_sync()
            self._journal.write(
                "bus_restored", text="the CAN bus is back; an offset may be applied; hold the feed, then adopt"
            )

    def _sync(self, data: bytes, stamp_s: float, now_s: float, late: bool) -> None:
        self._last_sync_s, self._silent, self._put_off = now_s, False, False
        axes, bus = self._listener.at_sync(data, stamp_s, now_s)
        self._advance(Inputs(True, axes, bus), late, now_s)
        clock, stamped = self._journal.clock, self.settings.transport == "can_raw"  # a hub may have another clock
        self._turns.add(clock.wall_s() - stamp_s if stamped else clock.now_s() - now_s, late, now_s)

    def _local_timer(self) -> None:
        """Without SYNC for too long, step on the wall clock: freeze, or ramp an event-driven RPDO."""
        now_s = self._now_s()
        if now_s - self._last_sync_s <= self.settings.silence_s:
            return
        if not self._put_off and self._frames_wait():
            self._put_off = True  # once: a babbling node cannot hide that SYNC is missing
            return
        if not self._silent:
            self._silent = True
            self._listener.forget_sync()
        busy = self.state.sending or self._requests
        if busy and now_s - self._stepped_s >= self.settings.sync_period_s:
            self._in_silence(now_s)

    def _frames_wait(self) -> bool:
        """Return whether frames are waiting: then this process was suspended, the bus was not silent."""
        if self._listener.bus_state == "down":
            return False
        poll = self._journal.clock.new_poll()
        poll.register(self._can, select.POLLIN)
        return bool(poll.poll(0))

    def _in_silence(self, now_s: float) -> None:
        axes, bus = self._listener.in_silence(now_s, silent=True)
        self._advance(Inputs(False, axes, bus), late=False, now_s=now_s)

    def _advance(self, seen: Inputs, late: bool, now_s: float) -> None:
        """Run one step of the core and send its output; then answer and journal."""
        client, document, request = self._requests.popleft() if self._requests and not late else (None, {}, None)
        arming = request is not None and request.kind in ("arm", "feedforward")
        taking_over = arming and not self.state.sending
        in_charge, withdrawn = (client, ()) if taking_over else (self._owner, self._withdrawn)
        alive, alarms = self._alive(in_charge, now_s), self._listener.alarms()
        events = (late, self._unsent, self._unfed, alive, alarms, withdrawn, self.intake.path, request)
        inputs = Inputs(seen.sync, seen.axes, seen.bus, *events)
        before = self.state.axes
        self.state, output = core.step(self.state, inputs, self.settings)
        self._send(output)
        self._inputs, self._stepped_s = inputs, now_s
        if inputs.sync:
            self._shadow.follow(self.state, self.intake.path)
        if arming and not output.refused:
            self._own(client)
            self._turns.begin()
        if output.refused is not None and client is not None:
            self._answer(client, document, output.refused)
        disarmed_by = client.peer if client is not None and request is not None and request.kind == "disarm" else None
        by = {"uid": disarmed_by.uid, "pid": disarmed_by.pid} if disarmed_by is not None else {}
        if output.transition is not None and not {*output.transition[:2]} <= {Mode.RAMPING, Mode.ACTIVE}:
            self._explain(now_s)
            self._tell(*output.transition[:2], self.state.cause, by)
        if output.feed_transition is not None:
            self._tell_feed(*output.feed_transition, by)
        for own, was, axis in zip(self.settings.axes, before, self.state.axes, strict=True):
            if axis.record_void and not was.record_void:
                self._journal.write("record_void", axis=own.name, text=Alarm("RecordVoid", own.name).sentence())

    def _explain(self, now_s: float) -> None:
        cause = self.state.cause
        if cause is not None and not cause.late and (late := self._turns.blame(cause.code, now_s)):
            self.state = self.state._replace(cause=replace(cause, late=late))

    def _alive(self, owner: Client | None, now_s: float) -> bool:
        return owner is not None and not owner.gone and now_s - owner.heard_s <= self.settings.daemon_lost_s

    def _own(self, client: Client | None) -> None:
        for each in self.control.clients:
            each.armed = each is client
        self._owner, self._withdrawn = client, ()

    def _send(self, output: Output) -> None:
        axes = zip(self.settings.axes, self._entries, output.offsets or (), strict=output.offsets is not None)
        counter = self._listener.counter
        frames = [(axis.offset.cob_id, pack(e, (offset, counter)[: len(e)])) for axis, e, offset in axes]
        self._unsent = self._sent(frames)
        feeds = zip(self.settings.feeds, output.feed or (), strict=output.feed is not None)
        self._unfed = self._sent([(feed.pdo.cob_id, pack(feed.pdo.entries, pair)) for feed, pair in feeds])
        if output.heartbeat:
            self._sent([(COB_HEARTBEAT + self.settings.node_id, bytes([Nmt.OPERATIONAL]))])

    def _sent(self, frames: Sequence[tuple[int, bytes]]) -> tuple[int, ...]:
        """Send frames; return the indices of those that did not leave. On a dead bus none is tried."""
        unsent = []
        for k, (cob_id, data) in enumerate(frames):
            try:
                left = self._listener.bus_state != "down" and self._can.send(cob_id, data)
            except BusDown as error:
                self._bus_down(error)
                left = False
            if not left:
                unsent.append(k)
        return tuple(unsent)

    def _tell(self, before: Mode, mode: Mode, cause: Alarm | None, by: Mapping[str, int]) -> None:
        """Journal a change of state; ``by`` names the client whose disarm caused it."""
        standing_um = status.may_stand_um(self.state, self.settings)
        off = mode is Mode.OFF and not status.sentence(standing_um)
        described = {"code": cause.code, "axis": cause.axis, "text": cause.sentence(off)} if cause else {}
        self._journal.write(
            "state",
            before=before.value,
            state=mode.value,
            tick=self.state.tick,
            offset_um=status.offset_um(self.state, self.settings),
            may_stand_um=standing_um,
            missed=self.state.missed,
            **described,
            **by,
        )
        self._notifier.tell(f"STATUS={mode.value}" + (f": {cause.cause}" if cause else ""))

    def _tell_feed(self, before: FeedMode, mode: FeedMode, by: Mapping[str, int]) -> None:
        feed, cause = self.state.feed, self.state.feed.cause
        entry = {"code": cause.code, "axis": cause.axis, "text": cause.sentence(mode is FeedMode.OFF)} if cause else {}
        if feed.unconfirmed:
            entry["text"] = f"{status.FED}; hold the feed, then run fdhil adopt"
        self._journal.write("feedforward", before=before.value, state=mode.value, tick=self.state.tick, **entry, **by)
        self._notifier.tell(f"STATUS=feed-forward {mode.value}" + (f": {cause.cause}" if cause else ""))

    # --- the clients ---

    def _serve(self, ready: set[int]) -> None:
        """Serve one client and check some rows of a table; then pause both, and wait for the bus alone."""
        if not (ready or self.control.pending or self.intake.busy):
            return
        served = self.control.serve(ready, self._now_s())
        if served is not None:
            self._request(*served)
            served[0].settle()
        self.control.drop_gone()
        self.intake.check(self.state)
        self._rested_s = self._now_s() + REST_S

    def _request(self, client: Client, document: Document) -> None:
        kind = document.get("request")
        if not client.peer.may(kind):
            client.reply(document, ok=False, **client.peer.refused(kind))
            self._tell_refused(client.peer, kind)
        elif kind == "status":
            client.reply(document, ok=True, **self.status())
        elif kind == "alive":
            self._withdraw(client, document)
        elif kind == "table":
            self.intake.begin(client, document, self.state)
        elif kind in DECIDED:
            self._queue(client, document, parse_request(kind, document, self.settings))
        else:
            text = f"{kind[:40]!r} is an unknown request" if isinstance(kind, str) else "the request has no name"
            client.reply(document, ok=False, code="BadRequest", text=text, advice=f"use one of {', '.join(DECIDED)}")

    def _queue(self, client: Client, document: Document, request: Request) -> None:
        """Queue a request for the next step; each client has one waiting at most, but a disarm replaces all others.

        A request with another count of ``disarms`` was made before the last disarm and is refused. Of clients that have
        disconnected one disarm is kept, however many sent one.
        """
        disarms = request.kind == "disarm"
        if disarms:
            self._disarms += 1
        elif document.get("disarms", self._disarms) != self._disarms:
            self._answer(client, document, (Alarm("DisarmedSince"),))
            return
        elif self._stopping:
            self._answer(client, document, (Alarm("Stopped"),))
            return
        elif request.kind in ("arm", "feedforward") and (late := self._turns.refusal()):
            self._answer(client, document, (Alarm("PcLate", detail=late),))
            return
        for waits in list(self._requests):
            owner, asked, other = waits
            if owner is None:
                continue
            if disarms and other.kind != "disarm":
                self._answer(owner, asked, (Alarm("DisarmedSince"),))
                self._requests.remove(waits)
            elif owner.gone and (disarms or other.kind != "disarm"):
                self._requests.remove(waits)
        if any(waits[0] is client for waits in self._requests):
            self._answer(client, document, (Alarm("GuardBusy"),))
        else:
            self._requests.append((client, document, request))

    def _withdraw(self, client: Client, document: Document) -> None:
        """Take the daemon's keep-alive; a fact that it no longer attests ends the correction."""
        facts = document.get("facts")
        if client is self._owner and isinstance(facts, dict):
            self._withdrawn = tuple(Alarm(FACTS[f]) for f in WITHDRAWABLE if f in facts and facts[f] is not True)

    def _answer(self, client: Client, document: Document, refused: tuple[Alarm, ...]) -> None:
        if not refused:
            client.reply(document, ok=True, state=self.state.mode.value)
            if document["request"] != "disarm":
                self._journal.write("granted", request=document["request"], uid=client.peer.uid, pid=client.peer.pid)
            return
        if Alarm("AuthRequired") in refused:
            self._tell_refused(client.peer, document["request"])
        alarms = list(map(status.told, refused))
        client.reply(document, ok=False, state=self.state.mode.value, **alarms[0], refused=alarms)

    def _tell_refused(self, peer: Peer, kind: object) -> None:
        """Journal who requested what they may not; ``times`` counts all refusals since the line before."""
        self._refused, now_s = self._refused + 1, self._now_s()
        if now_s - self._refused_s >= REFUSED_S:
            requested = str(kind)[:40] if kind else "to talk"
            self._journal.write(
                "refused", code="AuthRequired", request=requested, uid=peer.uid, pid=peer.pid, times=self._refused
            )
            self._refused_s, self._refused = now_s, 0

    def status(self) -> dict[str, Any]:
        """Return the guard's status, for the daemon."""
        shadow = self._shadow.offsets()
        not_good: tuple[Alarm, ...] = (Alarm("SyncLost"),)
        if self._inputs is not None and not self._silent:
            not_good = core.standing(self.state, self._inputs, self.settings)
        return {
            **status.document(self.state, self.settings, self.intake.path, not_good),
            "sync_heard": not self._silent,
            "shadow_um": None if shadow is None else status.in_um(shadow, self.settings),
            "emergencies": self._listener.emergencies,
            "journal_dropped": self._journal.dropped,
            "lateness": self._turns.document(),
            "disarms": self._disarms,
            "events": list(self._journal.recent),
        }
