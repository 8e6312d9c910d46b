"""The machine configuration: TOML -> frozen pydantic models, one module per part of the file.

``load_config`` reports all faults at once, each with its path and a suggestion. Every key is explained in
``configs/machine-template.toml``; the ``description`` of each field here is where that text comes from.
"""

from __future__ import annotations

from fdhil.config.axis import (
    CEILING_ACCELERATION_MM_S2,
    CEILING_OFFSET_UM,
    CEILING_SPEED_MM_S,
    Axis,
    CorrectionLimits,
    Drive,
    FeedforwardLimits,
    Nominal,
    SpeedUnit,
)
from fdhil.config.bus import CanBus
from fdhil.config.controller import Identification, Nc
from fdhil.config.machine import MachineConfig
from fdhil.config.offset_bounds import VARIATION_MM, OffsetBounds, share_fault
from fdhil.config.position_range import PositionRange
from fdhil.config.reading import load, load_places, parse, read_toml, toml_document, unlikely
from fdhil.config.reality import Reality
from fdhil.config.regulators import Regulators
from fdhil.config.section import Section, is_second_drive
from fdhil.config.sensors import Thermometer, Voltage
from fdhil.config.service import Access, Maintenance
from fdhil.config.simulation import Noise, SimAxis, Thermal
from fdhil.config.table import Accelerometer, TableEncoder

__all__ = [
    "CEILING_ACCELERATION_MM_S2",
    "CEILING_OFFSET_UM",
    "CEILING_SPEED_MM_S",
    "VARIATION_MM",
    "Accelerometer",
    "Access",
    "Axis",
    "CanBus",
    "CorrectionLimits",
    "Drive",
    "FeedforwardLimits",
    "Identification",
    "MachineConfig",
    "Maintenance",
    "Nc",
    "Noise",
    "Nominal",
    "OffsetBounds",
    "PositionRange",
    "Reality",
    "Regulators",
    "Section",
    "SimAxis",
    "SpeedUnit",
    "TableEncoder",
    "Thermal",
    "Thermometer",
    "Voltage",
    "is_second_drive",
    "load",
    "load_places",
    "parse",
    "read_toml",
    "share_fault",
    "toml_document",
    "unlikely",
]
