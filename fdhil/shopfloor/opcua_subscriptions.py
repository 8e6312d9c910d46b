"""Decides which values a subscribed client receives: each change against the value it received last.

asyncua compares with the previous value, which may not have been reported: a drift in steps below a client's deadband
is never reported, and with a deadband no status is reported for a value without a number, so that an old one stays
Good.
"""

from numbers import Real
from typing import Any

from asyncua import ua
from asyncua.server.monitored_item_service import MonitoredItemService


class ReportedValues(MonitoredItemService):
    """The monitored items of one subscription; ``mvalue`` of each is the value reported last."""

    async def datachange_callback(self, handle: int, value: ua.DataValue, error: ua.StatusCode | None = None) -> None:
        """Report a written value where it differs from the one reported last."""
        if error:
            await super().datachange_callback(handle, value, error)
            return
        number = self._monitored_datachange[handle]
        item = self._monitored_items[number]
        if item.mode == ua.MonitoringMode.Disabled or not must_report(item.mvalue.current_dvalue, value, item.filter):
            return
        item.mvalue.set_current_datavalue(value)
        notification = ua.MonitoredItemNotification()
        notification.ClientHandle, notification.Value = item.client_handle, value
        await self.isub.enqueue_datachange_event(number, notification, item.queue_size)


def must_report(reported: ua.DataValue | None, value: ua.DataValue, wanted: Any = None) -> bool:
    """Return whether a client with the filter ``wanted`` receives a value after the one reported last.

    See OPC 10000-4, 7.22.2. A change of status is always reported. A deadband applies to numbers; one in percent, for
    which there is no range, counts as 0.
    """
    if reported is None or _get_status(reported) != _get_status(value):
        return True
    trigger = ua.DataChangeTrigger.StatusValue if wanted is None else wanted.Trigger
    if trigger == ua.DataChangeTrigger.Status:
        return False
    band = wanted.DeadbandValue if wanted is not None and wanted.DeadbandType == ua.DeadbandType.Absolute else None
    if (
        band is None
        and trigger == ua.DataChangeTrigger.StatusValueTimestamp
        and _get_stamp(reported) != _get_stamp(value)
    ):
        return True
    before, now = _get_plain_value(reported), _get_plain_value(value)
    if band is not None and all(isinstance(each, Real) and not isinstance(each, bool) for each in (before, now)):
        return not abs(now - before) <= band  # NaN always differs
    return bool(before != now)


def _get_status(value: ua.DataValue) -> int:
    return 0 if value.StatusCode is None else int(value.StatusCode.value)


def _get_stamp(value: ua.DataValue) -> Any:
    return value.SourceTimestamp, value.SourcePicoseconds


def _get_plain_value(value: ua.DataValue) -> Any:
    return None if value.Value is None else value.Value.Value
