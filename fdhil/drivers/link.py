"""What the connection to a sensor that is a device of its own must be able to do."""

from typing import Protocol

from fdhil.errors import DeviceError


class Link(Protocol):
    """The connection to a sensor; ``wire`` names its kind, ``place`` tells people where it leads."""

    wire: str
    place: str

    @property
    def connected(self) -> bool:
        """Whether it stands."""

    async def connect(self) -> None:
        """Connect where it does not stand; ConnectError when nobody answers there."""

    def fault_code(self, error: DeviceError) -> str | None:
        """Return the class under which ``error`` is told; None for what passes by itself."""

    def close(self) -> None:
        """End the connection."""
