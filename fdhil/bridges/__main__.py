"""``python -m fdhil.bridges`` prints the line for LinuxCNC's HAL file that loads the bridge."""

from __future__ import annotations

import sys
from pathlib import Path

LINE = "loadusr -Wn fdhil-bridge /usr/bin/python3 {path}\n"

if __name__ == "__main__":
    sys.stdout.write(LINE.format(path=Path(__file__).resolve().with_name("linuxcnc.py")))
