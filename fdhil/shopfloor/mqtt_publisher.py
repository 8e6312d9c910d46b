"""Publishes the daemon's status to an MQTT broker, as an edge node of Sparkplug B.

The broker receives the node's birth and death, and only changes in between. The only command obeyed is the request for
births. Nothing is stored: events during a broker's absence are not sent later, and a slow broker receives the newest
values and notices.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import logging
import time
from collections import deque
from collections.abc import Iterable, Mapping
from typing import NoReturn

import aiomqtt
from aiomqtt.exceptions import MqttConnectError

from fdhil.cancellation import GivenUp, end_tasks, find_first_error, run_attempt
from fdhil.config import MachineConfig, MqttBroker, create_tls_context, read_password
from fdhil.daemon import write_line
from fdhil.shopfloor.published_items import PublishedEvent, PublishedValue
from fdhil.shopfloor.publisher_process import report_ready
from fdhil.shopfloor.sparkplug import (
    BOOLEAN,
    DOUBLE,
    INT64,
    STRING,
    EdgeNode,
    HostState,
    Message,
    Metric,
    is_rebirth_command,
    make_host_topic,
    parse_host_state,
)
from fdhil.shopfloor.status_poller import StatusUpdate, poll_status

FIRST_RETRY_S, LAST_RETRY_S = 1.0, 60.0
END_S = 10.0
DEATH_S = 2.0  # to send the death certificate; else the broker sends the will
REBIRTH_S = 1.0  # shortest time between births
WAITING = 32  # queued messages of the broker
HOST_AHEAD_MS = 60_000  # tolerance of a host application's clock
MOST_EVENTS = 256  # queued notices
NOTICE = "the newest notice"
BROKER = ("MQTT broker", "publish.mqtt")  # as errors name it
DATATYPES: Mapping[str, int] = {"measure": DOUBLE, "count": INT64, "flag": BOOLEAN, "state": STRING, "text": STRING}


class HostGone(Exception):
    """The primary host application reports that it is offline."""


async def publish(config: MachineConfig) -> None:
    """Publish until cancelled; an unavailable broker is retried with increasing delay.

    ConnectError when the files of its credentials cannot be used.
    """
    settings = config.publish.mqtt
    session = MqttSession(settings, settings.get_node_name(config.machine.name))
    create_tls_context(settings, *BROKER)  # faulty files end the command
    read_password(settings, *BROKER)
    where = f"{settings.host}:{settings.port}"
    report_ready(
        f"Sparkplug B of {config.machine.name}: {session.node.make_topic('NBIRTH')}, for the broker at {where}"
    )
    tasks = [
        asyncio.create_task(_poll_daemon(config, session)),
        asyncio.create_task(_stay_connected(session, settings)),
    ]
    try:  # if one ends, so does the other: values would be outdated
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        done.pop().result()
    finally:
        await end_tasks(tasks, END_S, DEATH_S + 1.0)


async def _poll_daemon(config: MachineConfig, session: MqttSession) -> None:
    async for news in poll_status(config, config.publish.mqtt.period_s):
        session.take_update(news)


async def _stay_connected(session: MqttSession, settings: MqttBroker) -> NoReturn:
    delay_s, logged = FIRST_RETRY_S, ""
    where = f"{settings.host}:{settings.port}"
    while True:
        began_s = time.monotonic()
        try:
            await run_attempt(f"broker {where}", _serve_connection(session, settings, where))
        except* (aiomqtt.MqttError, GivenUp) as errors:
            cause = _explain_failure(find_first_error(errors))
            if cause != logged:
                write_line(f"nothing is published to the broker {where}: {cause}; retrying", "minor")
            logged = cause
        except* HostGone:
            write_line(f"the primary host {settings.primary_host} is offline; waiting for it", "minor")
        if time.monotonic() - began_s > LAST_RETRY_S:  # the connection lasted
            delay_s, logged = FIRST_RETRY_S, ""
        await asyncio.sleep(delay_s)
        delay_s = min(LAST_RETRY_S, 2 * delay_s)


async def _serve_connection(session: MqttSession, settings: MqttBroker, where: str) -> None:
    async with _make_client(settings, session) as broker:
        write_line(f"connected to the broker {where}")
        await session.run(broker)


def _explain_failure(error: BaseException) -> str:
    """Return why publishing fails, and what to check."""
    if isinstance(error, MqttConnectError):
        return f"it refuses ({error}); check user, password_file and the broker's access rules"
    if "SSL" in str(error):
        return f"{error}; check tls_ca_file and the name in its certificate"
    return f"{error}; check host and port, and whether it runs"


def _make_client(settings: MqttBroker, session: MqttSession) -> aiomqtt.Client:
    """Return a client for one connection, with its own death certificate as the will."""
    will = session.node.begin_connection(_now_ms())
    identity = hashlib.sha256(will.topic.encode()).hexdigest()[:16]
    return aiomqtt.Client(
        settings.host,
        settings.port,
        identifier=f"fdhil-{identity}",  # the broker then closes our previous connection
        username=settings.user,
        password=read_password(settings, *BROKER),
        tls_context=create_tls_context(settings, *BROKER),
        will=aiomqtt.Will(will.topic, will.payload, will.qos, retain=False),
        clean_session=True,
        keepalive=round(settings.keepalive_s),
        max_queued_incoming_messages=WAITING,
        logger=_make_silent_logger(),
    )


def _make_silent_logger() -> logging.Logger:
    """Return a muted logger: the library's relevant messages come as exceptions."""
    log = logging.getLogger("fdhil.mqtt")
    log.propagate = False
    log.handlers = [logging.NullHandler()]
    return log


