#!/usr/bin/env bash
# canopen drops octal default values of an EDS file without a message.
#
# Library:  canopen 2.4.1, canopen.import_od.
# Expected: CiA 306-1 allows decimal, hexadecimal (0x) and octal (leading 0) numbers, as in C. It lists 10, 0xa, 0x0a,
#           0xA, 0x000A and 012 as the same value (quoted in CANopenEditor's issue 221). C's strtol with base 0, which
#           printf of the shell uses, reads 012 as 10 too.
# Seen:     the first five are read as 10. For 012 the default is None: Python's int("012", 0) raises ValueError, and
#           the library ignores that for DefaultValue, ParameterValue and the limits. In [DeviceInfo] the same
#           spelling makes the library refuse the whole file.
# Effect:   an object loses its default or its limits, and no message reports it.
# Output seen:
#   canopen: 10 -> 10, 0xa -> 10, 0x0a -> 10, 0xA -> 10, 0x000A -> 10, 012 -> None
#   printf:  012 -> 10
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -qq --disable-pip-version-check canopen==2.4.1
cd "$folder"

venv/bin/python -I - <<'PYTHON'
import sys
from pathlib import Path

import canopen

SPELLINGS = ("10", "0xa", "0x0a", "0xA", "0x000A", "012")
OBJECT = """[{index:04X}]
ParameterName=parameter {index:04X}
ObjectType=0x7
DataType=0x0007
AccessType=rw
DefaultValue={value}
"""

text = "[DeviceInfo]\nVendorName=example\n"
text += "".join(OBJECT.format(index=0x2000 + n, value=value) for n, value in enumerate(SPELLINGS))
Path("device.eds").write_text(text)
dictionary = canopen.import_od("device.eds")
defaults = [dictionary[0x2000 + n].default for n in range(len(SPELLINGS))]
print("canopen:", ", ".join(f"{spelling} -> {default}" for spelling, default in zip(SPELLINGS, defaults, strict=True)))
if defaults != [10, 10, 10, 10, 10, None]:
    sys.exit("Changed: canopen no longer drops octal default values.")
PYTHON
echo "printf:  012 -> $(printf %d 012)"
