"""Measures the wake-up latency of this PC at the SYNC period, like cyclictest and latency-test."""

import gc
import json
import os
import time
from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fdhil.cli.doctor.trouble import Trouble
from fdhil.commissioning import CYCLE_PRIORITY, Lateness, set_realtime_priority
from fdhil.config import MachineConfig
from fdhil.guard import BINS_US, MOST_LATE
from fdhil.store import make_folder, write_file

FILE_NAME = "latency.json"
MEND = "reduce the load of this PC, use a real-time kernel (PREEMPT_RT), and start the guard with its systemd unit"


def measure_latency(
    config: MachineConfig,
    seconds: float,
    now_s: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], object] = time.sleep,
) -> dict[str, Any]:
    """Sleep until each SYNC period for ``seconds``, with the guard's priority if permitted; return the latencies."""
    period_s, measured, over = config.machine.sync_period_s, Lateness(), 0
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    scheduling = set_realtime_priority(CYCLE_PRIORITY)
    gc.disable()
    try:
        due_s = now_s() + period_s
        end_s = due_s + seconds
        while due_s < end_s:
            sleep(max(0.0, due_s - now_s()))
            late_s = now_s() - due_s
            measured.count_sync(late_s)
            over += late_s > period_s
            due_s += period_s * (1 + int(max(0.0, late_s) / period_s))  # missed periods are skipped
    finally:
        gc.enable()
        os.sched_setscheduler(0, *before)
    counts = [0] * (len(BINS_US) + 1)
    for late_us, count in enumerate(measured.counts):
        counts[bisect_left(BINS_US, late_us)] += count
    return {
        "schema": "fdhil-latency-1",
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": seconds,
        "period_us": round(period_s * 1e6),
        "scheduling": scheduling,
        "kernel": f"{os.uname().release} {os.uname().version}",
        "turns": measured.cycles,
        "late": over,
        "p50_us": measured.compute_quantile_us(0.5),
        "p99_us": measured.compute_quantile_us(0.99),
        "p999_us": measured.compute_quantile_us(0.999),
        "worst_us": round(measured.most_us),
        "histogram_us": [[top, count] for top, count in zip((*BINS_US, None), counts, strict=True)],
    }


def store_latency(config: MachineConfig, found: Mapping[str, Any]) -> Path:
    """Write a measurement to the store, for the acceptance report. Raises StoreError."""
    path = config.store.directory / FILE_NAME
    make_folder(path.parent)
    write_file(path, json.dumps(found, indent=2).encode())
    return path


def read_latency(config: MachineConfig) -> dict[str, Any] | None:
    """Return the latest stored measurement, or None if there is no readable one."""
    try:
        found = json.loads((config.store.directory / FILE_NAME).read_text("utf-8"))
        return found if found["schema"] == "fdhil-latency-1" else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def format_latency(found: Mapping[str, Any]) -> str:
    """Return a measurement as text."""
    return (
        f"{found['turns']} wake-ups every {found['period_us'] / 1e3:g} ms: median latency {found['p50_us']:.0f} us, "
        f"99.9 % {found['p999_us']:.0f} us, worst {found['worst_us']} us; "
        f"{found['late']} later than a period ({found['scheduling']})"
    )


def format_histogram(histogram_us: list[list[int | None]]) -> Iterator[str]:
    """Yield one line per non-empty class."""
    most = max(count or 0 for _, count in histogram_us) or 1
    for top, count in histogram_us:
        if count:
            bound = f"over {BINS_US[-1]}" if top is None else f"up to {top}"
            yield f"  {bound:>12} us  {count:>9}  {'#' * max(1, round(40 * count / most))}"


def examine_latency(found: Mapping[str, Any]) -> Iterator[Trouble]:
    """Yield a problem if the share of late wake-ups exceeds the limit above which the guard refuses arming."""
    if found["late"] > MOST_LATE * found["turns"]:
        what = f"this PC is too slow: {format_latency(found)}"
        means = f"offsets are sent late; above {MOST_LATE:.1%} late offsets the guard refuses arming"
        yield Trouble("PcLate", "processors", what, means, MEND)
