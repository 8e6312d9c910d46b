#!/usr/bin/env bash
# python-control's method "matched" makes a plant with an integrator to NaN, without an error.
#
# Library:  control 0.10.2, c2d(..., method="matched").
# Expected: pole-zero matching maps each pole and zero by z = exp(s T) and matches the gain at a frequency where it is
#           finite (Franklin, Powell, Workman: Digital Control of Dynamic Systems, chapter 6). A position loop, 10/(s (s + 1)),
#           has the poles 1 and exp(-T) and a finite gain.
# Seen:     the gain is matched at s = 0 alone, where an integrator has none: infinity divided by infinity. The numerator
#           is NaN; there is no exception. The same plant by "zoh" or "bilinear" is correct.
# Effect:   every simulation and margin of an axis that is a position (all feed drives have an integrator) is NaN.
# Output seen:
#   zoh:     10/(s (s + 1)) -> [1.0653065971, 0.9020401043] / [1.0, -1.6065306597, 0.6065306597]
#   matched: 1/(s + 1)      -> [0.3934693403] / [1.0, -0.6065306597]
#   matched: 10/(s (s + 1)) -> [nan] / [1.0, -1.6065306597, 0.6065306597]
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -qq --disable-pip-version-check control==0.10.2 numpy==2.4.6 scipy==1.17.1
cd "$folder"

venv/bin/python -I -W ignore - <<'PYTHON'
import math
import sys

import control

s = control.tf("s")
plants = {"1/(s + 1)": 1 / (s + 1), "10/(s (s + 1))": 10 / (s * (s + 1))}


def convert(name, method):
    discrete = control.c2d(plants[name], 0.5, method)
    numerator, denominator = ([round(float(value), 10) for value in part[0][0]] for part in (discrete.num, discrete.den))
    print(f"{method + ':':8} {name:14} -> {numerator} / {denominator}")
    return numerator


correct = convert("10/(s (s + 1))", "zoh"), convert("1/(s + 1)", "matched")
integrator = convert("10/(s (s + 1))", "matched")
if not all(math.isfinite(value) for numerator in correct for value in numerator):
    sys.exit("Changed: python-control no longer converts the other cases.")
if not all(math.isnan(value) for value in integrator):
    sys.exit("Changed: python-control now matches the gain of a plant with an integrator.")
PYTHON
