#!/usr/bin/env bash
# python-can does not read its own PEAK traces (.trc) back with the same channel.
#
# Library:  python-can 4.6.1, can.TRCWriter and can.TRCReader.
# Expected: what a Logger writes, a LogReader returns. In the same library ASCWriter adds 1, because buses are
#           numbered from 1 in the file, and ASCReader subtracts it again.
# Seen:     TRCWriter adds 1 as well, TRCReader subtracts nothing: each conversion moves all frames to the next channel.
# Effect:   a frame of channel 0 gets channel 1, the number of the other bus of the original recording. Two recordings
#           that are joined afterwards mix their buses.
# Output seen:
#   written [0, 1], read back from .asc [0, 1]
#   written [0, 1], read back from .trc [1, 2]
#   the same after one more conversion  [2, 3]
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -qq --disable-pip-version-check python-can==4.6.1
cd "$folder"

venv/bin/python -I - <<'PYTHON'
import sys

import can


def write_and_read(messages, file):
    with can.Logger(file) as logger:
        for message in messages:
            logger(message)
    return list(can.LogReader(file))


def channels(messages):
    return [message.channel for message in messages]


frames = [
    can.Message(timestamp=1.0 + n, arbitration_id=0x181, is_extended_id=False, data=[n], channel=n) for n in (0, 1)
]
from_asc = channels(write_and_read(frames, "log.asc"))
trace = write_and_read(frames, "log.trc")
again = channels(write_and_read(trace, "again.trc"))
print(f"written {channels(frames)}, read back from .asc {from_asc}")
print(f"written {channels(frames)}, read back from .trc {channels(trace)}")
print(f"the same after one more conversion  {again}")
if (from_asc, channels(trace), again) != ([0, 1], [1, 2], [2, 3]):
    sys.exit("Changed: python-can no longer moves the frames of a trace to the next channel.")
PYTHON
