#!/usr/bin/env bash
# python-can loses the length of remote frames when it writes a candump log.
#
# Library:  python-can 4.6.1, can.CanutilsLogWriter (*.log).
# Expected: a remote frame carries the length that it requests. candump, cansend and log2asc of can-utils write and read
#           it as 181#R8, and python-can's own reader reads it.
# Seen:     the writer always writes 181#R; the length is read back as 0.
# Effect:   a device that compares the requested length with its PDO can refuse the request of a replayed log.
# Output seen:
#   read "181#R8": length 8; written "181#R R"; read again: length 0
#   log2asc before: r 8, after: r 0
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -qq --disable-pip-version-check python-can==4.6.1
cd "$folder"

echo "(1700000000.000000) can0 181#R8" >candump.log

venv/bin/python -I - <<'PYTHON'
import sys
from pathlib import Path

import can

(message,) = can.LogReader("candump.log")
with can.Logger("again.log") as logger:
    logger(message)
(again,) = can.LogReader("again.log")
written = Path("again.log").read_text().split(maxsplit=2)[2].strip()
print(f'read "181#R8": length {message.dlc}; written "{written}"; read again: length {again.dlc}')
if (message.dlc, written, again.dlc) != (8, "181#R R", 0):
    sys.exit("Changed: python-can no longer drops the length of remote frames.")
PYTHON

if ! command -v log2asc >/dev/null; then
    echo "log2asc (can-utils) is not installed: its reading is not compared."
    exit 0
fi
requested() { log2asc -I "$1" can0 | grep -o 'r [0-9]$'; }
before=$(requested candump.log)
after=$(requested again.log)
echo "log2asc before: $before, after: $after"
if [ "$before" != "r 8" ] || [ "$after" != "r 0" ]; then
    echo "Changed: log2asc no longer reads the two lengths as described." >&2
    exit 1
fi
