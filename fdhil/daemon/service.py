"""Runs the daemon: one task group that carries records from the machine to the pipelines, and outcomes to the store.

Sources restart with increasing delay; a pipeline never does. An unexpected exception in any task ramps the correction
to zero (the guard is disarmed) and ends the process: a daemon is never half alive. It sends nothing to the machine.
"""

import asyncio
import os
import signal
import traceback
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from fdhil.arming.answers import Answer, refusal
from fdhil.arming.desk import ArmingDesk
from fdhil.arming.guard_link import TRIPPED, VOIDING
from fdhil.arming.standing import ADOPT, START_AND_ADOPT, Standing
from fdhil.cancellation import find_first_error
from fdhil.commissioning.void import void_record
from fdhil.config import MachineConfig, unlikely
from fdhil.daemon import alarms, blackbox, heap, journal
from fdhil.daemon.acquisition import Acquisition, OpenSource
from fdhil.daemon.audited import Audited
from fdhil.daemon.clock import ClockWatch, newest_record_s
from fdhil.daemon.control import SOCKET_NAME, ControlServer
from fdhil.daemon.gantry_watch import GantryWatch
from fdhil.daemon.kernel_warmup import warm
from fdhil.daemon.live import LiveStream
from fdhil.daemon.lock import sole_owner
from fdhil.daemon.notify import notify
from fdhil.daemon.offer_watch import OfferWatch
from fdhil.daemon.outcome_store import OutcomeStore
from fdhil.daemon.reachability import reach_again
from fdhil.daemon.record_queue import RecordQueue
from fdhil.daemon.resources import ResourceWatch, Use, uses
from fdhil.daemon.shutdown import Budgets, Shutdown
from fdhil.daemon.status import Watch
from fdhil.errors import FdhilError, StoreError
from fdhil.pipeline import AxisPipeline, Record
from fdhil.records import AxisSamples, NcState, Notice, Outcome, Temperature, TickTimes
from fdhil.system_clock import SYSTEM_CLOCK, Clock

NOTICE_QUEUE = 200
WATCHDOG_S = 2.0
LISTEN_S = 0.25
RESOURCES_S = 10.0
STOPPING = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
STUCK_S = 60.0  # a batch that is digested for so long hangs


class InternalError(FdhilError):
    """An internal error of fdhil ended the daemon."""


