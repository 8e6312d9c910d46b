#!/usr/bin/env bash
# python-can reads a CAN FD data frame without data from an ASC file as a remote frame.
#
# Library:  python-can 4.6.1, can.ASCReader.
# Expected: CAN FD has no remote frames (ISO 11898-1): a CANFD line of length 0 is an empty data frame. The same
#           library reads 181##0 of a candump log as one, and asc2log of can-utils converts the ASC line to 181##0.
# Seen:     ASCReader marks every CANFD line of length 0 as a remote frame. can.Message with check=True
#           rejects that combination.
# Effect:   converted to a candump log the frame is a classic remote request, 181#R. Replayed on a CANopen bus
#           that requests TPDO1 of node 1.
# Output seen:
#   candump log: remote False, CAN FD True, length 0
#   written as ASC, read back: remote True, CAN FD True, length 0
#   the same, written as a candump log: 181#R R
#   asc2log: 181##0
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -qq --disable-pip-version-check python-can==4.6.1
cd "$folder"

echo "(1700000000.000000) can0 181##0" >candump.log

venv/bin/python -I - <<'PYTHON'
import sys
from pathlib import Path

import can


def convert(source, target):
    with can.Logger(target) as logger:
        for message in can.LogReader(source):
            logger(message)


def describe(file):
    (message,) = can.LogReader(file)
    return f"remote {message.is_remote_frame}, CAN FD {message.is_fd}, length {message.dlc}"


convert("candump.log", "log.asc")
convert("log.asc", "again.log")
original, read_back = describe("candump.log"), describe("log.asc")
written = Path("again.log").read_text().split(maxsplit=2)[2].strip()
print("candump log:", original)
print("written as ASC, read back:", read_back)
print("the same, written as a candump log:", written)
if original != "remote False, CAN FD True, length 0":
    sys.exit("Changed: python-can reads 181##0 differently.")
if read_back != "remote True, CAN FD True, length 0" or written != "181#R R":
    sys.exit("Changed: python-can no longer reads an empty CAN FD frame as a remote frame.")
PYTHON

if ! command -v asc2log >/dev/null; then
    echo "asc2log (can-utils) is not installed: its reading is not compared."
    exit 0
fi
frame=$(asc2log -I log.asc 2>/dev/null | cut -d' ' -f3)
echo "asc2log: $frame"
if [ "$frame" != "181##0" ]; then
    echo "Changed: asc2log no longer reads the line as an empty CAN FD data frame." >&2
    exit 1
fi
