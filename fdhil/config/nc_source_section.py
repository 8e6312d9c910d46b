"""[nc_source]: where the NC reports its state, one section for each entry of ``tables.NC_SOURCES``."""

from __future__ import annotations

from pathlib import Path
from typing import Self

from pydantic import Field, model_validator

from fdhil.config.nc_client_sections import ModbusNc, MtConnectNc, OpcUaNc, PolledNc
from fdhil.config.section import Positive, Section


class LinuxCncBridge(Section):
    """[nc_source.linuxcnc]: the bridge that LinuxCNC's HAL file loads."""

    host: str = Field("127.0.0.1", min_length=1, description="the computer of LinuxCNC, if it is not this one")
    port: int = Field(5571, ge=1, le=65535, description="TCP port of the bridge")


class NcSource(Section):
    """[nc_source]: where the NC reports its state, if [g0] source names an NC interface."""

    silence_s: Positive = Field(2.0, ge=0.05, le=60, description="after so long a silence the NC's moves are unknown")
    linuxcnc: LinuxCncBridge = LinuxCncBridge()
    modbus_coil: ModbusNc = ModbusNc()
    mtconnect: MtConnectNc = MtConnectNc()
    opcua: OpcUaNc = OpcUaNc()

    @model_validator(mode="after")
    def _check_periods(self) -> Self:
        asked: tuple[ModbusNc | PolledNc, ...] = (self.modbus_coil, self.mtconnect, self.opcua)
        names = ("modbus_coil", "mtconnect", "opcua")
        slow = [name for name, source in zip(names, asked, strict=True) if source.period_s > self.silence_s / 2]
        if slow:
            raise ValueError("\n".join(f"{name}.period_s: is more than half of silence_s" for name in slow))
        return self

    def resolve_paths(self, folder: Path) -> Self:
        return self.model_copy(
            update={"mtconnect": self.mtconnect.resolve_paths(folder), "opcua": self.opcua.resolve_paths(folder)}
        )