class Service:
    """One running daemon of one machine."""

    def __init__(
        self,
        config: MachineConfig,
        open_source: OpenSource,
        method: str | None = None,
        budgets: Budgets | None = None,
        leave: Callable[[int], object] | None = None,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self._config, self._clock = config, clock
        self._method = method
        self._run_directory = config.run_directory
        self._store = OutcomeStore(config, clock)
        self._arming = ArmingDesk(config, self._store, self._run_directory, clock)
        self._watch = Watch(config, self._clock.now_s())
        self._live = LiveStream(config)
        self._gantry = GantryWatch(config)
        self._pipelines: dict[str, AxisPipeline] = {}
        self._queues = {axis: RecordQueue() for axis in config.axis}
        self._busy_since_s: dict[str, float] = {}
        self._notices = asyncio.Queue[Notice](NOTICE_QUEUE)
        self._void_axes = asyncio.Queue[str]()  # each once at most; ``_void_by`` has the newest reason
        self._void_by: dict[str, str] = {}
        self._gate = journal.FloodGate()
        self._held: dict[alarms.Key, Notice] = {}  # newest suppressed notice of each condition
        self._audit = Audited(self._handle, config.store.directory, clock)
        arming, access = self._arming, config.access
        self._control = ControlServer(
            self._audit.of, lambda: arming.checking, arming.abandon, access, self._live.serve, self._socket_lost
        )
        self._acquisition = Acquisition(config, open_source, self._watch.hearing, self._tell)
        self._stop = asyncio.Event()
        self._budgets = budgets or Budgets()
        self.shutdown = Shutdown(self._budgets.total_s, leave)
        self._resources: tuple[Use, ...] = ()
        self._frames_seen = -1

    async def run(self) -> Standing:
        """Serve until a signal requests a stop; return what may still be applied. BusLocked: another serves it."""
        loop = asyncio.get_running_loop()
        with sole_owner(self._run_directory, self._config.store.directory), journal.lines_dated_by(self._clock):
            stopping = [number for number in STOPPING if signal.getsignal(number) is not signal.SIG_IGN]  # as by nohup
            for number in stopping:
                loop.add_signal_handler(number, self._begin_to_stop)
            try:
                await self._serve()
            finally:
                notify("STOPPING=1")
                self.shutdown.begin()
                await self._ramp_to_zero()
                stop, budgets, stands = self.shutdown, self._budgets, self._arming.guard.standing
                await stop.step("the audit log", self._audit.written(), budgets.audit_s, "its last lines are lost")
                closing = asyncio.to_thread(self._store.close)
                await stop.step("closing the store", closing, budgets.store_s, "its last records may be lost")
                for number in stopping:
                    loop.remove_signal_handler(number)
                if (
                    self._acquisition.opened.is_set() or not stands.nothing
                ):  # else it never ran, and only the error is reported
                    self._say_stopped(stands)
        return stands

    def _say_stopped(self, stands: Standing) -> None:
        if stands.nothing:
            journal.write_line(f"stopped, {stands}")
        else:
            advice = START_AND_ADOPT if self._arming.guard.state == "lost" else ADOPT
            journal.write_line(f"stopped, {stands}; {advice}", "MAJOR")

    @property
    def standing(self) -> Standing:
        """The offset that may still be applied, as far as the daemon knows."""
        return self._arming.guard.standing

    async def _serve(self) -> None:
        clock = ClockWatch(await asyncio.to_thread(newest_record_s, self._config.store.directory))
        self._tell(await asyncio.to_thread(self._store.open))
        self._say([Notice("ConfigUnlikely", "minor", text) for text in unlikely(self._config)])
        await asyncio.to_thread(self._prepare)
        async with self._control.serving(self._run_directory / SOCKET_NAME), asyncio.TaskGroup() as tasks:
            stop, budgets = self.shutdown, self._budgets
            closing_s = budgets.source_s + 1.0  # reported before it is abandoned
            acquiring = tasks.create_task(self._acquisition.run(self._take, closing_s), name="acquire")
            others = [tasks.create_task(self._work(axis), name=f"axis {axis}") for axis in self._config.axis]
            others.append(tasks.create_task(self._keep_notices(), name="notices"))
            others.append(tasks.create_task(self._void_records(), name="void"))
            others.append(tasks.create_task(self._arming.attend(self._tell), name="guard"))
            others.append(tasks.create_task(self._arming.stream(self._tell), name="stream"))
            others.append(tasks.create_task(self._feed_watchdog(), name="watchdog"))
            others.append(tasks.create_task(self._listen(), name="listen"))
            others.append(tasks.create_task(self._watch_resources(clock), name="resources"))
            others.append(tasks.create_task(self._say_ready(), name="ready"))
            await self._stop.wait()
            notify("STOPPING=1")
            await self._ramp_to_zero()
            acquiring.cancel()
            closing = asyncio.wait([acquiring])
            await stop.step("closing buses and sensors", closing, budgets.source_s, "the kernel closes them")
            analysing = self._analysed()
            await stop.step("the analysis of what was received", analysing, budgets.analysis_s, "the rest is lost")
            for task in others:
                task.cancel()

    def _begin_to_stop(self) -> None:
        self.shutdown.begin()
        self._stop.set()

    async def _ramp_to_zero(self) -> None:
        effect = "the guard ramps to zero when this process has ended; see fdhil-guard's journal"
        await self.shutdown.step("the ramp to zero", self._arming.stand_down(), self._budgets.zero_s, effect)

    async def _analysed(self) -> None:
        axes = (queue.join() for queue in self._queues.values())
        await asyncio.gather(*axes, self._notices.join(), self._void_axes.join())

    def _prepare(self) -> None:
        """Load each axis from the history, and compile the kernels."""
        self._arming.begin(self._store.newest(), self._store.skills())
        for axis in self._config.axis:
            history = self._store.known(axis)
            self._pipelines[axis] = AxisPipeline(axis, self._config, self._method, history)
            self._watch.begin(axis, history.newest, self._store.counts(axis), history.loops)
        warm(self._config, self._method)

    async def _say_ready(self) -> None:
        await self._acquisition.opened.wait()
        axes = ", ".join(self._config.axis)
        journal.write_line(f"ready: {self._config.machine.name}, axes {axes}; listening, sending nothing")
        notify("READY=1\nSTATUS=listening, sending nothing")

    # from the machine to the pipelines -------------------------------------------------------------------------

    def _take(self, record: Record | NcState | Notice) -> None:
        self._acquisition.received()
        if isinstance(record, NcState):
            self._arming.hear_nc(record)
            self._tell(self._watch.nc.note(record, self._clock.now_s()))
            return
        self._watch.hearing.record_came(record, self._clock.now_s())
        if isinstance(record, Notice):
            self._tell([record])
            return
        self._live.take(record)
        if isinstance(record, Temperature):
            self._arming.knowledge.note_temperature(record)
        elif isinstance(record, AxisSamples):
            self._gantry.feed(record)
            self._arming.hear(record)
        for axis in self._config.axis if isinstance(record, TickTimes) else (record.axis,):
            if axis in self._queues:
                self._queues[axis].put(record)

    async def _work(self, axis: str) -> None:
        """Feed one axis' pipeline in order, in a worker thread; a batch takes all waiting records."""
        queue = self._queues[axis]
        while True:
            batch = await queue.batch()
            self._busy_since_s[axis] = self._clock.now_s()
            outcomes, notices = await asyncio.to_thread(self._digest, axis, batch)
            del self._busy_since_s[axis]
            self._arming.knowledge.note(outcomes)
            self._say([*outcomes, *notices])
            queue.digested(len(batch))

    def _digest(self, axis: str, batch: Sequence[Record]) -> tuple[list[Outcome], list[Notice]]:
        outcomes = [outcome for record in batch for outcome in self._pipelines[axis].feed(record)]
        return outcomes, self._store.keep(outcomes) if outcomes else []

    # logging and storing ----------------------------------------------------------------------------------------

    def _tell(self, notices: Sequence[Notice]) -> None:
        """Log notices and queue them for the store; those that a flood suppressed are not stored either.

        A notice that voids a commissioning record does so even when suppressed.
        """
        now_s = self._clock.now_s()
        for notice in notices:
            if notice.code in VOIDING:
                if notice.axis not in self._void_by:
                    self._void_axes.put_nowait(notice.axis)
                self._void_by[notice.axis] = notice.text
        placed = [self._watch.nc.placed(notice, now_s) for notice in notices]
        self._held |= {alarms.key_of(notice): notice for notice in placed if notice.code in alarms.CONDITIONS}
        for shown in self._say(placed):
            if isinstance(shown, Notice):
                self._held.pop(alarms.key_of(shown), None)
                if not self._notices.full():
                    self._notices.put_nowait(shown)

    async def _keep_notices(self) -> None:
        while True:
            notice = await self._notices.get()
            self._say(await asyncio.to_thread(self._store.keep, [notice]))
            if notice.code == TRIPPED and self._acquisition.source is not None:
                code, frames = notice.text.partition(":")[0], self._acquisition.source.black_box
                store = self._config.store.directory
                self._tell([await asyncio.to_thread(blackbox.dump, store, code, frames, self._clock)])
            self._notices.task_done()

    async def _void_records(self) -> None:
        """Mark void commissioning records in the store, for the next guard that starts."""
        while True:
            axis = await self._void_axes.get()
            try:
                await asyncio.to_thread(void_record, self._config.store.directory, axis, self._void_by.pop(axis))
            except StoreError as error:
                journal.write_line(str(error), "MAJOR")
            self._void_axes.task_done()

    def _say(self, outcomes: Sequence[Outcome]) -> list[Outcome]:
        """Log outcomes, one line each (a flood becomes a count), update the status; return those that were logged."""
        now_s, shown = self._clock.now_s(), []
        for outcome in outcomes:
            text, severity = journal.line_of(outcome)
            held = self._gate.admit(outcome.code if isinstance(outcome, Notice) else type(outcome).__name__, now_s)
            if held is not None or not isinstance(outcome, Notice):
                self._watch.outcome_came(outcome, now_s)
            if held is not None:
                shown.append(outcome)
                journal.write_line(text + (f" ({held} more like this were not written)" if held else ""), severity)
        return shown

    async def _feed_watchdog(self) -> None:
        """Feed systemd's watchdog while blocks arrive or their absence is explained: a restart fixes neither."""
        period_s = int(os.environ.get("WATCHDOG_USEC", WATCHDOG_S * 2e6)) / 1e6 / 2
        while True:
            if self._alive(period_s):
                notify("WATCHDOG=1")
            await asyncio.sleep(min(period_s, WATCHDOG_S))

    def _alive(self, period_s: float) -> bool:
        now_s = self._clock.now_s()
        if any(now_s - since_s > STUCK_S for since_s in self._busy_since_s.values()):
            return False
        counters = self._acquisition.source.counters() if self._acquisition.source is not None else {}
        frames = int(counters.get("frames", 0))
        moved, self._frames_seen = frames != self._frames_seen, frames
        return moved or self._watch.hearing.alive(now_s, period_s)

    async def _listen(self) -> None:
        """Check reception a few times per second and report deviations from the config."""
        while True:
            await asyncio.sleep(LISTEN_S)
            now_s = self._clock.now_s()
            if self._acquisition.source is not None:
                self._watch.hearing.counted(self._acquisition.source.counters(), now_s)
            again = [notice for notice in self._held.values() if self._gate.would_admit(notice.code, now_s)]
            self._tell([*again, *self._watch.troubles(now_s)])
            skewed, notices = self._gantry.look()
            self._tell(notices)
            if skewed:
                await self._arming.disarm()

    async def _watch_resources(self, clock: ClockWatch) -> None:
        """Check memory, descriptors, the clock, waiting proposals and the store periodically."""
        watch, offers = ResourceWatch(), OfferWatch(self._config)
        while True:
            await asyncio.to_thread(heap.give_back)
            self._resources = uses()
            self._tell([*watch.look(self._resources), *clock.look(self._clock.wall_s(), self._clock.now_s())])
            self._tell(await asyncio.to_thread(offers.look))
            self._tell(await asyncio.to_thread(self._store.keep, ()))  # reports a replaced history
            await asyncio.sleep(RESOURCES_S)

    # control ---------------------------------------------------------------------------------------------------

    async def _handle(self, request: Mapping[str, Any]) -> Answer:
        if request["request"] == "status":
            return self._status()
        if request["request"] == "live":
            return self._live.begin()
        if request["request"] == "arm":
            answer = await self._arming.arm(request, lambda: self._control.hung_up)
            self._tell([*await asyncio.to_thread(self._arming.guard.take_changes), _told(answer)])
            difference = self._watch.config_difference(request.get("config_digest", self._config.digest))
            return {**answer, "config_difference": difference} if difference else answer
        if request["request"] == "disarm":
            return await self._arming.disarm()
        if request["request"] == "acknowledge":
            return await asyncio.to_thread(self._store.acknowledge, request)
        if request["request"] == "stop":
            self._begin_to_stop()
            return {"ok": True, "text": "stopping"}
        text = f"{request['request']!r} is an unknown request"
        return refusal("BadRequest", text, "send status, live, arm, disarm, acknowledge or stop")

    async def _socket_lost(self, trouble: str) -> None:
        self._tell([await reach_again(self._arming, trouble)])

    def _status(self) -> Answer:
        counters = dict(self._acquisition.source.counters()) if self._acquisition.source is not None else {}
        dropped = {axis: queue.dropped for axis, queue in self._queues.items()}
        counters["records_dropped"] = sum(dropped.values())
        store = {
            "directory": str(self._config.store.directory),
            "fault": self._store.fault,
            "strays": list(self._store.strays),
        }
        status = self._watch.status(self._clock.now_s(), self._store.notices.told)
        guard = self._arming.guard
        for axis, celsius in self._arming.knowledge.temperatures.items():
            status["axes"][axis]["slideway_c"] = celsius
        return {
            "ok": True,
            "state": "OFF(SHADOW)" if guard.state == "absent" else guard.state,
            **status,
            "frames": {"received": counters.get("frames", 0), "lost": counters.get("lost", 0)},
            "counters": counters,
            "dropped": dropped,
            "resources": {use.name: {"used": use.used, "allowed": use.allowed} for use in self._resources},
            "guard": dict(guard.status),
            "may_stand": {"nothing": guard.standing.nothing, "text": str(guard.standing)},
            "armed": self._arming.armed,
            "checking": self._arming.checking,
            "passes": self._arming.passes,
            "store": store,
            "unacknowledged": self._store.notices.status(),
            "alarms": self._store.notices.alarms(),
        }


def _told(answer: Answer) -> Notice:
    """Return the notice of an arm request for log and history, refused ones included."""
    if answer["ok"]:
        return Notice("Armed", "info", str(answer["text"]))
    return Notice("ArmRefused", "minor", f"{answer['code']}: {answer['text']}")


def run(config: MachineConfig, open_source: OpenSource, method: str | None = None) -> Standing:
    """Run the daemon until it is stopped; return the offset that may still be applied.

    FdhilError when it cannot start or meets a fatal error.
    """
    heap.keep_small()
    service = Service(config, open_source, method, leave=os._exit)
    try:
        return asyncio.run(_served(service))
    except ExceptionGroup as group:
        first = find_first_error(group)
        if isinstance(first, FdhilError):
            raise first from None
        for line in "".join(traceback.format_exception(group)).splitlines():
            journal.write_line(line, "MAJOR")
        text = f"InternalError: {first!r} ended the daemon; {service.standing}; report the lines above"
        raise InternalError(text) from None
    finally:
        service.shutdown.end()


async def _served(service: Service) -> Standing:
    stands = await service.run()
    service.shutdown.leave_overrun()
    return stands
