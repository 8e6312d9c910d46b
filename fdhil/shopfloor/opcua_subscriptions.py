"""Decides what a subscribed client is told of a value: each change of what was reported to it last.

asyncua compares with the value before, which may not have been reported: what creeps by less than a client's deadband
is never told, and with a deadband no status is told whose value is none, so that an old number stays Good.
"""

from numbers import Real
from typing import Any

from asyncua import ua
from asyncua.server.monitored_item_service import MonitoredItemService


class ReportedValues(MonitoredItemService):
    """The monitored items of one subscription; ``mvalue`` of each has what was reported last."""

    async def datachange_callback(self, handle: int, value: ua.DataValue, error: ua.StatusCode | None = None) -> None:
        """Report a value that was written, where it differs from the one reported last."""
        if error:
            await super().datachange_callback(handle, value, error)
            return
        number = self._monitored_datachange[handle]
        item = self._monitored_items[number]
        if item.mode == ua.MonitoringMode.Disabled or not is_news(item.mvalue.current_dvalue, value, item.filter):
            return
        item.mvalue.set_current_datavalue(value)
        told = ua.MonitoredItemNotification()
        told.ClientHandle, told.Value = item.client_handle, value
        await self.isub.enqueue_datachange_event(number, told, item.queue_size)


def is_news(reported: ua.DataValue | None, value: ua.DataValue, wanted: Any = None) -> bool:
    """Whether a client with the filter ``wanted`` is told a value after the one reported last (OPC 10000-4, 7.22.2).

    A change of the status always is. A deadband is one of numbers; one in percent, for which there is no range, is 0.
    """
    if reported is None or _status(reported) != _status(value):
        return True
    trigger = ua.DataChangeTrigger.StatusValue if wanted is None else wanted.Trigger
    if trigger == ua.DataChangeTrigger.Status:
        return False
    band = wanted.DeadbandValue if wanted is not None and wanted.DeadbandType == ua.DeadbandType.Absolute else None
    if band is None and trigger == ua.DataChangeTrigger.StatusValueTimestamp and _stamp(reported) != _stamp(value):
        return True
    before, now = _plain(reported), _plain(value)
    if band is not None and all(isinstance(each, Real) and not isinstance(each, bool) for each in (before, now)):
        return not abs(now - before) <= band  # nor where one is NaN
    return bool(before != now)


def _status(value: ua.DataValue) -> int:
    return 0 if value.StatusCode is None else int(value.StatusCode.value)


def _stamp(value: ua.DataValue) -> Any:
    return value.SourceTimestamp, value.SourcePicoseconds


def _plain(value: ua.DataValue) -> Any:
    return None if value.Value is None else value.Value.Value
