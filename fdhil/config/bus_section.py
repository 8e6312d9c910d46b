"""[bus.NAME]: a CAN bus and how it is reached."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import Field

from fdhil.config.section import Finite, Section

Whole = Annotated[int, Field(ge=-1_000_000_000, le=1_000_000_000)]
OWN_WAYS = frozenset({"socketcan", "socketcand", "virtual"})


class CanBus(Section):
    """[bus.NAME]: a CAN bus."""

    interface: Literal[
        "socketcan",
        "socketcand",
        "virtual",
        "slcan",
        "pcan",
        "kvaser",
        "gs_usb",
        "ixxat",
        "vector",
        "seeedstudio",
        "serial",
        "robotell",
        "canalystii",
        "cantact",
        "neovi",
        "systec",
        "usb2can",
    ] = Field(
        "socketcand",
        description="socketcand is a hub, virtual one process; from slcan on: python-can, for listening only",
    )
    channel: str = Field(
        "can0", description="socketcan: network interface; socketcand: bus behind the hub; else python-can's"
    )
    host: str = Field("127.0.0.1", description="socketcand: address of the hub")
    port: int = Field(0, ge=0, le=65535, description="socketcand: TCP port of the hub; 0 lets the simulator choose one")
    bitrate: int = Field(1_000_000, ge=10_000, le=1_000_000, description="bit/s, for bus load and python-can adapters")
    frames: Literal["all", "drives"] = Field(
        "all",
        description="drives: only SYNC, NMT and the drives' frames are received; bus load and black box lack "
        "the others",
    )
    listen_only: bool = Field(
        True, description="python-can: never acknowledge, so as not to disturb the bus, where supported"
    )
    offset_lead_cycles: int = Field(
        0, ge=0, le=200, description="cycles by which offsets are sent ahead: HAL 20 or more, CANopen 0"
    )
    options: Mapping[str, bool | Whole | Finite | str] = Field(
        {}, description="python-can: further arguments of its interface, e.g. { tty_baudrate = 3000000 }"
    )

    @property
    def may_send(self) -> bool:
        """Whether fdhil can send here: python-can adapters are opened for listening only."""
        return self.interface in OWN_WAYS

    @property
    def endpoint(self) -> tuple[str, ...] | None:
        """The bus it leads to; None where the simulator still has to choose the port (port 0)."""
        if self.interface != "socketcand":
            return (self.interface, self.channel)
        return (self.interface, self.channel, self.host, str(self.port)) if self.port else None
