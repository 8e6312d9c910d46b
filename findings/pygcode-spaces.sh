#!/usr/bin/env bash
# pygcode reads a number with a space in it as another number.
#
# Library:  pygcode 0.2.1, Line; rs274 of LinuxCNC for comparison, where it is installed.
# Expected: RS274/NGC 3.3 and LinuxCNC's manual (G-code overview, format of a line): spaces and tabs are allowed anywhere
#           and do not change the meaning; "g0x +0. 12 34y 7" is "g0 x+0.1234 y7".
# Seen:     the number ends at the space and what follows it is dropped without an error: X1 0 is X1.
# Effect:   a program of a punched-tape post-processor, which aligns digits by spaces, is read with other positions than
#           the machine moves to.
# Output seen:
#   G0 X1 0 Y7    pygcode: X1 Y7     rs274: X10 Y7
#   G0 X- 2 5 Y7  pygcode: refused   rs274: X-25 Y7
#   G0 X2 .5 Y7   pygcode: X2 Y7     rs274: X2.5 Y7
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -qq --disable-pip-version-check pygcode==0.2.1
cd "$folder"

venv/bin/python -I -W ignore - <<'PYTHON'
import re
import shutil
import subprocess
import sys

from pygcode import Line, Machine


def by_pygcode(line):
    machine = Machine()
    try:
        machine.process_block(Line(line).block)
    except Exception:
        return "refused"
    return f"X{machine.pos.X:g} Y{machine.pos.Y:g}"


def by_rs274(line):
    if not shutil.which("rs274"):
        return ""
    with open("program.ngc", "w", encoding="ascii") as file:
        file.write(f"G21\n{line}\nM2\n")
    said = subprocess.run(["rs274", "-g", "program.ngc"], capture_output=True, text=True).stdout
    x, y = re.findall(r"STRAIGHT_TRAVERSE\(([-\d.]+), ([-\d.]+)", said)[-1]
    return f"X{float(x):g} Y{float(y):g}"


seen = {line: (by_pygcode(line), by_rs274(line)) for line in ("G0 X1 0 Y7", "G0 X- 2 5 Y7", "G0 X2 .5 Y7")}
for line, (ours, theirs) in seen.items():
    print(f"{line:12}  pygcode: {ours:8}  {theirs and 'rs274: ' + theirs}".rstrip())
theirs = [pair[1] for pair in seen.values()]
if any(theirs) and theirs != ["X10 Y7", "X-25 Y7", "X2.5 Y7"]:
    sys.exit("Changed: rs274 no longer ignores spaces.")
if (seen["G0 X1 0 Y7"][0], seen["G0 X2 .5 Y7"][0]) != ("X1 Y7", "X2 Y7"):
    sys.exit("Changed: pygcode no longer ends a number at a space.")
PYTHON
