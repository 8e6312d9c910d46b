"""Publishes alarms as conditions and notices as events, under the machine's Notification.Messages (OPC 40501-1)."""

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from asyncua import Server, ua
from asyncua.server.event_generator import EventGenerator

from fdhil.shopfloor.opcua_address_space import AddressSpace
from fdhil.shopfloor.opcua_values import make_node_id
from fdhil.shopfloor.published_items import PublishedAlarm, PublishedEvent
from fdhil.shopfloor.status_poller import StatusUpdate

ALERT_TYPE, NOTIFICATION_EVENT_TYPE = 39, 35  # of MachineTool
SEVERITY: Mapping[str, int] = {"info": 100, "minor": 400, "MAJOR": 800}  # of 1..1000
SILENT = "DaemonSilent"


class OpcUaMessages:
    """The active conditions, and the events as they come."""

    def __init__(self, server: Server, nodes: AddressSpace) -> None:
        self._server, self._nodes = server, nodes
        self._on: dict[tuple[str, str], PublishedAlarm] = {}
        self._conditions: dict[tuple[str, str], EventGenerator] = {}
        self._notices: EventGenerator

    async def build_event_types(self) -> None:
        """Create the type of fdhil's notices, and the reference to the server's own node."""
        everything = self._server.nodes.server
        await everything.set_event_notifier([ua.EventNotifier.SubscribeToEvents])
        await everything.add_reference(self._nodes.messages, ua.ObjectIds.HasNotifier)
        base = make_node_id(NOTIFICATION_EVENT_TYPE, self._nodes.machine_tool)
        kind = await self._server.create_custom_event_type(self._nodes.own, "NoticeType", base, [])
        self._notices = await self._create_generator(kind.nodeid, "Identifier")

    async def publish_events(self, news: StatusUpdate) -> None:
        """Publish what began, what ended, and new events. A silent daemon ends no alarm: its state is unknown."""
        now = {(alarm.code, alarm.axis): alarm for alarm in news.alarms}
        if news.silent:
            silent = PublishedAlarm(SILENT, "MAJOR", f"{news.silent}; no values are known")
            now = self._on | {(SILENT, ""): silent}
        for key in self._on.keys() - now.keys():
            await self._publish_condition(self._on[key], False)
        for key, alarm in now.items():
            if key not in self._on:
                await self._publish_condition(alarm, True)
        self._on = now
        for event in news.events:
            await self._publish_notice(event)

    async def _create_generator(self, kind: ua.NodeId, code: str) -> EventGenerator:
        """Return a generator for events of a type; ``code`` is a field that the type declares without a value."""
        generator = await self._server.get_event_generator(kind, self._nodes.messages.nodeid)
        generator.event.add_property(code, "", ua.VariantType.String)
        return generator

    async def _publish_condition(self, alarm: PublishedAlarm, active: bool) -> None:
        key = alarm.code, alarm.axis
        if key not in self._conditions:
            self._conditions[key] = await self._create_generator(
                make_node_id(ALERT_TYPE, self._nodes.machine_tool), "ErrorCode"
            )
        generator = self._conditions[key]
        event: Any = generator.event
        event.NodeId = make_node_id(".".join(filter(None, ["alarm", alarm.code, alarm.axis])), self._nodes.own)
        event.ConditionName = event.ErrorCode = alarm.code
        event.SourceName = alarm.axis or "machine"
        event.Severity = SEVERITY[alarm.severity]
        event.Retain = active
        _set_state(event, "EnabledState", "Enabled", True)
        _set_state(event, "ActiveState", "Active" if active else "Inactive", active)
        _set_state(event, "AckedState", "Acknowledged", True)  # operators acknowledge at the daemon
        await self._trigger_event(generator, alarm.text if active else f"{alarm.code}: the condition has ended", None)

    async def _publish_notice(self, event: PublishedEvent) -> None:
        fields: Any = self._notices.event
        fields.Identifier = event.code
        fields.SourceName = event.axis or "machine"
        fields.Severity = SEVERITY[event.severity]
        stamp = datetime.fromtimestamp(event.stamp_ms * 1e-3, UTC)
        await self._trigger_event(self._notices, f"{event.code}: {event.text}", stamp)

    async def _trigger_event(self, generator: EventGenerator, message: str, stamp: datetime | None) -> None:
        """Trigger an event for clients of the machine's messages, and for clients of the whole server."""
        event = generator.event
        event.emitting_node = self._nodes.messages.nodeid
        await generator.trigger(time_attr=stamp, message=message)
        event.emitting_node = self._server.nodes.server.nodeid  # where ConditionRefresh finds it
        await self._server.iserver.subscription_service.trigger_event(event)


def _set_state(event: Any, name: str, words: str, value: bool) -> None:
    setattr(event, name, ua.LocalizedText(words, "en"))
    setattr(event, f"{name}/Id", value)
