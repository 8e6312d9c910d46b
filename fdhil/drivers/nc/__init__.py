"""Reads the state of an NC through an interface of its own; ``tables.NC_SOURCES`` lists the interfaces.

A source only reads: nothing it sends may change anything in the NC. It neither retries nor detects silence: its
listener (:mod:`fdhil.drivers.nc.nc_listener`) disconnects, reports the NC as UNKNOWN, and retries with growing pauses.
"""

from collections.abc import Callable, Sequence
from typing import Protocol, Self

from fdhil import tables
from fdhil.config import MachineConfig
from fdhil.errors import ConfigError, ConfigFault
from fdhil.records import NcState


class NcSource(Protocol):
    """One NC: connected, read while it answers, disconnected.

    ``name`` describes the NC and its address, as ``LinuxCNC at 127.0.0.1:5571``. A source can be entered again.
    """

    name: str

    async def __aenter__(self) -> Self:
        """Connect; ConnectError when it cannot be reached, ProtocolError when it does not match the configuration."""

    async def __aexit__(self, *_: object) -> None:
        """Disconnect; raises nothing."""

    async def read_states(self) -> Sequence[NcState]:
        """Wait for new states and return them, the oldest first; DeviceError when the NC is lost or its answer is
        invalid.

        A polling source waits for its period here, a subscribed one until something comes. A healthy NC sends something
        at least twice within ``nc_source.silence_s``, also while nothing changes.
        """


def load_nc_source(name: str) -> Callable[[MachineConfig], NcSource]:
    """Return the source that ``tables.NC_SOURCES`` lists under ``name``; ConfigError where its library is missing."""
    try:
        source: Callable[[MachineConfig], NcSource] = tables.load_entry(tables.NC_SOURCES, name)
    except ImportError as error:
        what = f"{name} needs the library {error.name}, which is not installed"
        raise ConfigError("config", [ConfigFault("g0.source", what, f"pip install 'fdhil[{name}]'")]) from None
    return source
