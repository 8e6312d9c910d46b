"""[nc_source]: where an NC tells what it does, one section for each entry of ``tables.NC_SOURCES``."""

from __future__ import annotations

from pydantic import Field

from fdhil.config.section import Positive, Section


class LinuxCncBridge(Section):
    """[nc_source.linuxcnc]: the bridge that LinuxCNC's HAL file loads."""

    host: str = Field("127.0.0.1", min_length=1, description="the computer of LinuxCNC, if it is another")
    port: int = Field(5571, ge=1, le=65535, description="TCP port of the bridge")


class NcSource(Section):
    """[nc_source]: where the NC tells what it does, if [g0] source is the name of an NC's interface."""

    silence_s: Positive = Field(
        2.0, ge=0.05, le=60, description="an NC that says nothing for so long is not heard: its moves are unknown"
    )
    linuxcnc: LinuxCncBridge = LinuxCncBridge()
