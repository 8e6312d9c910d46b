"""The interface of a receive port, as the receive thread uses it."""

from typing import Literal, Protocol

from fdhil.drivers.can.frame_ring import FrameRing

Stamps = Literal["hardware", "kernel", "hub", "sender", "adapter", "host"]
"""Source of time stamps: controller, kernel, hub, sender, the adapter's firmware, this program when it reads."""

Filter = tuple[int, int]
"""An identifier with its flags, and the mask of the bits that must match."""


class BusEnded(Exception):
    """The bus of a port is gone; ``str`` is the reason. Internal to the receive thread."""


class ReceivePort(Protocol):
    """Receives from a bus, for the receive thread."""

    @property
    def stamps(self) -> Stamps:
        """Source of the newest frames' time stamps."""

    @property
    def holds_back(self) -> bool:
        """Whether unread frames wait at the sender, so that reading late loses nothing."""

    @property
    def kernel_drops(self) -> int:
        """Frames that the kernel dropped because they were not read in time."""

    def receive_frames(self, ring: FrameRing, timeout_s: float) -> None:
        """Append what arrives within ``timeout_s`` to ``ring``; BusEnded when the bus is gone."""

    def close(self) -> None:
        """Release the bus."""
