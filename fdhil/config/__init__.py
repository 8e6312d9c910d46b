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
    HalPins,
    Nominal,
    SpeedUnit,
)
from fdhil.config.axis_tables import convert_key_to_degrees, convert_key_to_mm
from fdhil.config.bus_section import CanBus
from fdhil.config.config_loader import (
    check_section,
    check_section_file,
    check_value,
    find_field,
    find_unlikely_values,
    load_config,
    load_directories,
    load_section_file,
    parse_config,
    parse_toml,
    read_toml,
)
from fdhil.config.config_template import write_filled_template
from fdhil.config.credentials import create_tls_context, read_password, read_secret
from fdhil.config.fleet_config import MACHINE_NAME_PATTERN, Fleet, Stream, load_fleet_config
from fdhil.config.machine_config import MachineConfig
from fdhil.config.nc_client_sections import OpcUaNc
from fdhil.config.nc_section import TOLERANCE_SHARE, Identification, Nc
from fdhil.config.offers_section import decode_plant_key
from fdhil.config.offset_bounds import VARIATION_MM, OffsetBounds, find_limit_faults, find_share_fault
from fdhil.config.position_range import PositionRange
from fdhil.config.publish_sections import MqttBroker, MtConnectAdapter, OpcUaServer, PrometheusMetrics
from fdhil.config.reality_section import Reality
from fdhil.config.regulators import Regulators
from fdhil.config.remote_change_policy import explain_refusal, is_loosening
from fdhil.config.section import Finite, Section, is_second_drive
from fdhil.config.sensor_sections import (
    ModbusDevice,
    SerialDevice,
    Thermometer,
    Voltage,
    VoltageBlock,
    compute_block_registers,
)
from fdhil.config.service_sections import Access, Maintenance
from fdhil.config.simulation_sections import Noise, SimAxis, Thermal
from fdhil.config.table_sensor_sections import IN_A_FRAME, Accelerometer, TableEncoder
from fdhil.config.toml_editing import NotEditable, edit_toml
from fdhil.config.uplink_section import Label, Labels, NatsServer, Uplink
from fdhil.config.user_file import (
    LONGEST_PASSWORD,
    SHORTEST_PASSWORD,
    USER_NAME_PATTERN,
    Role,
    User,
    UsersFile,
    hash_password,
    read_users,
    verify_password,
    write_users,
)
from fdhil.config.web_section import Web, is_loopback

__all__ = [
    "CEILING_ACCELERATION_MM_S2",
    "CEILING_OFFSET_UM",
    "CEILING_SPEED_MM_S",
    "IN_A_FRAME",
    "LONGEST_PASSWORD",
    "MACHINE_NAME_PATTERN",
    "SHORTEST_PASSWORD",
    "TOLERANCE_SHARE",
    "USER_NAME_PATTERN",
    "VARIATION_MM",
    "Accelerometer",
    "Access",
    "Axis",
    "CanBus",
    "CorrectionLimits",
    "Drive",
    "FeedforwardLimits",
    "Finite",
    "Fleet",
    "HalPins",
    "Identification",
    "Label",
    "Labels",
    "MachineConfig",
    "Maintenance",
    "ModbusDevice",
    "MqttBroker",
    "MtConnectAdapter",
    "NatsServer",
    "Nc",
    "Noise",
    "Nominal",
    "NotEditable",
    "OffsetBounds",
    "OpcUaNc",
    "OpcUaServer",
    "PositionRange",
    "PrometheusMetrics",
    "Reality",
    "Regulators",
    "Role",
    "Section",
    "SerialDevice",
    "SimAxis",
    "SpeedUnit",
    "Stream",
    "TableEncoder",
    "Thermal",
    "Thermometer",
    "Uplink",
    "User",
    "UsersFile",
    "Voltage",
    "VoltageBlock",
    "Web",
    "check_section",
    "check_section_file",
    "check_value",
    "compute_block_registers",
    "convert_key_to_degrees",
    "convert_key_to_mm",
    "create_tls_context",
    "decode_plant_key",
    "edit_toml",
    "explain_refusal",
    "find_field",
    "find_limit_faults",
    "find_share_fault",
    "find_unlikely_values",
    "hash_password",
    "is_loopback",
    "is_loosening",
    "is_second_drive",
    "load_config",
    "load_directories",
    "load_fleet_config",
    "load_section_file",
    "parse_config",
    "parse_toml",
    "read_password",
    "read_secret",
    "read_toml",
    "read_users",
    "verify_password",
    "write_filled_template",
    "write_users",
]