class MqttSession:
    """Publishing over successive connections."""

    def __init__(self, settings: MqttBroker, node: str) -> None:
        self.node = EdgeNode(settings.group, node)
        self._host = settings.primary_host
        self._news: StatusUpdate | None = None
        self._notices: dict[str, Metric] = {}
        self._events = deque[PublishedEvent]()
        self._dropped = 0  # notices dropped for newer ones
        self._fresh = False  # whether the update has not been sent yet
        self._stir = asyncio.Event()
        self._rebirth = self._born = False
        self._host_state: HostState | None = None

    def take_update(self, news: StatusUpdate) -> None:
        """Take the newest update; it is sent while a broker is connected."""
        self._news = news
        if self._born:
            self._fresh = True
            self._queue_events(news.events)
        else:  # the births include the newest notice
            for event in news.events:
                self._note_event(event)
        self._stir.set()

    def _queue_events(self, events: Iterable[PublishedEvent]) -> None:
        """Queue notices to be sent one after another; when the broker is too slow, drop the oldest."""
        self._events.extend(events)
        while len(self._events) > MOST_EVENTS:
            self._note_event(self._events.popleft())
            if not self._dropped:
                text = f"the broker is too slow: the oldest of {MOST_EVENTS} queued notices are dropped"
                write_line(f"{text} for newer ones", "minor")
            self._dropped += 1

    def _log_skipped_notices(self) -> None:
        if self._dropped:
            write_line(f"{self._dropped} notices were not sent one by one: the broker was too slow", "minor")
        self._dropped = 0

    async def run(self, broker: aiomqtt.Client) -> None:
        """Serve one connection until it breaks (an ExceptionGroup with MqttError or HostGone), or it is cancelled."""
        self._rebirth, self._born, self._host_state = False, False, None
        await broker.subscribe(self.node.make_topic("NCMD"), qos=1)
        if self._host:
            await broker.subscribe(make_host_topic(self._host), qos=1)
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(self._handle_commands(broker))
                tasks.create_task(self._publish_updates(broker))
        finally:
            await self._send_death(broker)

    async def _send_death(self, broker: aiomqtt.Client) -> None:
        """Send the death certificate: the broker itself reports broken connections only."""
        if not self._born:
            return
        self._born = False
        while self._events:  # the next births include the newest
            self._note_event(self._events.popleft())
        self._log_skipped_notices()
        with contextlib.suppress(aiomqtt.MqttError):  # broken: the broker publishes the will
            await _send_messages(broker, [self.node.build_death(_now_ms())], DEATH_S)

    async def _handle_commands(self, broker: aiomqtt.Client) -> None:
        async for message in broker.messages:
            if self._host and message.topic.matches(make_host_topic(self._host)):
                self._take_host_state(parse_host_state(message.payload))
            elif is_rebirth_command(message.payload):
                self._rebirth = True
                self._stir.set()

    def _take_host_state(self, state: HostState | None) -> None:
        """Accept the newest state of the host: an older death belongs to an earlier connection.

        A time stamp ahead of this computer's clock sets no order: it would make later states be ignored until then.
        """
        known = self._host_state
        if state is None or (known is not None and state.stamp_ms < known.stamp_ms):
            return
        is_ahead = state.stamp_ms > _now_ms() + HOST_AHEAD_MS
        self._host_state = HostState(state.online, 0) if is_ahead else state
        self._stir.set()
        if self._born and not state.online:
            raise HostGone

    async def _publish_updates(self, broker: aiomqtt.Client) -> NoReturn:
        while self._news is None or (self._host and not (self._host_state and self._host_state.online)):
            await self._wait_for_change()
        while True:
            if self._rebirth or not self._born:
                self._rebirth, self._born, self._fresh = False, True, False
                assert self._news is not None
                await _send_messages(
                    broker, self.node.build_births(*self._make_metrics(self._news), self._news.stamp_ms)
                )
                await asyncio.sleep(REBIRTH_S)
            while not self._rebirth and (self._fresh or self._events):
                await _send_messages(broker, self._build_changes(self._news))
            if not self._rebirth:
                await self._wait_for_change()

    async def _wait_for_change(self) -> None:
        await self._stir.wait()
        self._stir.clear()

    def _build_changes(self, news: StatusUpdate) -> list[Message]:
        """Return the changes, with only the oldest of several notices: each is sent by itself."""
        self._fresh = False
        if self._events:
            self._note_event(self._events.popleft())
        if not self._events:
            self._log_skipped_notices()
        return self.node.build_changes(*self._make_metrics(news), news.stamp_ms)

    def _note_event(self, event: PublishedEvent) -> None:
        text = f"{event.code}: {event.text}"
        self._notices[event.axis] = Metric("notice", STRING, text, event.stamp_ms, description=NOTICE, event=True)

    def _make_metrics(self, news: StatusUpdate) -> tuple[list[Metric], dict[str, list[Metric]]]:
        """Return the metrics of the node, and of each axis; no axis while the daemon is silent."""
        up = Metric("up", BOOLEAN, not news.silent, news.stamp_ms, description="whether the daemon answers")
        node = [up, *self._make_axis_metrics("", news)]
        axes = dict.fromkeys(value.axis for value in news.values if value.axis)
        return node, {} if news.silent else {axis: self._make_axis_metrics(axis, news) for axis in axes}

    def _make_axis_metrics(self, axis: str, news: StatusUpdate) -> list[Metric]:
        known = [make_metric(value) for value in news.values if value.axis == axis]
        active = [f"{alarm.code}: {alarm.text}" for alarm in news.alarms if alarm.axis == axis]
        text = None if news.silent else "; ".join(active)
        alarms = Metric("alarms", STRING, text, news.stamp_ms, description="active problems, with the next action")
        none_yet = Metric("notice", STRING, None, news.stamp_ms, description=NOTICE)
        return [*known, alarms, self._notices.get(axis, none_yet)]


def make_metric(value: PublishedValue) -> Metric:
    """Return a published value as a metric; those of a bus are in its folder."""
    item = value.item
    name = f"{value.bus}/{item.name}" if value.bus else item.name
    unit = "" if item.unit == "1" else item.unit
    return Metric(name, DATATYPES[item.kind], value.value, value.stamp_ms, unit, item.description)


async def _send_messages(broker: aiomqtt.Client, messages: list[Message], timeout_s: float | None = None) -> None:
    for message in messages:
        await broker.publish(message.topic, message.payload, message.qos, retain=False, timeout=timeout_s)


def _now_ms() -> int:
    return time.time_ns() // 1_000_000
