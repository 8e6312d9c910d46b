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

from fdhil.arming import (
    ADOPT_ADVICE,
    GUARD_TRIPPED,
    RECORD_VOIDING_CODES,
    START_AND_ADOPT,
    Answer,
    ArmingService,
    ResidualOffset,
    make_refusal,
)
from fdhil.cancellation import find_first_error
from fdhil.commissioning import mark_record_void
from fdhil.config import MachineConfig, find_unlikely_values
from fdhil.daemon import alarms, black_box, malloc_tuning, service_log
from fdhil.daemon.acquisition import Acquisition, OpenSource
from fdhil.daemon.audit_middleware import AuditMiddleware
from fdhil.daemon.clock_watch import ClockWatch, find_newest_record_s
from fdhil.daemon.daemon_socket import SOCKET_NAME, ControlServer
from fdhil.daemon.daemon_status import DaemonStatus
from fdhil.daemon.gantry_watch import GantryWatch
from fdhil.daemon.kernel_warmup import compile_kernels
from fdhil.daemon.live_stream import LiveStream
from fdhil.daemon.machine_lock import lock_machine
from fdhil.daemon.offer_watch import OfferWatch
from fdhil.daemon.outcome_store import OutcomeStore
from fdhil.daemon.record_queue import RecordQueue
from fdhil.daemon.resource_usage import ResourceUse, ResourceWatch, measure_usage
from fdhil.daemon.shutdown import Shutdown, StepBudgets
from fdhil.daemon.socket_recovery import restore_access
from fdhil.daemon.systemd_notify import notify_systemd
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


