"""Writes the electronic data sheet of the drive as EDS 4.0 text (CiA 306)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from fdhil.sim.drive.object_dictionary import DOMAIN_OBJECT, VAR, DictionaryObject, Entry

if TYPE_CHECKING:
    from fdhil.sim.drive.servo_drive import SimulatedDrive

_MANDATORY = (0x1000, 0x1001, 0x1018)
_HEAD = """\
[FileInfo]
FileName={file}
FileVersion=1
FileRevision=0
EDSVersion=4.0
Description=Simulated CiA 402 servo drive
CreationTime=12:00AM
CreationDate=01-01-2026
CreatedBy=fdhil
ModificationTime=12:00AM
ModificationDate=01-01-2026
ModifiedBy=fdhil

[DeviceInfo]
VendorName=fdhil
VendorNumber=0x{dress.vendor:08X}
ProductName={dress.name}
ProductNumber=0x{dress.product:08X}
RevisionNumber=0x{dress.revision:08X}
OrderCode=twin
BaudRate_10=0
BaudRate_20=0
BaudRate_50=0
BaudRate_125=1
BaudRate_250=1
BaudRate_500=1
BaudRate_800=1
BaudRate_1000=1
SimpleBootUpMaster=0
SimpleBootUpSlave=1
Granularity=8
DynamicChannelsSupported=0
CompactPDO=0
GroupMessaging=0
NrOfRXPDO={rpdos}
NrOfTXPDO={tpdos}
LSS_Supported=1

[DummyUsage]
Dummy0001=0
Dummy0002=1
Dummy0003=1
Dummy0004=1
Dummy0005=1
Dummy0006=1
Dummy0007=1

[Comments]
Lines=1
Line1=Position objects in increments, speeds in increments/s
"""


def format_eds(drive: SimulatedDrive) -> str:
    """Return the drive's EDS; its defaults are the power-on values, COB-IDs relative to $NODEID."""
    groups: dict[str, list[DictionaryObject]] = {
        "MandatoryObjects": [],
        "OptionalObjects": [],
        "ManufacturerObjects": [],
    }
    for item in drive.dictionary:
        if item.index in _MANDATORY:
            groups["MandatoryObjects"].append(item)
        elif 0x2000 <= item.index < 0x6000:
            groups["ManufacturerObjects"].append(item)
        else:
            groups["OptionalObjects"].append(item)
    rpdos, tpdos = (len(list(drive.pdo.list_numbers(direction))) for direction in ("rpdo", "tpdo"))
    parts = [_HEAD.format(file=f"fdhil_twin_{drive.axis}.eds", dress=drive.emulation, rpdos=rpdos, tpdos=tpdos)]
    for name, items in groups.items():
        numbered = "".join(f"{n}=0x{item.index:04X}\n" for n, item in enumerate(items, 1))
        parts.append(f"[{name}]\nSupportedObjects={len(items)}\n{numbered}")
        parts += [_format_object(item, drive.node_id) for item in items]
    return "\n".join(parts)


def write_eds(drive: SimulatedDrive, path: Path) -> Path:
    """Write the drive's EDS to ``path`` and return the path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(format_eds(drive), encoding="utf-8")
    return path


def _format_object(item: DictionaryObject, node_id: int) -> str:
    if item.kind in (VAR, DOMAIN_OBJECT):
        return _format_entry(f"{item.index:04X}", item.entries[0], item.kind, node_id)
    head = f"[{item.index:04X}]\nParameterName={item.name}\nObjectType=0x{item.kind:X}\nSubNumber={len(item.entries)}\n"
    subs = [_format_entry(f"{item.index:04X}sub{entry.sub:X}", entry, VAR, node_id) for entry in item.entries]
    return "\n".join([head, *subs])


def _format_entry(section: str, entry: Entry, kind: int, node_id: int) -> str:
    lines = [
        f"[{section}]",
        f"ParameterName={entry.name}",
        f"ObjectType=0x{kind:X}",
        f"DataType=0x{entry.type:04X}",
        f"AccessType={entry.access}",
    ]
    if kind != DOMAIN_OBJECT:
        lines.append(f"PDOMapping={int(entry.mappable)}")
    if isinstance(entry.default, bytes):
        if kind == VAR:
            lines.append(f"DefaultValue={entry.default.decode('latin-1')}")
    elif entry.node_relative:
        lines.append(f"DefaultValue=$NODEID+0x{entry.default - node_id:X}")
    else:
        lines.append(f"DefaultValue={entry.default}")
    if entry.low is not None:
        lines.append(f"LowLimit={entry.low}")
    if entry.high is not None:
        lines.append(f"HighLimit={entry.high}")
    return "\n".join(lines) + "\n"
