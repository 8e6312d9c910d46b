"""What a way onto a CAN bus is, as the receive thread needs it."""

from typing import Literal, Protocol

from fdhil.drivers.can.frames import FrameRing

Stamps = Literal["hardware", "kernel", "hub", "sender", "adapter", "host"]
"""Who stamps the frames: controller, kernel, hub, sender, the adapter's firmware, this program when it reads them."""

Filter = tuple[int, int]
"""An identifier with its flags and the mask of the bits that must be the same."""


class BusEnded(Exception):
    """The bus under a port is gone; ``str`` says why. Internal to the receive thread."""


class Port(Protocol):
    """A way onto a bus, as its receive thread needs it."""

    @property
    def stamps(self) -> Stamps:
        """Who stamped the newest frames."""

    @property
    def holds_back(self) -> bool:
        """Whether what is not read waits at the sender, so that nothing is lost by reading late."""

    @property
    def kernel_drops(self) -> int:
        """Frames the kernel dropped because they were not read in time."""

    def receive(self, ring: FrameRing, timeout_s: float) -> None:
        """Append what arrives within ``timeout_s`` to ``ring``; BusEnded when the bus is gone."""

    def close(self) -> None:
        """Release the bus."""