class DaemonService:
    """One running daemon of one machine."""

    def __init__(
        self,
        config: MachineConfig,
        open_source: OpenSource,
        method: str | None = None,
        budgets: StepBudgets | None = None,
        leave: Callable[[int], object] | None = None,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self._config, self._clock = config, clock
        self._method = method
        self._run_directory = config.run_directory
        self._store = OutcomeStore(config, clock)
        self._arming = ArmingService(config, self._store, self._run_directory, clock)
        self._watch = DaemonStatus(config, self._clock.now_s())
        self._live = LiveStream(config)
        self._gantry = GantryWatch(config)
        self._pipelines: dict[str, AxisPipeline] = {}
        self._queues = {axis: RecordQueue() for axis in config.axis}
        self._busy_since_s: dict[str, float] = {}
        self._notices = asyncio.Queue[Notice](NOTICE_QUEUE)
        self._void_axes = asyncio.Queue[str]()  # each once at most; ``_void_by`` has the newest reason
        self._void_by: dict[str, str] = {}
        self._gate = service_log.LogThrottle()
        self._held: dict[alarms.Key, Notice] = {}  # newest suppressed notice of each condition
        self._audit = AuditMiddleware(self._handle_request, config.store.directory, clock)
        arming, access = self._arming, config.access
        self._control = ControlServer(
            self._audit.answer_request,
            lambda: arming.check_progress,
            arming.abandon_preparation,
            access,
            self._live.serve_viewer,
            self._restore_access,
        )
        self._acquisition = Acquisition(config, open_source, self._watch.hearing, self._record_notices)
        self._stop = asyncio.Event()
        self._budgets = budgets or StepBudgets()
        self.shutdown = Shutdown(self._budgets.total_s, leave)
        self._resources: tuple[ResourceUse, ...] = ()
        self._frames_seen = -1

    async def run(self) -> ResidualOffset:
        """Serve until a signal requests a stop; return what may still be applied. BusLocked: another serves it."""
        loop = asyncio.get_running_loop()
        with lock_machine(self._run_directory, self._config.store.directory), service_log.date_lines_by(self._clock):
            stopping = [number for number in STOPPING if signal.getsignal(number) is not signal.SIG_IGN]  # as by nohup
            for number in stopping:
                loop.add_signal_handler(number, self._request_stop)
            try:
                await self._run_tasks()
            finally:
                notify_systemd("STOPPING=1")
                self.shutdown.start_deadline()
                await self._ramp_to_zero()
                stop, budgets, stands = self.shutdown, self._budgets, self._arming.guard.residual_offset
                await stop.run_step(
                    "the audit log", self._audit.wait_until_written(), budgets.audit_s, "its last lines are lost"
                )
                closing = asyncio.to_thread(self._store.close)
                await stop.run_step("closing the store", closing, budgets.store_s, "its last records may be lost")
                for number in stopping:
                    loop.remove_signal_handler(number)
                if (
                    self._acquisition.opened.is_set() or not stands.is_zero
                ):  # else it never ran, and only the error is reported
                    self._log_stopped(stands)
        return stands

    def _log_stopped(self, stands: ResidualOffset) -> None:
        if stands.is_zero:
            service_log.write_line(f"stopped, {stands}")
        else:
            advice = START_AND_ADOPT if self._arming.guard.state == "lost" else ADOPT_ADVICE
            service_log.write_line(f"stopped, {stands}; {advice}", "MAJOR")

    @property
    def residual_offset(self) -> ResidualOffset:
        """The offset that may still be applied, as far as the daemon knows."""
        return self._arming.guard.residual_offset

    async def _run_tasks(self) -> None:
        clock = ClockWatch(await asyncio.to_thread(find_newest_record_s, self._config.store.directory))
        self._record_notices(await asyncio.to_thread(self._store.open))
        self._log_outcomes([Notice("ConfigUnlikely", "minor", text) for text in find_unlikely_values(self._config)])
        await asyncio.to_thread(self._prepare_pipelines)
        async with self._control.serve_socket(self._run_directory / SOCKET_NAME), asyncio.TaskGroup() as tasks:
            stop, budgets = self.shutdown, self._budgets
            closing_s = budgets.source_s + 1.0  # reported before it is abandoned
            acquiring = tasks.create_task(self._acquisition.run(self._take_record, closing_s), name="acquire")
            others = [tasks.create_task(self._run_pipeline(axis), name=f"axis {axis}") for axis in self._config.axis]
            others.append(tasks.create_task(self._store_notices(), name="notices"))
            others.append(tasks.create_task(self._void_records(), name="void"))
            others.append(tasks.create_task(self._arming.supervise_guard(self._record_notices), name="guard"))
            others.append(tasks.create_task(self._arming.stream_rows(self._record_notices), name="stream"))
            others.append(tasks.create_task(self._feed_watchdog(), name="watchdog"))
            others.append(tasks.create_task(self._monitor_bus(), name="listen"))
            others.append(tasks.create_task(self._monitor_resources(clock), name="resources"))
            others.append(tasks.create_task(self._report_ready(), name="ready"))
            await self._stop.wait()
            notify_systemd("STOPPING=1")
            await self._ramp_to_zero()
            acquiring.cancel()
            closing = asyncio.wait([acquiring])
            await stop.run_step("closing buses and sensors", closing, budgets.source_s, "the kernel closes them")
            analysing = self._wait_for_analysis()
            await stop.run_step("the analysis of what was received", analysing, budgets.analysis_s, "the rest is lost")
            for task in others:
                task.cancel()

    def _request_stop(self) -> None:
        self.shutdown.start_deadline()
        self._stop.set()

    async def _ramp_to_zero(self) -> None:
        effect = "the guard ramps to zero when this process has ended; see fdhil-guard's journal"
        await self.shutdown.run_step("the ramp to zero", self._arming.shut_down(), self._budgets.zero_s, effect)

    async def _wait_for_analysis(self) -> None:
        axes = (queue.join() for queue in self._queues.values())
        await asyncio.gather(*axes, self._notices.join(), self._void_axes.join())

    def _prepare_pipelines(self) -> None:
        """Load each axis from the history, and compile the kernels."""
        self._arming.start_from_history(self._store.read_newest_revisions(), self._store.read_newest_skills())
        for axis in self._config.axis:
            history = self._store.read_axis_history(axis)
            self._pipelines[axis] = AxisPipeline(axis, self._config, self._method, history)
            self._watch.load_axis_history(axis, history.newest, self._store.count_windows(axis), history.loops)
        compile_kernels(self._config, self._method)

    async def _report_ready(self) -> None:
        await self._acquisition.opened.wait()
        axes = ", ".join(self._config.axis)
        service_log.write_line(f"ready: {self._config.machine.name}, axes {axes}; listening, sending nothing")
        notify_systemd("READY=1\nSTATUS=listening, sending nothing")

    # from the machine to the pipelines -------------------------------------------------------------------------

    def _take_record(self, record: Record | NcState | Notice) -> None:
        self._acquisition.reset_retry_delay()
        if isinstance(record, NcState):
            self._arming.take_nc_state(record)
            self._record_notices(self._watch.nc.take_state(record, self._clock.now_s()))
            return
        self._watch.hearing.take_record(record, self._clock.now_s())
        if isinstance(record, Notice):
            self._record_notices([record])
            return
        self._live.publish_record(record)
        if isinstance(record, Temperature):
            self._arming.knowledge.take_temperature(record)
        elif isinstance(record, AxisSamples):
            self._gantry.take_samples(record)
            self._arming.take_samples(record)
        for axis in self._config.axis if isinstance(record, TickTimes) else (record.axis,):
            if axis in self._queues:
                self._queues[axis].put(record)

    async def _run_pipeline(self, axis: str) -> None:
        """Feed one axis' pipeline in order, in a worker thread; a batch takes all waiting records."""
        queue = self._queues[axis]
        while True:
            batch = await queue.take_batch()
            self._busy_since_s[axis] = self._clock.now_s()
            outcomes, notices = await asyncio.to_thread(self._process_batch, axis, batch)
            del self._busy_since_s[axis]
            self._arming.knowledge.take_outcomes(outcomes)
            self._log_outcomes([*outcomes, *notices])
            queue.mark_processed(len(batch))

    def _process_batch(self, axis: str, batch: Sequence[Record]) -> tuple[list[Outcome], list[Notice]]:
        outcomes = [outcome for record in batch for outcome in self._pipelines[axis].process_record(record)]
        return outcomes, self._store.store_outcomes(outcomes) if outcomes else []

    # logging and storing ----------------------------------------------------------------------------------------

    def _record_notices(self, notices: Sequence[Notice]) -> None:
        """Log notices and queue them for the store; those that a flood suppressed are not stored either.

        A notice that voids a commissioning record does so even when suppressed.
        """
        now_s = self._clock.now_s()
        for notice in notices:
            if notice.code in RECORD_VOIDING_CODES:
                if notice.axis not in self._void_by:
                    self._void_axes.put_nowait(notice.axis)
                self._void_by[notice.axis] = notice.text
        placed = [self._watch.nc.add_nc_line(notice, now_s) for notice in notices]
        self._held |= {alarms.get_alarm_key(notice): notice for notice in placed if notice.code in alarms.CONDITIONS}
        for shown in self._log_outcomes(placed):
            if isinstance(shown, Notice):
                self._held.pop(alarms.get_alarm_key(shown), None)
                if not self._notices.full():
                    self._notices.put_nowait(shown)

    async def _store_notices(self) -> None:
        while True:
            notice = await self._notices.get()
            self._log_outcomes(await asyncio.to_thread(self._store.store_outcomes, [notice]))
            if notice.code == GUARD_TRIPPED and self._acquisition.source is not None:
                code, frames = notice.text.partition(":")[0], self._acquisition.source.dump_recent_frames
                store = self._config.store.directory
                self._record_notices(
                    [await asyncio.to_thread(black_box.write_black_box, store, code, frames, self._clock)]
                )
            self._notices.task_done()

    async def _void_records(self) -> None:
        """Mark void commissioning records in the store, for the next guard that starts."""
        while True:
            axis = await self._void_axes.get()
            try:
                await asyncio.to_thread(mark_record_void, self._config.store.directory, axis, self._void_by.pop(axis))
            except StoreError as error:
                service_log.write_line(str(error), "MAJOR")
            self._void_axes.task_done()

    def _log_outcomes(self, outcomes: Sequence[Outcome]) -> list[Outcome]:
        """Log outcomes, one line each (a flood becomes a count), update the status; return those that were logged."""
        now_s, shown = self._clock.now_s(), []
        for outcome in outcomes:
            text, severity = service_log.format_outcome(outcome)
            held = self._gate.admit_line(outcome.code if isinstance(outcome, Notice) else type(outcome).__name__, now_s)
            if held is not None or not isinstance(outcome, Notice):
                self._watch.take_outcome(outcome, now_s)
            if held is not None:
                shown.append(outcome)
                service_log.write_line(text + (f" ({held} more like this were not written)" if held else ""), severity)
        return shown

    async def _feed_watchdog(self) -> None:
        """Feed systemd's watchdog while blocks arrive or their absence is explained: a restart fixes neither."""
        period_s = int(os.environ.get("WATCHDOG_USEC", WATCHDOG_S * 2e6)) / 1e6 / 2
        while True:
            if self._is_alive(period_s):
                notify_systemd("WATCHDOG=1")
            await asyncio.sleep(min(period_s, WATCHDOG_S))

    def _is_alive(self, period_s: float) -> bool:
        now_s = self._clock.now_s()
        if any(now_s - since_s > STUCK_S for since_s in self._busy_since_s.values()):
            return False
        counters = self._acquisition.source.get_counters() if self._acquisition.source is not None else {}
        frames = int(counters.get("frames", 0))
        moved, self._frames_seen = frames != self._frames_seen, frames
        return moved or self._watch.hearing.is_alive(now_s, period_s)

    async def _monitor_bus(self) -> None:
        """Check reception a few times per second and report deviations from the config."""
        while True:
            await asyncio.sleep(LISTEN_S)
            now_s = self._clock.now_s()
            if self._acquisition.source is not None:
                self._watch.hearing.take_counters(self._acquisition.source.get_counters(), now_s)
            again = [notice for notice in self._held.values() if self._gate.can_admit(notice.code, now_s)]
            self._record_notices([*again, *self._watch.update_troubles(now_s)])
            skewed, notices = self._gantry.check_skew()
            self._record_notices(notices)
            if skewed:
                await self._arming.disarm()

    async def _monitor_resources(self, clock: ClockWatch) -> None:
        """Check memory, descriptors, the clock, waiting proposals and the store periodically."""
        watch, offers = ResourceWatch(), OfferWatch(self._config)
        while True:
            await asyncio.to_thread(malloc_tuning.trim_heap)
            self._resources = measure_usage()
            self._record_notices(
                [*watch.check_usage(self._resources), *clock.check_clock(self._clock.wall_s(), self._clock.now_s())]
            )
            self._record_notices(await asyncio.to_thread(offers.find_new_offers))
            self._record_notices(await asyncio.to_thread(self._store.store_outcomes, ()))  # reports a replaced history
            await asyncio.sleep(RESOURCES_S)

    # control ---------------------------------------------------------------------------------------------------

    async def _handle_request(self, request: Mapping[str, Any]) -> Answer:
        if request["request"] == "status":
            return self._build_status()
        if request["request"] == "live":
            return self._live.open_stream()
        if request["request"] == "arm":
            answer = await self._arming.arm(request, lambda: self._control.is_armer_gone)
            self._record_notices([*await asyncio.to_thread(self._arming.guard.take_changes), _make_arm_notice(answer)])
            difference = self._watch.describe_config_difference(request.get("config_digest", self._config.digest))
            return {**answer, "config_difference": difference} if difference else answer
        if request["request"] == "disarm":
            return await self._arming.disarm()
        if request["request"] == "acknowledge":
            return await asyncio.to_thread(self._store.store_acknowledgement, request)
        if request["request"] == "stop":
            self._request_stop()
            return {"ok": True, "text": "stopping"}
        text = f"{request['request']!r} is an unknown request"
        return make_refusal("BadRequest", text, "send status, live, arm, disarm, acknowledge or stop")

    async def _restore_access(self, trouble: str) -> None:
        self._record_notices([await restore_access(self._arming, trouble)])

    def _build_status(self) -> Answer:
        counters = dict(self._acquisition.source.get_counters()) if self._acquisition.source is not None else {}
        dropped = {axis: queue.dropped for axis, queue in self._queues.items()}
        counters["records_dropped"] = sum(dropped.values())
        store = {
            "directory": str(self._config.store.directory),
            "fault": self._store.fault,
            "strays": list(self._store.strays),
        }
        status = self._watch.build_status(self._clock.now_s(), self._store.notices.describe_stored)
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
            "may_stand": {"nothing": guard.residual_offset.is_zero, "text": str(guard.residual_offset)},
            "armed": self._arming.armed,
            "checking": self._arming.check_progress,
            "passes": self._arming.passes,
            "store": store,
            "unacknowledged": self._store.notices.build_status(),
            "alarms": self._store.notices.build_alarms_status(),
        }


