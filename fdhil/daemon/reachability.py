"""Restores what a cleaned run directory took away from a running daemon, or has the correction ramped to zero."""

from __future__ import annotations

import asyncio

from fdhil.arming.desk import ArmingDesk
from fdhil.errors import DeviceError
from fdhil.records import Notice

CODE = "SocketLost"


async def reach_again(desk: ArmingDesk, trouble: str) -> Notice:
    """Write the token again beside the socket that was made again; ramp to zero where ``trouble`` prevented that."""
    try:
        await asyncio.to_thread(desk.restore_token)
    except DeviceError as error:
        trouble = trouble or str(error)
    if trouble:
        await desk.disarm()
        text = f"The control socket or the token is gone and cannot be made again ({trouble}): disarmed."
        return Notice(CODE, "MAJOR", text)
    text = "The run directory was cleaned away: the control socket and the token were made again, all goes on."
    return Notice(CODE, "minor", text)
