#!/usr/bin/env bash
# canmatrix imports PDOs from an EDS file that the device does not send.
#
# Library:  canmatrix 1.2, canmatrix.formats.load(..., "eds"); it reads the file by canopen 2.4.1.
# Expected: CiA 301, 7.5.2.37: bit 31 of the COB-ID of a PDO says that the PDO does not exist or is not valid. canopen
#           itself has this bit as PdoMap.enabled.
# Seen:     the bit is dropped. TPDO2 with the default $NODEID+0xC0000280 is a frame 0x285 like any other.
# Effect:   EDS files list all PDOs that a drive may have, most of them invalid by default. The matrix, and a DBC file
#           made of it, then has frames that never come; their identifiers may belong to another node, whose frames are
#           decoded as this drive's position.
# Output seen:
#   canopen:   TPDO1 0x185 enabled, TPDO2 0x285 not enabled
#   canmatrix: TPDO1 0x185, TPDO2 0x285
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -qq --disable-pip-version-check canmatrix==1.2 canopen==2.4.1
cd "$folder"

cat > drive.eds <<'EDS'
[FileInfo]
FileName=drive.eds
EDSVersion=4.0
[DeviceInfo]
VendorName=example
ProductName=drive
[MandatoryObjects]
SupportedObjects=1
1=0x1000
[1000]
ParameterName=Device type
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue=0x00020192
[OptionalObjects]
SupportedObjects=5
1=0x1800
2=0x1801
3=0x1A00
4=0x1A01
5=0x6064
[6064]
ParameterName=Position actual value
ObjectType=0x7
DataType=0x0004
AccessType=ro
PDOMapping=1
EDS
venv/bin/python -I -W ignore - <<'PYTHON'
import logging
import sys

logging.disable()
RECORD = "[{0}]\nParameterName={1}\nObjectType=0x9\nSubNumber=3\n"
VARIABLE = "[{0}sub{1}]\nParameterName=entry {1}\nObjectType=0x7\nDataType={2}\nAccessType=rw\nDefaultValue={3}\n"
with open("drive.eds", "a", encoding="ascii") as file:
    for number, cob_id in ((0, "$NODEID+0x40000180"), (1, "$NODEID+0xC0000280")):
        for index, values in ((f"180{number}", (2, cob_id, 1)), (f"1A0{number}", (1, "0x60640020"))):
            file.write(RECORD.format(index, f"TPDO{number + 1}"))
            for sub, value in enumerate(values):
                data_type = "0x0007" if isinstance(value, str) else "0x0005"
                file.write(VARIABLE.format(index, sub, data_type, value))

import canmatrix.formats
import canopen

node = canopen.RemoteNode(5, "drive.eds")
cob_ids = {number: node.object_dictionary[0x17FF + number][1].default for number in (1, 2)}
enabled = {number: not cob_id & 1 << 31 for number, cob_id in cob_ids.items()}
words = [f"TPDO{n} {cob_ids[n] & 0x7FF:#x} {'enabled' if enabled[n] else 'not enabled'}" for n in cob_ids]
print(f"canopen:   {', '.join(words)}")
with open("drive.eds", "rb") as file:
    matrix = canmatrix.formats.load(file, "eds", eds_node_id=5)[""]
frames = {frame.name: frame.arbitration_id.id for frame in matrix.frames if frame.name.startswith("TPDO")}
print(f"canmatrix: {', '.join(f'{name} {identifier:#x}' for name, identifier in frames.items())}")
if enabled != {1: True, 2: False} or frames.get("TPDO1") != 0x185:
    sys.exit("Changed: the valid PDO is no longer imported as it was.")
if frames != {"TPDO1": 0x185, "TPDO2": 0x285}:
    sys.exit("Changed: canmatrix now heeds bit 31 of a PDO's COB-ID.")
PYTHON
