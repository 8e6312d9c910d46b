#!/usr/bin/env bash
# canmatrix writes a floating-point signal of a DBC file as an integer into a SYM file.
#
# Library:  canmatrix 1.2, from DBC to PEAK's SYM; cantools 45.1.0 for comparison.
# Expected: a signal with SIG_VALTYPE_ 1 or 2 is an IEEE float or double; SYM has the types float and double for it.
# Seen:     in DBC files floats have the sign "-". canmatrix asks for the sign first and writes "signed", so that the
#           types float and double are never reached. cantools writes float and double for the same file.
# Effect:   a tool that reads the SYM file shows a speed of -1.5 rad/s as -1077936128.
# Output seen:
#   cantools:  Sig="speed" float 32, Sig="voltage" double 64
#   canmatrix: Var=speed signed 0,32, Var=voltage signed 0,64
#   speed -1.5 by the DBC file, -1077936128 by canmatrix's SYM file
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -qq --disable-pip-version-check canmatrix==1.2 cantools==45.1.0
cd "$folder"

venv/bin/python -I -W ignore - <<'PYTHON'
import io
import logging
import re
import sys

import canmatrix.formats
import cantools

logging.disable()
DBC = """VERSION ""
BU_: NC DRIVE
BO_ 385 Status: 8 DRIVE
 SG_ speed : 0|32@1- (1,0) [0|0] "rad/s" NC
BO_ 386 Link: 8 DRIVE
 SG_ voltage : 0|64@1- (1,0) [0|0] "V" NC
SIG_VALTYPE_ 385 speed : 1;
SIG_VALTYPE_ 386 voltage : 2;
"""


def types_in(sym, kind):
    found = re.findall(rf'{kind}="?(?:speed|voltage)"? (?:signed|unsigned|float|double) [0-9,]+', sym)
    return ", ".join(sorted(found))


database = cantools.database.load_string(DBC, "dbc")
matrix = canmatrix.formats.load(io.BytesIO(DBC.encode()), "dbc")[""]
file = io.BytesIO()
canmatrix.formats.dump(matrix, file, "sym")
by_cantools, by_canmatrix = types_in(database.as_sym_string(), "Sig"), types_in(file.getvalue().decode(), "Var")
print(f"cantools:  {by_cantools}")
print(f"canmatrix: {by_canmatrix}")
frame = database.encode_message("Status", {"speed": -1.5})
again = canmatrix.formats.load(io.BytesIO(file.getvalue()), "sym")[""]
speed = again.frame_by_name("Status").decode(frame)["speed"].phys_value
print(f"speed {database.decode_message('Status', frame)['speed']} by the DBC file, {speed} by canmatrix's SYM file")
if by_cantools != 'Sig="speed" float 32, Sig="voltage" double 64':
    sys.exit("Changed: cantools no longer writes float and double.")
if by_canmatrix != "Var=speed signed 0,32, Var=voltage signed 0,64" or speed != -1077936128:
    sys.exit("Changed: canmatrix now writes a floating-point signal as one.")
PYTHON
