"""Prove that a drive stops by itself when fdhil dies: the heartbeat consumer, CiA 301 7.2.8."""

import contextlib
from collections.abc import Callable, Iterator

from fdhil.cia402 import NmtCommand, Object, PowerState, describe_emergency
from fdhil.commissioning.axis_motion import EMCY_HEARTBEAT
from fdhil.commissioning.drive_survey import require_enabled
from fdhil.commissioning.master import Master
from fdhil.drivers import NO_OBJECT, NO_SUB_INDEX
from fdhil.errors import DeviceError, DriveFault, SdoAbort

FEEDING_TRIES = 4
FEEDING_S = 0.3
STARVE_TIMEOUT_S = 1.0
HEARTBEATS_MISSED = 3
ANSWER_CYCLES = 20


def run_watchdog_test(master: Master, enable: Callable[[Master], None]) -> str:
    """Send fdhil's heartbeat, then stop it: the drive must stop by itself. Return ``proven``, else DriveFault.

    ``enable`` brings the drive back to Operation enabled.
    """
    node_id, period_s = master.config.guard.node_id, master.config.guard.heartbeat_s
    entry = _pack_consumer_entry(node_id, period_s)
    with contextlib.ExitStack() as undo:
        sub, before = find_consumer_slot(master, node_id)
        master.sdo.write_int(Object.CONSUMER_HEARTBEAT, sub, 0, 4)
        undo.callback(master.sdo.write_int, Object.CONSUMER_HEARTBEAT, sub, before, 4)
        undo.callback(setattr, master, "heartbeat", False)
        fed_from = _feed_heartbeat(master, sub, entry, enable)
        before_count = len(master.feedback.emergencies)
        master.heartbeat = False
        with contextlib.suppress(DeviceError):
            master.wait_until(lambda: _has_reacted(master, before_count), STARVE_TIMEOUT_S, "")
        master.wait_cycles(ANSWER_CYCLES)  # its EMCY may follow its statusword
        master.raise_if_failed()
        if master.get_power_state() is PowerState.OPERATION_ENABLED:  # by 0x1029 it may have left Operational silently
            master.send_nmt(NmtCommand.START)
            master.wait_cycles(ANSWER_CYCLES)
        if master.get_power_state() is PowerState.OPERATION_ENABLED:
            text = "it did not stop when fdhil's heartbeat ended: its watchdog does not work; check 0x1016 and 0x6007"
            raise DriveFault(master.device, text)
        codes = [int.from_bytes(data[:2], "little") for data in master.feedback.emergencies[fed_from:]]
        if EMCY_HEARTBEAT not in codes:
            shown = ", ".join(f"{code:04X} ({describe_emergency(code)})" for code in codes) or "none"
            missed = f"8130 ({describe_emergency(EMCY_HEARTBEAT)})"
            text = f"it stopped with the EMCY {shown} instead of {missed}; find the other cause of the stop"
            raise DriveFault(master.device, text)
    return "proven"


@contextlib.contextmanager
def watch_heartbeat(master: Master, node_id: int, period_s: float) -> Iterator[None]:
    """Let the drive monitor the heartbeat of ``node_id`` from its first one on, until the end.

    DriveFault if it cannot, or does not keep the written entry.
    """
    sub, before = find_consumer_slot(master, node_id)
    entry = _pack_consumer_entry(node_id, period_s)
    master.sdo.write_int(Object.CONSUMER_HEARTBEAT, sub, 0, 4)
    try:
        master.sdo.write_int(Object.CONSUMER_HEARTBEAT, sub, entry, 4)
        if master.sdo.read_int(Object.CONSUMER_HEARTBEAT, sub) != entry:
            raise DriveFault(master.device, "it does not keep 0x1016, so it would not detect that fdhil has died")
        yield
    finally:
        master.sdo.write_int(Object.CONSUMER_HEARTBEAT, sub, 0, 4)
        master.sdo.write_int(Object.CONSUMER_HEARTBEAT, sub, before, 4)


def _pack_consumer_entry(node_id: int, period_s: float) -> int:
    return node_id << 16 | round(HEARTBEATS_MISSED * period_s * 1e3)


def _has_reacted(master: Master, before_count: int) -> bool:
    return (
        master.get_power_state() is not PowerState.OPERATION_ENABLED or len(master.feedback.emergencies) > before_count
    )


def _feed_heartbeat(master: Master, sub: int, entry: int, enable: Callable[[Master], None]) -> int:
    """Let the drive monitor fdhil's heartbeat without a fault for a while; DriveFault if that is impossible.

    A busy computer occasionally sends a heartbeat late, and the drive rightly stops; that is retried. Returns the
    number of emergencies before success: later ones may stem from a late heartbeat.
    """
    for _ in range(FEEDING_TRIES):
        master.sdo.write_int(Object.CONSUMER_HEARTBEAT, sub, entry, 4)
        if master.sdo.read_int(Object.CONSUMER_HEARTBEAT, sub) != entry:
            raise DriveFault(master.device, "it does not keep 0x1016, so it cannot monitor fdhil and must not be armed")
        before_count = len(master.feedback.emergencies)
        master.heartbeat = True
        master.wait_cycles(round(FEEDING_S / master.period_s))
        if master.get_power_state() is PowerState.OPERATION_ENABLED:
            return before_count
        codes = [int.from_bytes(data[:2], "little") for data in master.feedback.emergencies[before_count:]]
        if EMCY_HEARTBEAT not in codes:
            require_enabled(master)
        master.heartbeat = False
        master.sdo.write_int(Object.CONSUMER_HEARTBEAT, sub, 0, 4)
        enable(master)
    text = f"it missed fdhil's heartbeat {FEEDING_TRIES} times; reduce this computer's load and try again"
    raise DriveFault(master.device, text)


def find_consumer_slot(master: Master, node_id: int) -> tuple[int, int]:
    """Return a sub-index of 0x1016 that is free or fdhil's, and its value."""
    try:
        count = master.sdo.read_int(Object.CONSUMER_HEARTBEAT, 0)
        for sub in range(1, count + 1):
            value = master.sdo.read_int(Object.CONSUMER_HEARTBEAT, sub)
            if value & 0xFFFF == 0 or value >> 16 & 0x7F == node_id:
                return sub, value
    except SdoAbort as abort:
        if abort.code not in (NO_OBJECT, NO_SUB_INDEX):
            raise
        text = "it has no heartbeat consumer (0x1016), so it cannot detect that fdhil has died; it must not be armed"
        raise DriveFault(master.device, text) from None
    raise DriveFault(master.device, "all entries of 0x1016 are in use; free one with the drive's tool")
