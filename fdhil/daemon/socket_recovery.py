"""Restores the socket and token of a running daemon whose run directory was cleaned, or ramps to zero."""

import asyncio

from fdhil.arming import ArmingService
from fdhil.errors import DeviceError
from fdhil.records import Notice

CODE = "SocketLost"


async def restore_access(arming: ArmingService, trouble: str) -> Notice:
    """Write the token again after the socket; ramp to zero where ``trouble`` or an error prevents either."""
    try:
        await asyncio.to_thread(arming.restore_token)
    except DeviceError as error:
        trouble = trouble or str(error)
    if trouble:
        await arming.disarm()
        text = f"The control socket or the token is gone and cannot be created again ({trouble}): disarmed."
        return Notice(CODE, "MAJOR", text)
    text = "The run directory was removed: the control socket and the token were created again; operation continues."
    return Notice(CODE, "minor", text)
