#!/usr/bin/env bash
# canopen reads a negative default value of an EDS file as a positive number that its own type cannot hold.
#
# Library:  canopen 2.4.1, canopen.import_od and canopen.LocalNode.
# Expected: 0x60C2:02 (interpolation time index) is INTEGER8, -128 to 127 (CiA 301); vendors' EDS files give its default
#           as 0xFD, the two's complement of -3: milliseconds (CiA 402). The library reads LowLimit and HighLimit of
#           the same object in that way.
# Seen:     DefaultValue=0xFD is read as 253, above the HighLimit; LowLimit=0x80 of the same object as -128.
# Effect:   a program that computes with the default gets 10^253 s as the unit instead of 0.001 s. A LocalNode
#           made of the file cannot answer when the object is read.
# Output seen:
#   0x60C2:02 INTEGER8: default 253, low limit -128, high limit 63
#   reading it from a LocalNode: Value does not fit in specified type
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -qq --disable-pip-version-check canopen==2.4.1
cd "$folder"

cat >device.eds <<'EDS'
[DeviceInfo]
VendorName=example
[60C2]
ParameterName=Interpolation time period
ObjectType=0x9
SubNumber=2
[60C2sub0]
ParameterName=Number of entries
ObjectType=0x7
DataType=0x0005
AccessType=ro
DefaultValue=2
[60C2sub2]
ParameterName=Interpolation time index
ObjectType=0x7
DataType=0x0002
AccessType=rw
LowLimit=0x80
HighLimit=0x3F
DefaultValue=0xFD
EDS

venv/bin/python -I - <<'PYTHON'
import logging
import sys

import canopen

logging.disable()
dictionary = canopen.import_od("device.eds")
index = dictionary[0x60C2][2]
print(f"0x60C2:02 INTEGER8: default {index.default}, low limit {index.min}, high limit {index.max}")
if (index.default, index.min, index.max) != (253, -128, 63):
    sys.exit("Changed: canopen no longer reads 0xFD of an INTEGER8 as 253.")
try:
    canopen.LocalNode(1, dictionary).get_data(0x60C2, 2)
except ValueError as error:
    print("reading it from a LocalNode:", error)
else:
    sys.exit("Changed: a LocalNode answers with this default.")
PYTHON
