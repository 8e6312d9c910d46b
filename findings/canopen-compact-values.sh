#!/usr/bin/env bash
# canopen ignores the values of a compactly stored array in a DCF file and returns the defaults instead.
#
# Library:  canopen 2.4.1, canopen.import_od and canopen.LocalNode.
# Expected: CiA 306 stores an array as one section with CompactSubObj=4 and, in a DCF, the values that differ as
#           [2001Value]. dcf-tools 2.4.2, of Lely's CANopen stack, reads it so: sub-index 0 is 4, 1 is 11, 3 is 33.
# Seen:     the library supports CompactSubObj but not [xxxxValue]: every entry keeps the default, 7. Sub-index 0 has no
#           value, and there is a sub-index 5 that the device does not have.
# Effect:   a device configured from such a file gets the defaults, without a message.
# Output seen:
#   dcf-tools: 0 -> 4, 1 -> 11, 2 -> 7, 3 -> 33, 4 -> 7, 5 -> no such entry
#   canopen:   0 -> no value, 1 -> 7, 2 -> 7, 3 -> 7, 4 -> 7, 5 -> 7
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -qq --disable-pip-version-check canopen==2.4.1 dcf-tools==2.4.2 setuptools==65.5.0
cd "$folder"

cat >device.dcf <<'DCF'
[FileInfo]
FileName=device.dcf
FileVersion=1
FileRevision=0
EDSVersion=4.0
[DeviceInfo]
VendorName=example
VendorNumber=0x1
ProductName=example
ProductNumber=1
RevisionNumber=1
OrderCode=1
BaudRate_500=1
Granularity=8
NrOfRxPDO=0
NrOfTxPDO=0
LSS_Supported=0
[DeviceComissioning]
NodeID=5
NodeName=axis
Baudrate=500
[DummyUsage]
Dummy0001=1
Dummy0002=1
Dummy0003=1
Dummy0004=1
Dummy0005=1
Dummy0006=1
Dummy0007=1
[MandatoryObjects]
SupportedObjects=3
1=0x1000
2=0x1001
3=0x1018
[OptionalObjects]
SupportedObjects=0
[ManufacturerObjects]
SupportedObjects=1
1=0x2001
[1000]
ParameterName=Device type
DataType=0x0007
AccessType=ro
DefaultValue=0x00020192
[1001]
ParameterName=Error register
DataType=0x0005
AccessType=ro
[1018]
ParameterName=Identity
ObjectType=0x09
SubNumber=2
[1018sub0]
ParameterName=Number of entries
DataType=0x0005
AccessType=const
DefaultValue=1
[1018sub1]
ParameterName=Vendor-ID
DataType=0x0007
AccessType=ro
DefaultValue=0x1
[2001]
ParameterName=Position table
ObjectType=0x08
DataType=0x0006
AccessType=rw
DefaultValue=7
CompactSubObj=4
[2001Value]
NrOfEntries=2
1=11
3=33
DCF

venv/bin/python -I - <<'PYTHON'
import sys

import canopen
from dcf.device import Device

EXPECTED = [4, 11, 7, 33, 7, "no such entry"]
SEEN = ["no value", 7, 7, 7, 7, 7]


def describe(values):
    return ", ".join(f"{index} -> {value}" for index, value in enumerate(values))


def read_from(node, index):
    try:
        return int.from_bytes(node.get_data(0x2001, index), "little")
    except canopen.SdoAbortedError:
        return "no value"


table = Device.from_dcf("device.dcf")[0x2001]
by_dcf_tools = [table[index].parse_value() if index in table else "no such entry" for index in range(6)]
node = canopen.LocalNode(5, canopen.import_od("device.dcf"))
by_canopen = [read_from(node, index) for index in range(6)]
print("dcf-tools:", describe(by_dcf_tools))
print("canopen:  ", describe(by_canopen))
if by_dcf_tools != EXPECTED:
    sys.exit("Changed: dcf-tools no longer reads the compact values as described.")
if by_canopen != SEEN:
    sys.exit("Changed: canopen no longer ignores the values of a compactly stored array.")
PYTHON
