#!/usr/bin/env bash
# npTDMS writes big-endian samples as if they were little-endian.
#
# Library:  npTDMS 1.13.0, TdmsWriter; numpy 2.4.6.
# Expected: the values of an array do not depend on its byte order: numpy, h5py and scipy return big-endian arrays for
#           files and frames that are big-endian. TDMS File Format Internal Structure (NI): without the flag
#           kTocBigEndian all values of a segment are little-endian.
# Seen:     the bytes are written as they are, without that flag. The same samples in native order are correct.
# Effect:   a recording of registers or of a drive's trace, decoded with dtype ">f8" or ">i4" (the order of Modbus),
#           is stored without an error and read by every program as other numbers.
# Output seen:
#   native: [1.5, 2.5] mm, [1, 2] increments
#   big-endian: [3.13984e-319, 5.37543e-321] mm, [16777216, 33554432] increments
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -qq --disable-pip-version-check npTDMS==1.13.0 numpy==2.4.6
cd "$folder"

venv/bin/python -I - <<'PYTHON'
import sys

import numpy as np
from nptdms import ChannelObject, TdmsFile, TdmsWriter


def write_and_read(order):
    with TdmsWriter("log.tdms") as writer:
        position = ChannelObject("drive", "mm", np.array([1.5, 2.5], dtype=f"{order}f8"))
        counts = ChannelObject("drive", "increments", np.array([1, 2], dtype=f"{order}i4"))
        writer.write_segment([position, counts])
    group = TdmsFile.read("log.tdms")["drive"]
    return group["mm"][:].tolist(), group["increments"][:].tolist()


native, swapped = write_and_read("="), write_and_read(">")
for name, (position, counts) in (("native", native), ("big-endian", swapped)):
    print(f"{name}: [{', '.join(f'{value:.6g}' for value in position)}] mm, {counts} increments")
if native != ([1.5, 2.5], [1, 2]):
    sys.exit("Changed: npTDMS no longer returns what was written in native order.")
if swapped[1] != [16777216, 33554432] or swapped[0] == [1.5, 2.5]:
    sys.exit("Changed: npTDMS no longer writes big-endian samples as little-endian ones.")
PYTHON
