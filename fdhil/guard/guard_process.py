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

from fdhil.cia402 import COB_HEARTBEAT, COB_SYNC, Nmt, pack_pdo
from fdhil.guard import guard_status, guard_step
from fdhil.guard.can_socket import ERROR, BusDown, CanSocket
from fdhil.guard.emergency_ramp import ramp_to_zero
from fdhil.guard.event_journal import EventJournal, SystemdNotifier
from fdhil.guard.frame_monitor import FrameMonitor
from fdhil.guard.guard_access import ClientProcess, GuardAccess
from fdhil.guard.guard_protocol import FeedMode, Mode
from fdhil.guard.guard_settings import GuardSettings
from fdhil.guard.guard_socket import GuardSocketClient, GuardSocketServer
from fdhil.guard.guard_state import GuardRequest, StepInputs, StepOutput, make_initial_state
from fdhil.guard.interlocks import FACTS, WITHDRAWABLE, Alarm
from fdhil.guard.request_parsing import Document, parse_request
from fdhil.guard.shadow_correction import ShadowCorrection
from fdhil.guard.table_intake import TableIntake
from fdhil.guard.turn_lateness import TurnLateness

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
        self,
        settings: GuardSettings,
        can: CanSocket,
        journal: EventJournal,
        notifier: SystemdNotifier,
        wake: socket.socket,
    ) -> None:
        self._now_s = journal.clock.now_s
        self.settings = settings
        self.state = make_initial_state(settings)
        access = GuardAccess(settings.daemon_uid, settings.watching)
        self.control = GuardSocketServer(Path(settings.run_directory), access, self._log_refused_access)
        self.intake = TableIntake(settings, journal)
        self._can = can
        self._journal = journal
        self._notifier = notifier
        self._listener = FrameMonitor(settings)
        self._turns = TurnLateness(settings)
        self._entries = [axis.offset.entries for axis in settings.axes]
        self._requests: deque[tuple[GuardSocketClient | None, Document, GuardRequest]] = deque()
        self._disarms = 0
        self._owner: GuardSocketClient | None = None
        self._withdrawn: tuple[Alarm, ...] = ()
        self._unsent: tuple[int, ...] = ()
        self._unfed: tuple[int, ...] = ()
        self._inputs: StepInputs | None = None
        self._shadow = ShadowCorrection()
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
        self.report_ready()
        while (code := self.run_turn()) is None:
            pass
        return code

    def report_ready(self) -> None:
        """Report that the loop is ready."""
        self._notifier.notify_systemd("READY=1")
        self._journal.write("ready", bus=self.settings.bus, axes=[axis.name for axis in self.settings.axes])

    def run_turn(self) -> int | None:
        """Run one turn of the loop; return the exit code when it was the last one, None otherwise."""
        try:
            if self.state.sending or self._requests or not self._stopping:
                self._serve_sockets()
                return None
        except Exception as error:  # noqa: BLE001 - the guard's supervisor: whatever failed, the offset goes to zero
            self._ramp_after_failure(error)
            return 3
        standing_um = guard_status.get_applied_offset_um(self.state, self.settings)
        self._report_stopped(standing_um, guard_status.get_sent_offset_um(self.state, self.settings))
        return 3 if self.state.feed.may_stand or any(um != 0 for um in standing_um.values()) else 0

    def _ramp_after_failure(self, error: Exception) -> None:
        """Ramp to zero from the last sent offset without serving any client; journal the error."""
        cause = Alarm("InternalError", detail=f"{type(error).__name__}: {error}"[:200])
        effect = "the offset is ramped to zero from what was sent last, and the guard ends"
        text = f"{cause.cause}; {effect}; {cause.action}"
        self._journal.write("failed", code=cause.code, state=self.state.mode.value, text=text)
        self._notifier.notify_systemd("STOPPING=1")
        sending, clock = self.state.sending, self._journal.clock
        sent = ramp_to_zero(self.state, self._unsent, self.settings, self._can, clock)
        standing_um = guard_status.get_applied_offset_um(self.state, self.settings)
        if sending:  # nothing was read back during the ramp
            standing_um = dict.fromkeys(standing_um)
        self._report_stopped(standing_um, guard_status.convert_to_um(sent, self.settings))

    def _report_stopped(self, standing_um: Mapping[str, float | None], sent_um: Mapping[str, float | None]) -> None:
        left = guard_status.describe_applied_offset(standing_um, self.state.feed)
        text = {"text": f"the guard has stopped; {left}; hold the feed, start it again and adopt"} if left else {}
        state = self.state.mode.value
        self._journal.write("stopped", state=state, offset_um=sent_um, may_stand_um=standing_um, **text)
        self.control.close()
        self._notifier.close()
        self._can.close()

    def _serve_sockets(self) -> None:
        now_s = self._now_s()
        self._notifier.feed_watchdog(now_s)
        rest_s = self._rested_s - now_s
        ready = self._wait_for_sockets(rest_s)
        if self._can.fileno() in ready:
            self._receive_frames()
        elif self._listener.bus_state == "down":
            self._restore_bus(now_s)
        self._step_without_sync()
        if self._wake.fileno() in ready:
            self._request_stop()
        if self.control.lost != self._lost:
            self._disarm_without_socket()
        if rest_s <= 0:
            self._serve_clients(ready - {self._can.fileno(), self._wake.fileno()})

    def _disarm_without_socket(self) -> None:
        """Ramp to zero when the control socket has no file: no client could request it any more."""
        self._lost = self.control.lost
        if self._lost:
            text = (
                f"the control socket is gone and cannot be created again ({self._lost}): the offset is ramped to zero"
            )
            self._journal.write("unreachable", text=f"{text}; restore the run directory")
            self._requests.append((None, {}, GuardRequest("disarm")))

    def _wait_for_sockets(self, rest_s: float) -> set[int]:
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
            self.control.register_sockets(poll)
            wait_s = 0.0 if self.intake.busy or self.control.pending else wait_s
        return {descriptor for descriptor, _ in poll.poll(wait_s * 1000)}

    def _request_stop(self) -> None:
        self._wake.recv(64)
        if not self._stopping:
            self._stopping = True
            self._notifier.notify_systemd("STOPPING=1")
            for waits in list(self._requests):
                owner, asked, other = waits
                if owner is not None and other.kind != "disarm":
                    self._requests.remove(waits)
                    self._answer_request(owner, asked, (Alarm("Stopped"),))
            self._requests.append((None, {}, GuardRequest("stop")))

    # --- the bus ---

    def _receive_frames(self) -> None:
        try:
            frames = self._can.receive()
        except BusDown as error:
            self._report_bus_down(error)
            self._step_in_silence(self._now_s())
            return
        self._listener.lost_frames += self._can.lost_frames - self._lost_seen
        self._lost_seen = self._can.lost_frames
        now_s = self._now_s()
        newer = sum(frame[0] == COB_SYNC for frame in frames)
        for cob_id, data, stamp_s in frames:
            if cob_id == COB_SYNC:
                newer -= 1
                self._step_at_sync(data, stamp_s, now_s, late=newer > self.settings.lead // 2)
            elif cob_id == ERROR:
                self._listener.set_controller_state(data.decode())
            else:
                self._listener.take_frame(cob_id, data, now_s)

    def _report_bus_down(self, error: BusDown) -> None:
        self._listener.set_controller_state("down")
        self._journal.write("bus_down", text=str(error))

    def _restore_bus(self, now_s: float) -> None:
        """Check periodically whether a lost bus is back; what the drives hold by then is unknown."""
        if now_s < self._restore_s:
            return
        self._restore_s = now_s + RESTORE_S
        if self._can.try_restore():
            self._listener.set_controller_state("restarted")
            self._listener.forget_sync()
            self._journal.write(
                "bus_restored", text="the CAN bus is back; an offset may be applied; hold the feed, then adopt"
            )

    def _step_at_sync(self, data: bytes, stamp_s: float, now_s: float, late: bool) -> None:
        self._last_sync_s, self._silent, self._put_off = now_s, False, False
        axes, bus = self._listener.receive_at_sync(data, stamp_s, now_s)
        self._advance_core(StepInputs(True, axes, bus), late, now_s)
        clock, stamped = self._journal.clock, self.settings.transport == "can_raw"  # a hub may have another clock
        self._turns.count_turn(clock.wall_s() - stamp_s if stamped else clock.now_s() - now_s, late, now_s)

    def _step_without_sync(self) -> None:
        """Without SYNC for too long, step on the wall clock: freeze, or ramp an event-driven RPDO."""
        now_s = self._now_s()
        if now_s - self._last_sync_s <= self.settings.silence_s:
            return
        if not self._put_off and self._has_waiting_frames():
            self._put_off = True  # once: a babbling node cannot hide that SYNC is missing
            return
        if not self._silent:
            self._silent = True
            self._listener.forget_sync()
        busy = self.state.sending or self._requests
        if busy and now_s - self._stepped_s >= self.settings.sync_period_s:
            self._step_in_silence(now_s)

    def _has_waiting_frames(self) -> bool:
        """Return whether frames are waiting: then this process was suspended, the bus was not silent."""
        if self._listener.bus_state == "down":
            return False
        poll = self._journal.clock.new_poll()
        poll.register(self._can, select.POLLIN)
        return bool(poll.poll(0))

    def _step_in_silence(self, now_s: float) -> None:
        axes, bus = self._listener.read_between_syncs(now_s, silent=True)
        self._advance_core(StepInputs(False, axes, bus), late=False, now_s=now_s)

    def _advance_core(self, seen: StepInputs, late: bool, now_s: float) -> None:
        """Run one step of the core and send its output; then answer and journal."""
        client, document, request = self._requests.popleft() if self._requests and not late else (None, {}, None)
        arming = request is not None and request.kind in ("arm", "feedforward")
        taking_over = arming and not self.state.sending
        in_charge, withdrawn = (client, ()) if taking_over else (self._owner, self._withdrawn)
        alive, alarms = self._is_daemon_alive(in_charge, now_s), self._listener.take_alarms()
        events = (late, self._unsent, self._unfed, alive, alarms, withdrawn, self.intake.path, request)
        inputs = StepInputs(seen.sync, seen.axes, seen.bus, *events)
        before = self.state.axes
        self.state, output = guard_step.step_guard(self.state, inputs, self.settings)
        self._send_output(output)
        self._inputs, self._stepped_s = inputs, now_s
        if inputs.sync:
            self._shadow.follow_table(self.state, self.intake.path)
        if arming and not output.refused:
            self._set_owner(client)
            self._turns.forget_late_offsets()
        if output.refused is not None and client is not None:
            self._answer_request(client, document, output.refused)
        disarmed_by = client.peer if client is not None and request is not None and request.kind == "disarm" else None
        by = {"uid": disarmed_by.uid, "pid": disarmed_by.pid} if disarmed_by is not None else {}
        if output.transition is not None and not {*output.transition[:2]} <= {Mode.RAMPING, Mode.ACTIVE}:
            self._note_late_pc(now_s)
            self._log_transition(*output.transition[:2], self.state.cause, by)
        if output.feed_transition is not None:
            self._log_feedforward_transition(*output.feed_transition, by)
        for own, was, axis in zip(self.settings.axes, before, self.state.axes, strict=True):
            if axis.record_void and not was.record_void:
                self._journal.write("record_void", axis=own.name, text=Alarm("RecordVoid", own.name).sentence())

    def _note_late_pc(self, now_s: float) -> None:
        cause = self.state.cause
        if cause is not None and not cause.late and (late := self._turns.explain_by_lateness(cause.code, now_s)):
            self.state = self.state._replace(cause=replace(cause, late=late))

    def _is_daemon_alive(self, owner: GuardSocketClient | None, now_s: float) -> bool:
        return owner is not None and not owner.gone and now_s - owner.last_request_s <= self.settings.daemon_lost_s

    def _set_owner(self, client: GuardSocketClient | None) -> None:
        for each in self.control.clients:
            each.armed = each is client
        self._owner, self._withdrawn = client, ()

    def _send_output(self, output: StepOutput) -> None:
        axes = zip(self.settings.axes, self._entries, output.offsets or (), strict=output.offsets is not None)
        counter = self._listener.counter
        frames = [(axis.offset.cob_id, pack_pdo(e, (offset, counter)[: len(e)])) for axis, e, offset in axes]
        self._unsent = self._send_frames(frames)
        feeds = zip(self.settings.feeds, output.feed or (), strict=output.feed is not None)
        self._unfed = self._send_frames([(feed.pdo.cob_id, pack_pdo(feed.pdo.entries, pair)) for feed, pair in feeds])
        if output.heartbeat:
            self._send_frames([(COB_HEARTBEAT + self.settings.node_id, bytes([Nmt.OPERATIONAL]))])

    def _send_frames(self, frames: Sequence[tuple[int, bytes]]) -> tuple[int, ...]:
        """Send frames; return the indices of those that did not leave. On a dead bus none is tried."""
        unsent = []
        for k, (cob_id, data) in enumerate(frames):
            try:
                left = self._listener.bus_state != "down" and self._can.send(cob_id, data)
            except BusDown as error:
                self._report_bus_down(error)
                left = False
            if not left:
                unsent.append(k)
        return tuple(unsent)

    def _log_transition(self, before: Mode, mode: Mode, cause: Alarm | None, by: Mapping[str, int]) -> None:
        """Journal a change of state; ``by`` names the client whose disarm caused it."""
        standing_um = guard_status.get_applied_offset_um(self.state, self.settings)
        off = mode is Mode.OFF and not guard_status.describe_applied_offset(standing_um)
        described = {"code": cause.code, "axis": cause.axis, "text": cause.sentence(off)} if cause else {}
        self._journal.write(
            "state",
            before=before.value,
            state=mode.value,
            tick=self.state.tick,
            offset_um=guard_status.get_sent_offset_um(self.state, self.settings),
            may_stand_um=standing_um,
            missed=self.state.missed,
            **described,
            **by,
        )
        self._notifier.notify_systemd(f"STATUS={mode.value}" + (f": {cause.cause}" if cause else ""))

    def _log_feedforward_transition(self, before: FeedMode, mode: FeedMode, by: Mapping[str, int]) -> None:
        feed, cause = self.state.feed, self.state.feed.cause
        entry = {"code": cause.code, "axis": cause.axis, "text": cause.sentence(mode is FeedMode.OFF)} if cause else {}
        if feed.unconfirmed:
            entry["text"] = f"{guard_status.FED}; hold the feed, then run fdhil adopt"
        self._journal.write("feedforward", before=before.value, state=mode.value, tick=self.state.tick, **entry, **by)
        self._notifier.notify_systemd(f"STATUS=feed-forward {mode.value}" + (f": {cause.cause}" if cause else ""))

    # --- the clients ---

    def _serve_clients(self, ready: set[int]) -> None:
        """Serve one client and check some rows of a table; then pause both, and wait for the bus alone."""
        if not (ready or self.control.pending or self.intake.busy):
            return
        served = self.control.serve_one_client(ready, self._now_s())
        if served is not None:
            self._dispatch_request(*served)
            served[0].close_unclaimed_descriptor()
        self.control.drop_gone()
        self.intake.check_next_rows(self.state)
        self._rested_s = self._now_s() + REST_S

    def _dispatch_request(self, client: GuardSocketClient, document: Document) -> None:
        kind = document.get("request")
        if not client.peer.may_request(kind):
            client.queue_reply(document, ok=False, **client.peer.describe_refusal(kind))
            self._log_refused_access(client.peer, kind)
        elif kind == "status":
            client.queue_reply(document, ok=True, **self.build_status())
        elif kind == "alive":
            self._take_keep_alive(client, document)
        elif kind == "table":
            self.intake.begin_table(client, document, self.state)
        elif kind in DECIDED:
            self._queue_request(client, document, parse_request(kind, document, self.settings))
        else:
            text = f"{kind[:40]!r} is an unknown request" if isinstance(kind, str) else "the request has no name"
            client.queue_reply(
                document, ok=False, code="BadRequest", text=text, advice=f"use one of {', '.join(DECIDED)}"
            )

    def _queue_request(self, client: GuardSocketClient, document: Document, request: GuardRequest) -> None:
        """Queue a request for the next step; each client has one waiting at most, but a disarm replaces all others.

        A request with another count of ``disarms`` was made before the last disarm and is refused. Of clients that have
        disconnected one disarm is kept, however many sent one.
        """
        disarms = request.kind == "disarm"
        if disarms:
            self._disarms += 1
        elif document.get("disarms", self._disarms) != self._disarms:
            self._answer_request(client, document, (Alarm("DisarmedSince"),))
            return
        elif self._stopping:
            self._answer_request(client, document, (Alarm("Stopped"),))
            return
        elif request.kind in ("arm", "feedforward") and (late := self._turns.refuse_when_late()):
            self._answer_request(client, document, (Alarm("PcLate", detail=late),))
            return
        for waits in list(self._requests):
            owner, asked, other = waits
            if owner is None:
                continue
            if disarms and other.kind != "disarm":
                self._answer_request(owner, asked, (Alarm("DisarmedSince"),))
                self._requests.remove(waits)
            elif owner.gone and (disarms or other.kind != "disarm"):
                self._requests.remove(waits)
        if any(waits[0] is client for waits in self._requests):
            self._answer_request(client, document, (Alarm("GuardBusy"),))
        else:
            self._requests.append((client, document, request))

    def _take_keep_alive(self, client: GuardSocketClient, document: Document) -> None:
        """Take the daemon's keep-alive; a fact that it no longer attests ends the correction."""
        facts = document.get("facts")
        if client is self._owner and isinstance(facts, dict):
            self._withdrawn = tuple(Alarm(FACTS[f]) for f in WITHDRAWABLE if f in facts and facts[f] is not True)

    def _answer_request(self, client: GuardSocketClient, document: Document, refused: tuple[Alarm, ...]) -> None:
        if not refused:
            client.queue_reply(document, ok=True, state=self.state.mode.value)
            if document["request"] != "disarm":
                self._journal.write("granted", request=document["request"], uid=client.peer.uid, pid=client.peer.pid)
            return
        if Alarm("AuthRequired") in refused:
            self._log_refused_access(client.peer, document["request"])
        alarms = list(map(guard_status.build_alarm_document, refused))
        client.queue_reply(document, ok=False, state=self.state.mode.value, **alarms[0], refused=alarms)

    def _log_refused_access(self, peer: ClientProcess, kind: object) -> None:
        """Journal who requested what they may not; ``times`` counts all refusals since the line before."""
        self._refused, now_s = self._refused + 1, self._now_s()
        if now_s - self._refused_s >= REFUSED_S:
            requested = str(kind)[:40] if kind else "to talk"
            self._journal.write(
                "refused", code="AuthRequired", request=requested, uid=peer.uid, pid=peer.pid, times=self._refused
            )
            self._refused_s, self._refused = now_s, 0

    def build_status(self) -> dict[str, Any]:
        """Return the guard's status, for the daemon."""
        shadow = self._shadow.get_offsets()
        not_good: tuple[Alarm, ...] = (Alarm("SyncLost"),)
        if self._inputs is not None and not self._silent:
            not_good = guard_step.list_status_alarms(self.state, self._inputs, self.settings)
        return {
            **guard_status.build_status_document(self.state, self.settings, self.intake.path, not_good),
            "sync_heard": not self._silent,
            "shadow_um": None if shadow is None else guard_status.convert_to_um(shadow, self.settings),
            "emergencies": self._listener.emergencies,
            "journal_dropped": self._journal.dropped,
            "lateness": self._turns.build_lateness_document(),
            "disarms": self._disarms,
            "events": list(self._journal.recent),
        }
