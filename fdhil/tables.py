"""Literal registries: name -> "module:factory" (a profile: "package:file"). A listed entry is tested.

Nothing registers itself. Config checks names against these tables without importing the rooms behind them.
"""

from collections.abc import Mapping
from importlib import import_module
from typing import Any

ESTIMATORS: Mapping[str, str] = {
    "least_squares": "fdhil.identification.estimators.least_squares:estimate",
    "partial_moments": "fdhil.identification.estimators.partial_moments:estimate",
    "maximum_likelihood": "fdhil.identification.estimators.maximum_likelihood:estimate",
}
DEFAULT_ESTIMATOR = "maximum_likelihood"
CORRECTIONS: Mapping[str, str] = {
    "mirror": "fdhil.correction.mirror:plan_mirror_offsets",
    "flatness": "fdhil.correction.flatness_feedforward:plan_feedforward",
    "inverse": "fdhil.correction.inverse:plan_inverse_offsets",
}
DEFAULT_CORRECTION = "inverse"
REGULATORS: Mapping[str, str] = {
    "p_pi_pi": "fdhil.model.p_pi_pi:prepare",
    "double_pi": "fdhil.model.double_pi:prepare",
    "pid": "fdhil.model.pid:prepare",
    "linuxcnc_pid": "fdhil.model.linuxcnc_pid:prepare",
}
DRIVE_VOLTAGE = "drive"  # comes with the drive's samples; every other source is a sensor of its own
VOLTAGE_SOURCES: Mapping[str, str] = {
    "drive": "fdhil.drivers.cia402.pdo_decoder:VoltageObject",
    "modbus": "fdhil.drivers.modbus.voltage_source:create_modbus_voltage",
    "serial": "fdhil.drivers.serial.text_instrument:create_serial_voltage",
}
NC_SOURCES: Mapping[str, str] = {
    "linuxcnc": "fdhil.drivers.nc.linuxcnc_source:LinuxCncSource",
    "modbus_coil": "fdhil.drivers.nc.modbus_coil:ModbusCoilSource",
    "mtconnect": "fdhil.drivers.nc.mtconnect_source:MtConnectSource",
    "opcua": "fdhil.drivers.nc.opcua_source:OpcUaSource",
}
NC_PROFILES: Mapping[str, str] = {
    "mtconnect": "fdhil.drivers.nc.profiles:mtconnect.toml",
    "opc40502": "fdhil.drivers.nc.profiles:opc40502.toml",
    "siemens": "fdhil.drivers.nc.profiles:siemens.toml",
    "heidenhain": "fdhil.drivers.nc.profiles:heidenhain.toml",
    "beckhoff": "fdhil.drivers.nc.profiles:beckhoff.toml",
}
EVENT_SOURCES: Mapping[str, str] = {
    "inferred": "fdhil.drivers.moves.inferred_moves:InferredMoves",
    "digital_input": "fdhil.drivers.moves.digital_input_moves:DigitalInputMoves",
    **dict.fromkeys(NC_SOURCES, "fdhil.drivers.moves.nc_reported_moves:NcReportedMoves"),
}
# file formats of recordings: modules that encode and decode
RECORDING_FORMATS: Mapping[str, str] = {
    "csv": "fdhil.store.recording_csv",
    "parquet": "fdhil.store.recording_parquet",
    "mat": "fdhil.store.recording_mat",
    "mdf4": "fdhil.store.recording_mdf4",
    "hdf5": "fdhil.store.recording_hdf5",
}
DRIVE_PROFILES: Mapping[str, str] = {
    "fdhil_twin": "fdhil.drivers.cia402.profiles:fdhil_twin.toml",
    "cia402": "fdhil.drivers.cia402.profiles:cia402.toml",
    "epos4": "fdhil.drivers.cia402.profiles:epos4.toml",
    "epos2": "fdhil.drivers.cia402.profiles:epos2.toml",
    "nanotec": "fdhil.drivers.cia402.profiles:nanotec.toml",
    "elmo": "fdhil.drivers.cia402.profiles:elmo.toml",
    "technosoft": "fdhil.drivers.cia402.profiles:technosoft.toml",
    "trinamic": "fdhil.drivers.cia402.profiles:trinamic.toml",
    "faulhaber": "fdhil.drivers.cia402.profiles:faulhaber.toml",
    "schunk": "fdhil.drivers.cia402.profiles:schunk.toml",
    "infranor": "fdhil.drivers.cia402.profiles:infranor.toml",
    "hal": "fdhil.drivers.cia402.profiles:hal.toml",
    "roboteq": "fdhil.drivers.cia402.profiles:roboteq.toml",
}
PUBLISHERS: Mapping[str, str] = {
    "opcua": "fdhil.shopfloor.opcua_server:publish",
    "mqtt": "fdhil.shopfloor.mqtt_publisher:publish",
    "mtconnect": "fdhil.shopfloor.mtconnect_adapter:publish",
    "prometheus": "fdhil.shopfloor.prometheus_endpoint:publish",
}


def load_entry(table: Mapping[str, str], name: str) -> Any:
    """Import and return the factory or module that ``table`` lists under ``name``; KeyError for an unknown name."""
    module, _, attribute = table[name].partition(":")
    return getattr(import_module(module), attribute) if attribute else import_module(module)
