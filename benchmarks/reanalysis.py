"""A thousand recorded rapids identified again by ``fdhil identify``, as one file each and as one long file.

python -m benchmarks.reanalysis
"""

from __future__ import annotations

import json
import os
import pty
import resource
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from studies import bench

WINDOWS = 1000
WANTED_S = 8
NOISE = 0.005
DISTANCE_M = 0.453


def main() -> None:
    """Print what either way takes on all cores, its bar drawn on a terminal."""
    print(f"{WINDOWS} windows on {os.cpu_count()} cores, wall clock (wanted: {WANTED_S} s), and all processors' time")
    with tempfile.TemporaryDirectory() as folder:
        for name, files in (("one file each", WINDOWS), ("one long file", 1)):
            print(f"{name}: {_identified(_recordings(Path(folder) / name, files))}")


def _recordings(folder: Path, files: int) -> list[Path]:
    folder.mkdir()
    signals = bench.simulate_bench(
        bench.Plant(), bench.make_shuttle_demand(distance=DISTANCE_M, moves=WINDOWS // files)
    )
    paths = [folder / f"{k:04d}.csv" for k in range(files)]
    for seed, path in enumerate(paths):
        path.write_text(bench.format_as_csv(signals, NOISE, seed))
    return paths


def _identified(paths: list[Path]) -> str:
    """Return the figures of one call of the command."""
    master, slave = pty.openpty()
    drawn = bytearray()

    def read() -> None:
        try:
            while part := os.read(master, 65536):
                drawn.extend(part)
        except OSError:  # the terminal is closed at the other end
            return

    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    start = time.perf_counter()
    command = [sys.executable, "-m", "fdhil.cli.main", "identify", "--json", *map(str, paths)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=slave) as process:
        os.close(slave)
        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        answer, _ = process.communicate()
    took = time.perf_counter() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    reader.join()
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    found = [window for file in json.loads(answer)["files"] for window in file["windows"]]
    accepted = sum(window["validated"] for window in found)
    bar = "with its bar" if b"identifying" in drawn else "WITHOUT a bar"
    return f"{took:.1f} s {bar}, {used:.1f} s of processor; {len(found)} windows, {accepted} accepted"


if __name__ == "__main__":
    main()
