"""Reads EDS and DCF files (CiA 306): the one reader of drivers, commissioning and simulator."""

from fdhil.eds.eds_file import INTEGER_TYPES, EdsEntry, EdsFile, EdsObject
from fdhil.eds.eds_numbers import read_expression, read_number, read_octal
from fdhil.eds.eds_reader import MAX_BYTES, MAX_OBJECTS, MAX_SECTIONS, parse_eds, read_eds

__all__ = [
    "INTEGER_TYPES",
    "MAX_BYTES",
    "MAX_OBJECTS",
    "MAX_SECTIONS",
    "EdsEntry",
    "EdsFile",
    "EdsObject",
    "parse_eds",
    "read_eds",
    "read_expression",
    "read_number",
    "read_octal",
]
