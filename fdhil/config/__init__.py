"""The machine configuration: TOML -> frozen pydantic models, one module per part of the file.

``load`` reports all faults at once, each with its path and a suggestion. Every key is explained in
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
    Thermometer,
    Voltage,
)
from fdhil.config.controller import G0, Identification, Nc
from fdhil.config.machine import Machine, MachineConfig
from fdhil.config.offset_limits import VARIATION_MM, OffsetLimits, share_fault
from fdhil.config.reading import MAX_CONFIG_BYTES, load, parse, toml_document, unlikely
from fdhil.config.regulators import Regulators
from fdhil.config.section import AxisName, Finite, Fraction, NotNegative, Positive, Section
from fdhil.config.service import CanBus, Guard, Maintenance, Store
from fdhil.config.simulation import Noise, Sim, SimAxis, Thermal

__all__ = [
    "CEILING_ACCELERATION_MM_S2",
    "CEILING_OFFSET_UM",
    "CEILING_SPEED_MM_S",
    "G0",
    "MAX_CONFIG_BYTES",
    "VARIATION_MM",
    "Axis",
    "AxisName",
    "CanBus",
    "CorrectionLimits",
    "Drive",
    "FeedforwardLimits",
    "Finite",
    "Fraction",
    "Guard",
    "Identification",
    "Machine",
    "MachineConfig",
    "Maintenance",
    "Nc",
    "Noise",
    "Nominal",
    "NotNegative",
    "OffsetLimits",
    "Positive",
    "Regulators",
    "Section",
    "Sim",
    "SimAxis",
    "Store",
    "Thermal",
    "Thermometer",
    "Voltage",
    "load",
    "parse",
    "share_fault",
    "toml_document",
    "unlikely",
]
