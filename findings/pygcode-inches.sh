#!/usr/bin/env bash
# pygcode's machine does not convert its position when a program changes from inches to millimetres.
#
# Library:  pygcode 0.2.1, Machine.process_block; rs274 of LinuxCNC for comparison, where it is installed.
# Expected: RS274/NGC 3.5.7: G20 and G21 select the unit of what follows; the controlled point does not move. After G20
#           and X1 the point is at 25.4 mm.
# Seen:     the numbers stay and the unit changes: the point is at X1 in millimetres.
# Effect:   every later position, distance and duration of a program with both units is wrong, as in programs that call
#           subroutines in the other unit.
# Output seen:
#   pygcode: X1 Y1
#   rs274:   X25.4 Y1
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -qq --disable-pip-version-check pygcode==0.2.1
cd "$folder"

printf 'G20\nG1 X1 F10\nG21\nG1 Y1\nM2\n' > program.ngc
venv/bin/python -I -W ignore - <<'PYTHON'
import re
import shutil
import subprocess
import sys

from pygcode import Line, Machine

machine = Machine()
with open("program.ngc", encoding="ascii") as file:
    for line in file:
        machine.process_block(Line(line.strip()).block)
point = machine.pos.X, machine.pos.Y
print(f"pygcode: X{point[0]:g} Y{point[1]:g}")
if shutil.which("rs274"):
    said = subprocess.run(["rs274", "-g", "program.ngc"], capture_output=True, text=True).stdout
    last = [tuple(map(float, found)) for found in re.findall(r"STRAIGHT_FEED\(([-\d.]+), ([-\d.]+)", said)][-1]
    print(f"rs274:   X{last[0]:g} Y{last[1]:g}")
    if last != (25.4, 1.0):
        sys.exit("Changed: rs274 no longer converts the position.")
if point != (1.0, 1.0):
    sys.exit("Changed: pygcode now converts the position.")
PYTHON
