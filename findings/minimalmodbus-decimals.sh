#!/usr/bin/env bash
# minimalmodbus writes values with decimals one unit too small.
#
# Library:  minimalmodbus 2.1.1, Instrument.write_register with number_of_decimals.
# Expected: its documentation: with number_of_decimals=1 the value 77.0 is written to the register as 770. So 0.29 with
#           two decimals is 29, and the value that is read back is the value that was written.
# Seen:     the product is truncated, not rounded. 0.29 * 100 is 28.999999999999996 in floating point, and 28 is written.
# Effect:   a gain of 0.29 that is read and written back is 0.28 afterwards. A test with 0.25 or 1.1 passes.
# Output seen:
#   0.29 with 2 decimals: 28 on the line
#   4.35 with 2 decimals: 434 on the line
#   1.15 with 2 decimals: 114 on the line
#   1.1 with 1 decimal: 11 on the line
#   0.00 ... 9.99 written and read back: 69 of 1000 are one unit smaller
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -qq --disable-pip-version-check minimalmodbus==2.1.1
cd "$folder"

venv/bin/python -I - <<'PYTHON'
import sys

import minimalmodbus


class Line:
    """Stand in for a serial port with a device that repeats a request of function 6, as the protocol says."""

    port, is_open, timeout, baudrate = "line", True, 0.05, 19200

    def __init__(self, *_, **__):
        self.request = b""

    def write(self, request):
        self.request = bytes(request)

    def read(self, _size):
        return self.request

    def reset_input_buffer(self):
        pass

    reset_output_buffer = close = open = reset_input_buffer


minimalmodbus.serial.Serial = Line
instrument = minimalmodbus.Instrument("line", 1)


def written(value, decimals):
    instrument.write_register(0, value, decimals, functioncode=6)
    return int.from_bytes(instrument.serial.request[4:6], "big")


cases = [(0.29, 2), (4.35, 2), (1.15, 2), (1.1, 1)]
found = [written(*case) for case in cases]
for (value, decimals), register in zip(cases, found):
    print(f"{value} with {decimals} decimal{'s' * (decimals > 1)}: {register} on the line")
smaller = sum(written(number / 100, 2) == number - 1 for number in range(1000))
print(f"0.00 ... 9.99 written and read back: {smaller} of 1000 are one unit smaller")
if found != [28, 434, 114, 11] or not smaller:
    sys.exit("Changed: minimalmodbus no longer truncates a value with decimals.")
PYTHON
