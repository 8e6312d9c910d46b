#!/usr/bin/env bash
# python-can reads an error frame of a candump log as a data frame of the highest priority.
#
# Library:  python-can 4.6.1, can.CanutilsLogReader (*.log).
# Expected: candump writes error frames with bit 29 of the identifier set (CAN_ERR_FLAG of linux/can.h), the class in
#           the lower bits: 20000004#0004... is "controller: receive counter at the warning level". log2asc of
#           can-utils writes it as ErrorFrame.
# Seen:     only the class "bus error" (20000080) becomes an error frame, without its interface name. Every other class
#           (lost arbitration, controller state, missing acknowledge, bus off) becomes an extended data frame.
# Effect:   a bus that goes into the warning level is analysed as a healthy bus with one more sender. A replay of the
#           converted log sends identifier 4, which wins arbitration against all PDOs.
# Output seen:
#   20000004#0004000000000000: error frame False, data frame 00000004 of 8 bytes, channel can0
#   20000080#0000000000000000: error frame True, channel None
#   written again: (1700000000.000000) can0 00000004#0004000000000000 R
#   log2asc: 2 of 2 are error frames
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -qq --disable-pip-version-check python-can==4.6.1
cd "$folder"

cat >candump.log <<'LOG'
(1700000000.000000) can0 20000004#0004000000000000
(1700000000.100000) can0 20000080#0000000000000000
LOG

venv/bin/python -I - <<'PYTHON'
import sys
from pathlib import Path

import can

controller, bus = can.LogReader("candump.log")
print(
    f"20000004#0004000000000000: error frame {controller.is_error_frame}, data frame "
    f"{controller.arbitration_id:08X} of {controller.dlc} bytes, channel {controller.channel}"
)
print(f"20000080#0000000000000000: error frame {bus.is_error_frame}, channel {bus.channel}")
with can.Logger("again.log") as logger:
    logger(controller)
again = Path("again.log").read_text().strip()
print("written again:", again)
if controller.is_error_frame or not again.endswith("00000004#0004000000000000 R"):
    sys.exit("Changed: python-can no longer reads this error frame as a data frame.")
if not bus.is_error_frame or bus.channel is not None:
    sys.exit("Changed: python-can reads the interface name of an error frame, or no longer reads 20000080 as one.")
PYTHON

if ! command -v log2asc >/dev/null; then
    echo "log2asc (can-utils) is not installed: its reading is not compared."
    exit 0
fi
errors=$(log2asc -I candump.log can0 | grep -c ErrorFrame || true)
echo "log2asc: $errors of 2 are error frames"
if [ "$errors" != 2 ]; then
    echo "Changed: log2asc no longer reads both lines as error frames." >&2
    exit 1
fi
