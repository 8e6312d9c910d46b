"""Polls an NC's state from its OPC UA server: every signal of the profile with one Read request.

asyncua's automatic reconnection stays off: the listener reconnects. Its logger is quiet, since the errors here report
the same.
"""

import asyncio
import contextlib
import logging
import struct
import time
from collections.abc import AsyncIterator, Mapping, Sequence
from typing import Any, Self

from asyncua import Client, ua
from asyncua.ua.uaerrors import UaError

from fdhil.config import MachineConfig
from fdhil.drivers.nc.nc_profile import Shown, StateTranslator
from fdhil.drivers.nc.nc_profile_file import read_nc_profile
from fdhil.drivers.nc.opcua_client_security import set_up_security
from fdhil.drivers.nc.opcua_node_lookup import check_places, find_nodes
from fdhil.drivers.nc.value_timing import bound_value_time
from fdhil.errors import ConnectError, DeviceTimeout, ProtocolError
from fdhil.records import NcState

logging.getLogger("asyncua").setLevel(logging.CRITICAL)
LOST = (OSError, EOFError, UaError)
NONSENSE = (struct.error, ValueError, TypeError, KeyError, AttributeError, IndexError)
"""Errors of asyncua for bytes that are not OPC UA."""
_NOT_THERE = (ua.StatusCodes.BadNodeIdUnknown, ua.StatusCodes.BadNodeIdInvalid, ua.StatusCodes.BadAttributeIdInvalid)


class OpcUaSource:
    """The NC source ``opcua``."""

    def __init__(self, config: MachineConfig) -> None:
        self._settings = config.nc_source.opcua
        self.name = f"OPC UA server at {self._settings.url.removeprefix('opc.tcp://')}"
        self._profile = read_nc_profile(self._settings.profile, "opcua")
        check_places({name: signal.at for name, signal in self._profile.signals.items()}, self._settings.profile)
        self._translator = StateTranslator(self._profile, self.name)
        self._client: Client | None = None
        self._nodes: Mapping[str, ua.NodeId] = {}
        self._next_s = 0.0

    async def __aenter__(self) -> Self:
        self._translator.reset_blocks()
        self._client = client = Client(self._settings.url, timeout=self._settings.timeout_s)
        try:
            await set_up_security(client, self._settings, self.name)
            async with _limit_time(4 * self._settings.timeout_s):
                await client.connect()
                self._nodes = await self._find_signals(client)
        except TimeoutError:
            await self._disconnect()
            text = f"does not answer within {4 * self._settings.timeout_s:g} s; compare url, and start the server"
            raise ConnectError(self.name, text) from None
        except LOST as error:
            await self._disconnect()
            text = (
                f"cannot be connected ({_shorten_error(error)}); "
                "compare url, user, certificate and the server's own settings"
            )
            raise ConnectError(self.name, text) from None
        except NONSENSE as error:
            await self._disconnect()
            raise ProtocolError(self.name, f"does not speak OPC UA ({_shorten_error(error)}); compare url") from None
        except BaseException:
            await self._disconnect()
            raise
        self._next_s = time.monotonic()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._disconnect()

    async def _disconnect(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            with contextlib.suppress(*LOST, *NONSENSE, TimeoutError):
                async with _limit_time(self._settings.timeout_s):
                    await client.disconnect()

    async def _find_signals(self, client: Client) -> Mapping[str, ua.NodeId]:
        signals = self._profile.signals
        found = await find_nodes(client, {name: signal.at for name, signal in signals.items()})
        values = await client.uaclient.read_attributes(list(found.values()), ua.AttributeIds.Value)
        for name, value in zip(list(found), values, strict=True):
            if value.StatusCode is not None and value.StatusCode.value in _NOT_THERE:
                del found[name]
        lacking = [signal.at for name, signal in signals.items() if name not in found and not signal.optional]
        if lacking:
            text = (
                f"has no {', no '.join(lacking)}; compare the profile {self._settings.profile} with an OPC UA browser"
            )
            raise ProtocolError(self.name, text)
        return found

    async def read_states(self) -> Sequence[NcState]:
        await asyncio.sleep(max(0.0, self._next_s - time.monotonic()))
        self._next_s = max(time.monotonic(), self._next_s + self._settings.period_s)
        asked_ns = time.monotonic_ns()
        values = await self._read_values()
        shown = {name: _convert_value(value) for name, value in zip(self._nodes, values, strict=True)}
        if all(value is None for value in shown.values()):
            text = f"has no value ({_format_status(values[0])}); is the NC behind it switched on?"
            raise ProtocolError(self.name, text)
        stamp_ns, error_ns = bound_value_time(asked_ns, time.monotonic_ns(), self._settings.renewed_s)
        return [self._translator.translate_state(shown, stamp_ns, error_ns)]

    async def _read_values(self) -> list[ua.DataValue]:
        assert self._client is not None
        try:
            async with _limit_time(self._settings.timeout_s):
                values = await self._client.uaclient.read_attributes(list(self._nodes.values()), ua.AttributeIds.Value)
        except TimeoutError:
            text = f"did not answer within {self._settings.timeout_s:g} s; is the server still running?"
            raise DeviceTimeout(self.name, text) from None
        except LOST as error:
            raise ConnectError(self.name, f"is lost ({_shorten_error(error)}); is the server still running?") from None
        except NONSENSE as error:
            raise ProtocolError(self.name, f"sends an invalid answer ({_shorten_error(error)}); compare url") from None
        if len(values) != len(self._nodes):
            raise ProtocolError(self.name, f"answered {len(values)} values instead of {len(self._nodes)}")
        return values


@contextlib.asynccontextmanager
async def _limit_time(seconds: float) -> AsyncIterator[None]:
    """Limit the time as asyncio.timeout does, also where it expires together with an answer.

    asyncua is then cancelled by its own exception class, which Python 3.11 takes for somebody else's cancellation.
    """
    async with asyncio.timeout(seconds):
        try:
            yield
        except asyncio.CancelledError:
            raise asyncio.CancelledError from None


def _convert_value(value: ua.DataValue) -> Shown:
    if value.Value is None or (value.StatusCode is not None and not value.StatusCode.is_good()):
        return None
    plain: Any = value.Value.Value
    if isinstance(plain, list | tuple):
        return tuple(plain)
    if isinstance(plain, ua.LocalizedText):
        plain = plain.Text
    return plain if isinstance(plain, bool | int | float | str) else None


def _format_status(value: ua.DataValue) -> str:
    return str(value.StatusCode.name) if value.StatusCode is not None else "no status"


def _shorten_error(error: BaseException) -> str:
    text = " ".join(str(error).split())[:120]
    return text or type(error).__name__
