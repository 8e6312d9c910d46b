"""``make bench``: run every benchmark as a process of its own and write docs/benchmarks.md.

python -m benchmarks [NAME...]
"""

from __future__ import annotations

import platform
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BENCHMARKS = {
    "closed_loop": "The closed-loop kernel against the same kernel in C -O3, and against real time",
    "identification": "From the last sample of a rapid to validated parameters",
    "reanalysis": "A thousand recorded rapids identified again by `fdhil identify`",
    "interpreter": "Reading programs: blocks per second, where the time goes, memory over a million lines",
    "inverse": "Planning the inverse correction: the whole, and the first block of a stream",
    "planner": "The planner: speed, LinuxCNC's own demand beside it, and what the correction makes of jerky demands",
    "feedforward": "The on-line feed-forward: what the targets on the bus alone take off the tracking error",
    "acquisition": "A full 1 Mbit/s bus through receive and decode, alone and beside a fit",
    "guard_latency": "From SYNC to the offset frames",
    "whole_machine": "The daemon beside the twin in real time: 60 s of two drives at 1 kHz",
}


def run(name: str) -> str:
    """Run one benchmark and return what it printed; a failing one ends the run."""
    print(f"{name}: {BENCHMARKS[name]} ...", flush=True)
    done = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{name}"], capture_output=True, text=True, cwd=ROOT, check=False
    )
    print(done.stdout, flush=True)
    if done.returncode != 0:
        print(done.stderr, file=sys.stderr)
        sys.exit(f"benchmark {name} failed")
    return done.stdout.strip()


def main() -> None:
    """Run the named benchmarks, or all of them and write the page."""
    names = sys.argv[1:] or list(BENCHMARKS)
    parts = [
        "# Benchmarks",
        "",
        "Written by `make bench`. Figures of a shared two-core machine: read the ratios, and compare within one run.",
        "",
        f"{datetime.now(UTC):%Y-%m-%d}, Python {platform.python_version()}, {platform.machine()}.",
    ]
    for name in names:
        parts += ["", f"## {BENCHMARKS[name]}", "", f"`python -m benchmarks.{name}`", "", "```text", run(name), "```"]
    if names == list(BENCHMARKS):
        (ROOT / "docs" / "benchmarks.md").write_text("\n".join(parts) + "\n", "utf-8")


if __name__ == "__main__":
    main()
