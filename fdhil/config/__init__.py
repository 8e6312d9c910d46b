"""The machine configuration: TOML -> frozen pydantic models, one module per part of the file.

``load_config`` reports all faults at once, each with its path and a suggestion. Every key is explained in
``configs/machine-template.toml``; the ``description`` of each field here is where that text comes from.
"""

from __future__ import annotations

from fdhil.config.axis_section import (
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
from fdhil.config.bus_section import CanBus
from fdhil.config.config_loader import (
    find_unlikely_values,
    load_config,
    load_directories,
    parse_config,
    parse_toml,
    read_toml,
)
from fdhil.config.machine_config import MachineConfig
from fdhil.config.nc_section import Identification, Nc
from fdhil.config.offset_bounds import VARIATION_MM, OffsetBounds, find_share_fault
from fdhil.config.position_range import PositionRange
from fdhil.config.reality_section import Reality
from fdhil.config.regulators import Regulators
from fdhil.config.section import Section, is_second_drive
from fdhil.config.sensor_sections import Thermometer, Voltage
from fdhil.config.service_sections import Access, Maintenance
from fdhil.config.simulation_sections import Noise, SimAxis, Thermal
from fdhil.config.table_sensor_sections import Accelerometer, TableEncoder

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
    "find_share_fault",
    "find_unlikely_values",
    "is_second_drive",
    "load_config",
    "load_directories",
    "parse_config",
    "parse_toml",
    "read_toml",
]