def _make_arm_notice(answer: Answer) -> Notice:
    """Return the notice of an arm request for log and history, refused ones included."""
    if answer["ok"]:
        return Notice("Armed", "info", str(answer["text"]))
    return Notice("ArmRefused", "minor", f"{answer['code']}: {answer['text']}")


def run_daemon_service(config: MachineConfig, open_source: OpenSource, method: str | None = None) -> ResidualOffset:
    """Run the daemon until it is stopped; return the offset that may still be applied.

    FdhilError when it cannot start or meets a fatal error.
    """
    malloc_tuning.limit_heap_growth()
    service = DaemonService(config, open_source, method, leave=os._exit)
    try:
        return asyncio.run(_serve_until_stopped(service))
    except ExceptionGroup as group:
        first = find_first_error(group)
        if isinstance(first, FdhilError):
            raise first from None
        for line in "".join(traceback.format_exception(group)).splitlines():
            service_log.write_line(line, "MAJOR")
        text = f"InternalError: {first!r} ended the daemon; {service.residual_offset}; report the lines above"
        raise InternalError(text) from None
    finally:
        service.shutdown.cancel_deadline()


async def _serve_until_stopped(service: DaemonService) -> ResidualOffset:
    stands = await service.run()
    service.shutdown.leave_overrun()
    return stands
