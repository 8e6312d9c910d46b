#!/usr/bin/env bash
# python-can ignores "timestamps relative" in an ASC file: all frames get nearly the same time.
#
# Library:  python-can 4.6.1, can.ASCReader.
# Expected: with "timestamps relative" in the head of the file each time is the distance from the event before (Vector's
#           ASC format). asc2log of can-utils adds the times up. The reader's option relative_timestamp is something
#           else: whether the start of the measurement is added.
# Seen:     ASCReader stores the word in timestamps_format and never uses it; each distance is returned as a time.
# Effect:   three frames of 100 ms spacing are read as simultaneous; every rate and every derivative is wrong.
# Output seen:
#   python-can: 0.100 0.100 0.100 (the reader reports timestamps_format relative)
#   asc2log:    distances 0.100 0.100
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -qq --disable-pip-version-check python-can==4.6.1
cd "$folder"

cat >log.asc <<'LOG'
date Tue Nov 14 22:13:20 2023
base hex  timestamps relative
no internal events logged
   0.100000 1  181             Rx   d 1 01
   0.100000 1  181             Rx   d 1 02
   0.100000 1  181             Rx   d 1 03
LOG

venv/bin/python -I - <<'PYTHON'
import sys

import can

reader = can.ASCReader("log.asc")
times = [message.timestamp for message in reader]
written = " ".join(f"{time:.3f}" for time in times)
print(f"python-can: {written} (the reader reports timestamps_format {reader.timestamps_format})")
if times != [0.1, 0.1, 0.1] or reader.timestamps_format != "relative":
    sys.exit("Changed: python-can no longer returns relative times unsummed.")
PYTHON

if ! command -v asc2log >/dev/null; then
    echo "asc2log (can-utils) is not installed: its reading is not compared."
    exit 0
fi
asc2log -I log.asc 2>/dev/null | venv/bin/python -I -c '
import sys

times = [float(line.split()[0].strip("()")) for line in sys.stdin]
distances = [f"{later - earlier:.3f}" for earlier, later in zip(times, times[1:], strict=False)]
print("asc2log:    distances", *distances)
if distances != ["0.100", "0.100"]:
    sys.exit("Changed: asc2log no longer adds relative times up.")
'
