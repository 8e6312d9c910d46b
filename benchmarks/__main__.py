"""``make bench``: run every benchmark as a process of its own; figures go to docs/benchmarks.json, the page beside it.

python -m benchmarks [NAME...]             run these, or all; the others keep the figures they have
python -m benchmarks NAME --minutes 60     what follows the name goes to that benchmark
python -m benchmarks --pages               write the page again from the figures that are there
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from studies.pages import ROOT, describe_provenance, wrap_paragraph

FIGURES = ROOT / "docs" / "benchmarks.json"
BENCHMARKS = {
    "closed_loop": "The closed-loop kernel against the same kernel in C -O3, and against real time",
    "identification": "From the last sample of a rapid to validated parameters",
    "reanalysis": "A thousand recorded rapids identified again by `fdhil identify`",
    "interpreter": "Reading programs: blocks per second, where the time goes, memory over a million lines",
    "inverse": "Planning the inverse correction: the whole, and the first block of a stream",
    "planner": "The planner: speed, LinuxCNC's own demand beside it, and what the correction makes of jerky demands",
    "feedforward": "The on-line feed-forward: what the targets on the bus alone take off the tracking error",
    "acquisition": "A full 1 Mbit/s bus through receive and decode, alone and beside a fit",
    "adapters": "A serial CAN adapter through python-can, and the same through the kernel where it has vcan0",
    "guard_latency": "From SYNC to the offset frames",
    "play_jitter": "How late the SYNC of `fdhil play` leaves, a minute at 1 kHz, beside a loop in C that only sleeps",
    "web_pages": "The pages of `fdhil web` in chromium: from the wish to see one to its content",
    "whole_machine": "The daemon beside the twin in real time: 60 s of two drives at 1 kHz",
    "fleet": "Many machines: uplinks and a collector beside bare JetStream and COPY",
    "fleet_questions": "3,000 machines in one database: how long `fdhil fleet status` and the like take",
    "fleet_reanalysis": "All stored windows of a fleet again: one process, 1 and 2 Dask workers, the same bits",
    "web_live": "The live page in a browser: what it costs the web process, and whether the daemon loses a frame by it",
}


def run(name: str, options: Sequence[str] = ()) -> dict[str, Any]:
    """Run one benchmark and return what it printed, and what it ran on; a failing one ends the run."""
    print(f"{name}: {BENCHMARKS[name]} ...", flush=True)
    reported = describe_provenance(" ".join([f"python -m benchmarks.{name}", *options])) | {
        "host": f"{platform.machine()}, {os.cpu_count()} cores"
    }
    done = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{name}", *options], capture_output=True, text=True, cwd=ROOT, check=False
    )
    print(done.stdout, flush=True)
    if done.returncode != 0:
        print(done.stderr, file=sys.stderr)
        sys.exit(f"benchmark {name} failed")
    return {"run": reported, "output": done.stdout.strip().splitlines()}


def page(figures: Mapping[str, Any]) -> str:
    """Return the page of the benchmarks' figures."""
    lines = ["# Benchmarks", ""]
    lines += wrap_paragraph(
        """Written by `make bench` from [benchmarks.json](benchmarks.json). A host that is shared with other work
        measures less than it can: read the ratios, and compare within one run."""
    )
    for name, title in BENCHMARKS.items():
        if name in figures:
            reported = figures[name]["run"]
            where = f"{reported['date']}, commit {reported['commit']}, {reported['versions']}, {reported['host']}."
            lines += [f"## {title}", "", *wrap_paragraph(f"`{reported['command']}`, {where}")]
            lines += ["```text", *figures[name]["output"], "```", ""]
    return "\n".join(lines).rstrip() + "\n"


def main() -> None:
    """Run the named benchmarks, or all of them, and write the page."""
    first = next((k for k, word in enumerate(sys.argv[1:], 1) if word.startswith("-")), len(sys.argv))
    given, options = sys.argv[1:first], sys.argv[first:]
    names = [] if options == ["--pages"] else given or list(BENCHMARKS)
    if names and options and len(names) != 1:
        sys.exit("options are those of one benchmark: name it alone")
    unknown = [name for name in names if name not in BENCHMARKS]
    if unknown:
        sys.exit(f"no benchmark is called {', '.join(unknown)}: choose from {', '.join(BENCHMARKS)}")
    figures = json.loads(FIGURES.read_text("utf-8")) if FIGURES.exists() else {}
    for name in names:
        figures[name] = run(name, options)
        in_order = {key: figures[key] for key in BENCHMARKS if key in figures}
        FIGURES.write_text(json.dumps(in_order, indent=1) + "\n", "utf-8")
    FIGURES.with_suffix(".md").write_text(page(figures), "utf-8")


if __name__ == "__main__":
    main()
