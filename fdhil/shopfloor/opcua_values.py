"""Makes OPC UA data of published items: values with type, quality and time, units, node IDs. Pure."""

from collections.abc import Mapping
from datetime import UTC
from typing import Any

from asyncua import ua

from fdhil.shopfloor.published_items import Kind, PublishedValue

TYPES: Mapping[Kind, ua.VariantType] = {
    "measure": ua.VariantType.Double,
    "count": ua.VariantType.Int64,
    "flag": ua.VariantType.Boolean,
    "state": ua.VariantType.String,
    "text": ua.VariantType.String,
}
ZEROS: Mapping[ua.VariantType, Any] = {
    ua.VariantType.Double: 0.0,
    ua.VariantType.Int64: 0,
    ua.VariantType.Boolean: False,
    ua.VariantType.String: "",
}
# unit: common code of UNECE Recommendation 20, symbol, name
UNITS: Mapping[str, tuple[str, str, str]] = {
    "1": ("C62", "", "one"),
    "%": ("P1", "%", "percent"),
    "s": ("SEC", "s", "second"),
    "Hz": ("HTZ", "Hz", "hertz"),
    "um": ("4H", "µm", "micrometre"),
    "mm/min": ("H81", "mm/min", "millimetre per minute"),
    "degC": ("CEL", "°C", "degree Celsius"),
    "ohm": ("OHM", "Ω", "ohm"),
    "H": ("81", "H", "henry"),
    "N.m/A": ("F90", "N·m/A", "newton metre per ampere"),
    "kg.m2": ("B32", "kg·m²", "kilogram metre squared"),
    "N.m.s": ("C53", "N·m·s", "newton metre second"),
    "N.m": ("NU", "N·m", "newton metre"),
}


def make_data_value(value: PublishedValue, why: int) -> ua.DataValue:
    """Return a value with its quality and time; an unknown one has the status ``why``."""
    if value.value is None:
        return make_unknown_value(why, value.stamp_ms)
    kind = TYPES[value.item.kind]
    plain: Any = float(value.value) if kind is ua.VariantType.Double else value.value
    return ua.DataValue(ua.Variant(plain, kind), SourceTimestamp=_convert_time(value.stamp_ms))


def make_unknown_value(why: int, stamp_ms: int) -> ua.DataValue:
    """Return an empty value with the status ``why``."""
    status = ua.StatusCode(ua.UInt32(why))
    return ua.DataValue(ua.Variant(), StatusCode=status, SourceTimestamp=_convert_time(stamp_ms))


def _convert_time(stamp_ms: int) -> ua.DateTime:
    return ua.DateTime.fromtimestamp(stamp_ms * 1e-3, UTC)


def make_node_id(identifier: int | str, namespace: int = 0) -> ua.NodeId:
    """Return a node ID from its number or name."""
    known = ua.Int32(identifier) if isinstance(identifier, int) else ua.String(identifier)
    return ua.NodeId(known, ua.Int16(namespace))


def make_unit(unit: str) -> ua.EUInformation:
    """Return a unit in OPC UA's form: the letters of its common code, one byte each, are its number."""
    code, symbol, name = UNITS[unit]
    return ua.EUInformation(
        NamespaceUri="http://www.opcfoundation.org/UA/units/un/cefact",
        UnitId=int.from_bytes(code.encode(), "big"),
        DisplayName=ua.LocalizedText(symbol, "en"),
        Description=ua.LocalizedText(name, "en"),
    )
