"""The interface of a connection to a separate sensor."""

from typing import Protocol

from fdhil.errors import DeviceError


class SensorConnection(Protocol):
    """The connection to a sensor; ``wire`` names its kind, ``place`` describes its endpoint in messages."""

    wire: str
    place: str

    @property
    def is_connected(self) -> bool:
        """Whether it is established."""

    async def connect(self) -> None:
        """Connect if not yet connected; ConnectError when the sensor cannot be reached."""

    def classify_fault(self, error: DeviceError) -> str | None:
        """Return the notice code of ``error``; None for a transient one."""

    def close(self) -> None:
        """End the connection."""
