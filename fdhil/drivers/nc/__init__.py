"""Tells what an NC does, by an interface of its own; ``tables.NC_SOURCES`` lists the ways.

A source only asks and reads: nothing it sends may change anything in the NC. It does not try again by itself, nor tell
silence: whoever listens to it (:mod:`fdhil.drivers.nc.listener`) leaves it, says that the NC is UNKNOWN, waits longer
and longer, and enters it anew.
"""

from collections.abc import Callable, Sequence
from typing import Protocol, Self

from fdhil import tables
from fdhil.config import MachineConfig
from fdhil.errors import ConfigError, ConfigFault
from fdhil.records import NcState


class NcSource(Protocol):
    """One NC: entered, read for as long as it answers, left.

    ``name`` tells people which NC it is and where, as ``LinuxCNC at 127.0.0.1:5571``. A source can be entered again.
    """

    name: str

    async def __aenter__(self) -> Self:
        """Connect; ConnectError when nobody answers there, ProtocolError when it is not what the config says."""

    async def __aexit__(self, *_: object) -> None:
        """Disconnect; raises nothing."""

    async def read(self) -> Sequence[NcState]:
        """Wait for what is new and return it, the oldest first; DeviceError when the NC is lost or answers nonsense.

        A source that asks rests for its period here. One that is told waits until something comes; an NC that is
        well says something at least twice within ``nc_source.silence_s``, also while nothing changes.
        """


def load_nc_source(name: str) -> Callable[[MachineConfig], NcSource]:
    """Return the source that ``tables.NC_SOURCES`` lists under ``name``; ConfigError where its library lacks."""
    try:
        source: Callable[[MachineConfig], NcSource] = tables.load(tables.NC_SOURCES, name)
    except ImportError as error:
        what = f"{name} needs the library {error.name}, which is not installed"
        raise ConfigError("config", [ConfigFault("g0.source", what, f"pip install 'fdhil[{name}]'")]) from None
    return source
