#!/usr/bin/env bash
# python-can writes the start of a measurement into an ASC file up to 0.9 s late, and reads it back late.
#
# Library:  python-can 4.6.1, can.ASCWriter.
# Expected: the line "Begin Triggerblock" carries the time of the first frame with three digits of milliseconds, as
#           Vector's programs write it: 22:13:20.005. Reading with relative_timestamp=False returns the recorded times.
#           The line "date" at the head of the file is the date of the measurement.
# Seen:     the milliseconds are not padded with zeros: .005 is written as .5 and means half a second to every reader,
#           .050 becomes .50. The line "date" is the time of the conversion.
# Effect:   a recording converted to ASC is shifted against other recordings (NC, sensors) by up to 0.9 s,
#           in one of ten recordings.
# Output seen:
#   first frame at 1700000000.005: written as "22:13:20.5", read back as 1700000000.500
#   first frame at 1700000000.050: written as "22:13:20.50", read back as 1700000000.500
#   first frame at 1700000000.500: written as "22:13:20.500", read back as 1700000000.500
#   the line "date" is the year of the conversion, not 2023
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -qq --disable-pip-version-check python-can==4.6.1
cd "$folder"

TZ=UTC LC_ALL=C venv/bin/python -I - <<'PYTHON'
import sys
from pathlib import Path

import can

SEEN = {".005": "22:13:20.5", ".050": "22:13:20.50", ".500": "22:13:20.500"}

for fraction, expected in SEEN.items():
    start = float(f"1700000000{fraction}")
    with can.Logger("log.asc") as logger:
        logger(can.Message(timestamp=start, arbitration_id=0x181, is_extended_id=False, data=[1], channel=0))
    lines = Path("log.asc").read_text().splitlines()
    written = next(line for line in lines if line.startswith("Begin Triggerblock")).split()[5]
    (message,) = can.LogReader("log.asc", relative_timestamp=False)
    print(f'first frame at {start:.3f}: written as "{written}", read back as {message.timestamp:.3f}')
    if written != expected or abs(message.timestamp - 1700000000.5) > 1e-6:
        sys.exit("Changed: python-can no longer writes the milliseconds of the start without leading zeros.")
if lines[0].endswith("2023"):
    sys.exit('Changed: the line "date" is now the date of the measurement.')
print('the line "date" is the year of the conversion, not 2023')
PYTHON
