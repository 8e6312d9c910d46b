"""The interpreter: simple blocks per second, where the time goes, and memory over a million lines.

Run as ``python -m benchmarks.interpreter``.
"""

from __future__ import annotations

import cProfile
import math
import os
import pstats
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from fdhil.program import interpret

SIMPLE_BLOCKS = 100_000
MILLION = 1_000_000
SHOWN = 8


def simple(blocks: int) -> Iterator[str]:
    """Yield blocks as a CAM system writes them: short straight feeds, now and then a rapid."""
    yield "G21 G90 G17 F1500"
    for number in range(blocks - 2):
        angle = number * 0.01
        motion = "G0" if number % 50 == 0 else "G1" if number % 50 == 1 else ""
        yield f"{motion} X{40 * math.cos(angle):.3f} Y{40 * math.sin(angle):.3f} Z{-0.0001 * number:.4f}"
    yield "M2"


def mixed(blocks: int) -> Iterator[str]:
    """Yield blocks that need the long way: arcs, parameters, cycles, offsets, an O-word now and then."""
    cycle = (
        "G2 X10 Y0 I5 J0",
        "G3 X0 Y0 R6",
        "#1 = [#1 + 0.001]",
        "G1 X[10 * SIN[#1]] Y#1 F[500 + #1]",
        "G81 X1 Y1 Z-2 R1",
        "G80",
        "o1 if [#1 gt 1e6]",
        "o1 endif",
        "G54 G0 X0 Y0 (home)",
    )
    yield "G21 G90 G17 F1500"
    for number in range(blocks):
        line = cycle[number % len(cycle)]
        yield line.replace("1e6", "1000000").replace("o1", f"o{1 + number // len(cycle)}")


def timed(lines: list[str]) -> tuple[int, float]:
    """Return the number of motions and the processor time that interpreting the lines takes, in s."""
    start = time.process_time()
    motions = sum(1 for _ in interpret(lines))
    return motions, time.process_time() - start


def profile(lines: list[str]) -> list[str]:
    """Return the functions that take most of the time: share of the whole, calls, name."""
    profiler = cProfile.Profile()
    profiler.enable()
    for _ in interpret(lines):
        pass
    profiler.disable()
    stats = pstats.Stats(profiler).stats  # type: ignore[attr-defined]  # missing in the stub
    whole = sum(row[2] for row in stats.values())
    rows = sorted(stats.items(), key=lambda item: -item[1][2])[:SHOWN]
    return [f"  {100 * row[2] / whole:5.1f} %  {row[1]:>9} calls  {name[2]}" for name, row in rows]


def resident_mb() -> float:
    """Return the memory of this process, in MB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def memory(blocks: int) -> tuple[float, float]:
    """Return MB of this process after a tenth of a program file, and the largest value from there on."""
    early = largest = 0.0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "long.ngc"
        with path.open("w", encoding="utf-8") as file:
            file.writelines(line + "\n" for line in simple(blocks))
        for number, _ in enumerate(interpret(path)):
            if number == blocks // 10:
                early = resident_mb()
            elif number > blocks // 10 and number % 10_000 == 0:
                largest = max(largest, resident_mb())
    return early, largest


def main() -> None:
    """Print the figures."""
    for name, lines in (("simple", list(simple(SIMPLE_BLOCKS))), ("mixed", list(mixed(SIMPLE_BLOCKS)))):
        motions, seconds = timed(lines)
        print(
            f"{len(lines):,} {name} blocks, {motions:,} motions: {seconds:.2f} s, {len(lines) / seconds:,.0f} blocks/s"
        )
        print("\n".join(profile(lines)))
    early, largest = memory(MILLION)
    print(f"{MILLION:,} lines: {early:.1f} MB after a tenth of them, {largest:.1f} MB at most from there on")


if __name__ == "__main__":
    main()
