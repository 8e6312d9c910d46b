"""Writes small EDS files from a list of objects: (index, sub-index, data type, access, mappable, default)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

I8, I16, I32, U8, U16, U32 = 2, 3, 4, 5, 6, 7
Variable = tuple[int, int, int, str, int, int | None]

COMMON: tuple[Variable, ...] = (
    (0x1000, 0, U32, "ro", 0, 0x00020192),
    (0x1005, 0, U32, "rw", 0, 0x80),
    (0x1016, 1, U32, "rw", 0, 0),
    (0x1017, 0, U16, "rw", 0, 0),
    (0x1018, 1, U32, "ro", 0, 0x12),
    (0x6040, 0, U16, "rww", 1, 0),
    (0x6041, 0, U16, "ro", 1, None),
    (0x6060, 0, I8, "rww", 1, 0),
    (0x6061, 0, I8, "ro", 1, None),
    (0x6062, 0, I32, "ro", 1, None),
    (0x6064, 0, I32, "ro", 1, None),
    (0x606C, 0, I32, "ro", 1, None),
    (0x607A, 0, I32, "rww", 1, None),
    (0x60FD, 0, U32, "ro", 1, None),
    (0x6502, 0, U32, "ro", 0, 0x80),
)
OFFSETS: tuple[Variable, ...] = (
    (0x60B0, 0, I32, "rw", 1, 0),
    (0x60B1, 0, I32, "rw", 1, 0),
    (0x60B2, 0, I16, "rw", 1, 0),
)
CURRENT: tuple[Variable, ...] = ((0x6075, 0, U32, "rw", 0, 5000), (0x6078, 0, I16, "ro", 1, None))


def build_pdo_objects(
    count: int = 4, room: int = 8, access: str = "rw", mapped: Mapping[int, Sequence[int]] | None = None
) -> list[Variable]:
    """Return communication and mapping parameters; ``mapped`` are the words of 1600, 1601, ... and 1A00, ..."""
    found: list[Variable] = []
    for place in range(count):
        for parameter, mapping, cob in ((0x1400, 0x1600, 0x200), (0x1800, 0x1A00, 0x180)):
            words = list((mapped or {}).get(mapping + place, ()))
            found += [
                (parameter + place, 1, U32, "rw", 0, cob + 0x100 * place),
                (parameter + place, 2, U8, "rw", 0, 255),
            ]
            found.append((mapping + place, 0, U8, access, 0, len(words)))
            found += [
                (mapping + place, k, U32, access, 0, word) for k, word in enumerate((words + [0] * room)[:room], 1)
            ]
    return found


SERVO: tuple[Variable, ...] = (*COMMON, *OFFSETS, *CURRENT, *build_pdo_objects())


def format_eds(
    variables: Sequence[Variable], vendor: str = "A Maker", vendor_id: int = 0x12, product: str = "A Drive"
) -> str:
    """Return the file; COB-IDs of PDOs get $NODEID."""
    lines = ["[DeviceInfo]", f"VendorName={vendor}", f"VendorNumber={vendor_id:#x}", f"ProductName={product}"]
    indices = sorted({index for index, *_ in variables})
    for index in indices:
        subs = sorted(variable for variable in variables if variable[0] == index)
        if len(subs) == 1 and subs[0][1] == 0:
            lines += [f"[{index:04X}]", "ObjectType=7", *_format_variable(subs[0])]
            continue
        lines += [f"[{index:04X}]", f"ParameterName=Object {index:04X}", "ObjectType=9", f"SubNumber={len(subs)}"]
        for each in subs:
            lines += [f"[{index:04X}sub{each[1]:X}]", *_format_variable(each)]
    return "\n".join([*lines, ""])


def _format_variable(each: Variable) -> list[str]:
    index, sub, kind, access, mappable, default = each
    lines = [f"ParameterName={NAMES.get((index, sub), f'Object {index:04X} {sub}')}", f"DataType={kind}"]
    lines += [f"AccessType={access}", f"PDOMapping={mappable}"]
    if default is not None:
        node = "$NODEID+" if 0x1400 <= index < 0x1C00 and index & 0x200 == 0 and sub == 1 else ""
        lines.append(f"DefaultValue={node}{default:#x}")
    return lines


NAMES: Mapping[tuple[int, int], str] = {
    (0x2360, 0): "Output voltage demand value",
    (0x2200, 1): "Power supply voltage",
    (0x30D1, 2): "Motor current actual value",
    (0x3203, 1): "PWM duty cycle actual value",
}


def write_eds_file(folder: Path, variables: Sequence[Variable], vendor: str = "A Maker", vendor_id: int = 0x12) -> Path:
    """Write the file and return its path."""
    path = folder / "drive.eds"
    path.write_text(format_eds(variables, vendor, vendor_id))
    return path
