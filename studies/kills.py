"""Kills, hangs, restarts and faults at random times of a correction (``python -m studies.kills``).

The guard and the daemon's end of it are processes on a hub of CAN in TCP, in front of the simulated machine; each fault
that ends in a ramp is also had a thousand times by the guard's decisions alone. Everything is judged by the frames on
the bus. The page goes to ``docs/studies/kills.md``, the figures beside it. Exit code 1 when a promise was broken.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

from studies import pages
from studies.fault_rows import RAMPED, Row, assess_ramp_down
from studies.frame_level import simulate_ramp_downs
from studies.kills_page import LIVE, STALE, Found, compute_figures, page
from studies.live_guard import LiveGuard

__all__ = ["page"]

SHARD = 25
PROCESS_ROWS = tuple(row for row, of in RAMPED.items() if of.process)


def run_until_idle(live: LiveGuard, of: Row, row: str, rate: int, found: Found) -> None:
    """Let SYNC continue until the guard stops sending, and check the ramp from the last value in the trace."""
    start = live.trace[0][1]
    seen = len(live.events)
    live.run_until(lambda: live.has_journal_state("RAMP_DOWN OFF FROZEN", seen), f"{row}: noticed", 2000)
    live.run_until(lambda: not any(live.offsets), f"{row}: 0", 2000)
    live.run_cycles(3)
    live.tamper = None  # a drive that shows nothing, or another value, never shows 0
    live.run_until(lambda: not live.sending, f"{row}: off", 2000)
    series = [offsets for _, offsets in live.trace]
    way = assess_ramp_down(series, rate, live.settings.axes[0].limits, of.detected)
    found.descents.setdefault(row, []).append(way)
    if way is None or not way.within or any(live.read_held_offsets()):
        found.wrong.append(f"{row}: from {start} to {series[-1]} by {way}, the drives hold {live.read_held_offsets()}")
    reported = {event["code"] for event in live.events[seen:] if event.get("code")}
    if of.code not in reported:
        found.wrong.append(f"{row} was told as {sorted(reported)}")
    if live.has_journal_state(
        "FROZEN", seen
    ):  # a guard that digests a long hang sees its zeros too late to know of them
        found.counts["FROZEN at 0"] += 1
        live.kill_guard()
        live.start_guard()


def inject_fault(live: LiveGuard, row: str, found: Found) -> None:
    """Inject one fault of a kind at a random SYNC of a program."""
    of = RAMPED[row]
    live.run_into_cut()
    rate = max(abs(b - a) for a, b in zip(live.trace[-2][1], live.trace[-1][1], strict=True))
    live.start_new_trace()
    live.changed_at = live.tick
    if of.tamper is not None:
        live.tamper = of.tamper(live.rng)
    if of.insert is not None:
        live.queue_foreign_frames(of.insert(live.rng))
    if of.order and live.daemon is not None:
        live.daemon.send_request(of.order.encode())
    if row == "F13":
        os.kill(live.guard, signal.SIGTERM)
    elif row == "F14":
        stop_guard(live, int(live.rng.integers(15, 60)))
        live.start_new_trace()
        live.expect()
    elif row == "F15" and live.daemon is not None:
        live.daemon.kill()
    run_until_idle(live, of, row, rate, found)
    if row == "F13" and live.guard and live.guard_ended() != 0:
        found.wrong.append("F13: the guard did not end with 0")
    if live.daemon is not None:
        live.daemon.kill()
    if not live.guard:
        live.start_guard()


def stop_guard(live: LiveGuard, cycles: int) -> int:
    """Stop the guard's process for so many SYNC; the frames it sent after the first of them."""
    os.kill(live.guard, signal.SIGSTOP)
    os.waitid(os.P_PID, live.guard, os.WSTOPPED | os.WNOWAIT)
    live.waits = False
    live.run_cycle()
    live.drain()
    before = live.sent
    live.run_cycles(cycles - 1)
    os.kill(live.guard, signal.SIGCONT)
    return live.sent - before


# --- the parts ---


def kill_daemons(live: LiveGuard, times: int) -> Found:
    """R6: the daemon is killed while a correction runs."""
    found = Found()
    for _ in range(times):
        inject_fault(live, "F15", found)
        found.counts["zero"] += not any(live.read_held_offsets())
    return found


def inject_faults(live: LiveGuard, times: int) -> Found:
    """R4 on processes: every row in turn."""
    found = Found()
    first = int(live.rng.integers(len(PROCESS_ROWS)))
    for k in range(times):
        inject_fault(live, PROCESS_ROWS[(first + k) % len(PROCESS_ROWS)], found)
    return found


def hang_guards(live: LiveGuard, times: int) -> Found:
    """R5: the guard hangs for 0.05 to 5 s by the clock."""
    found = Found()
    for _ in range(times):
        live.run_into_cut()
        live.start_new_trace()
        begin_s, cycles = time.monotonic(), round(50 * 100 ** live.rng.random())
        found.counts["frames while hung"] += stop_guard(live, cycles)
        found.counts["ms hung"] += round(1000 * (time.monotonic() - begin_s))
        live.start_new_trace()
        run_until_idle(live, replace(RAMPED["F14"], detected=cycles), "F14", 0, found)
        if live.daemon is not None:
            live.daemon.kill()
    return found


def restart_guards(live: LiveGuard, times: int) -> Found:
    """R7: a guard starts with drives that hold an offset, or none."""
    found = Found()
    first = int(live.rng.integers(len(STALE)))
    for k in range(times):
        restart_guard(live, STALE[(first + k) % len(STALE)], found)
    return found


def restart_guard(live: LiveGuard, stale: str, found: Found) -> None:
    """Kill the guard, make the drives hold an offset, and start the next one."""
    if stale == "zero":
        live.arm()
    else:
        live.run_into_cut()
    if stale == "both killed" and live.daemon is not None:
        live.daemon.kill()
    live.kill_guard()
    live.run_cycles(3)
    if stale in ("foreign", "beyond"):
        least, most = (1, 820) if stale == "foreign" else (820, 2000)
        live.write_foreign_offset(int(live.rng.integers(least, most)) * int(live.rng.choice((-1, 1))))
    live.run_cycles(int(live.rng.integers(1, 200)))
    live.start_new_trace()
    before, holds, seen = live.sent, live.read_held_offsets(), len(live.events)
    live.start_guard()
    outcome = "FROZEN" if stale == "beyond" else "OFF FROZEN"
    if any(holds):
        live.run_until(lambda: live.has_journal_state(outcome, seen), f"{stale}: {outcome}", 5000)
    live.run_cycles(60)
    mute = live.sent == before
    good = mute == (stale in ("beyond", "zero") or not any(holds)) and (stale == "beyond") == any(
        live.read_held_offsets()
    )
    if not good:
        reported = [(event["state"], event.get("text", "")) for event in live.events[seen:] if "state" in event]
        found.wrong.append(
            f"{stale}: {holds} became {live.read_held_offsets()} by {live.sent - before} frames, {reported}"
        )
    found.counts[stale] += 1
    found.counts["good"] += good
    frozen = live.has_journal_state("FROZEN", seen)
    found.counts["FROZEN at 0"] += frozen and stale != "beyond"  # on a slow host its zeros are read back too late
    if frozen:
        live.kill_guard()
        live.write_foreign_offset(0)
        live.start_guard()
    if live.daemon is not None:
        live.daemon.kill()


PARTS: Mapping[str, Callable[[LiveGuard, int], Found]] = {
    "kills": kill_daemons,
    "restarts": restart_guards,
    "hangs": hang_guards,
    "faults": inject_faults,
}


def run_live_part(name: str, times: int, seed: int, interface: str = "socketcand") -> Found:
    """Run a part of the study on processes of its own."""
    with tempfile.TemporaryDirectory(prefix="fdhil-kills-") as folder:
        live = LiveGuard(Path(folder), seed, interface)
        try:
            live.start_guard()
            found = PARTS[name](live, times)
        finally:
            live.close()
        found.frames, found.sync = live.frames, live.tick
        found.wrong += live.wrong
        found.counts["stops"] = live.stops
        found.counts["missed"] = max([event["missed"] for event in live.events if "missed" in event], default=0)
    return found


def run_frame_part(row: str, times: int, seed: int) -> Found:
    """Inject the faults of a kind into the guard's decisions alone."""
    ways, wrong, sync = simulate_ramp_downs(row, times, seed)
    wrong += [f"{row}: {way}" for way in ways if way is None or not way.within]
    return Found(sync=sync, wrong=wrong, descents={row: ways})


def run_or_load(file: Path | None, part: Callable[..., Found], *arguments: Any) -> Found:
    """Run a part, or read the result of an earlier, interrupted run."""
    if file is None:
        return part(*arguments)
    if not file.exists():
        found = part(*arguments)
        file.with_suffix(".new").write_text(json.dumps(vars(found)), "utf-8")
        file.with_suffix(".new").rename(file)
    return Found.parse(json.loads(file.read_text("utf-8")))


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Run all parts, and return their results."""
    jobs = []
    with ProcessPoolExecutor(options.processes) as pool:

        def begin(name: str, key: str, part: Callable[..., Found], *arguments: Any) -> None:
            file = None if options.folder is None else options.folder / f"{key}.json"
            if options.done and (file is None or not file.exists()):
                return
            jobs.append((name, pool.submit(run_or_load, file, part, *arguments)))

        for name in PARTS:
            times = getattr(options, name)
            for k, first in enumerate(range(0, times, SHARD)):
                seed = 1000 * options.seed + 100 * list(LIVE).index(name) + k
                begin(name, f"{name}-{seed}", run_live_part, name, min(SHARD, times - first), seed)
        for row in RAMPED if options.frames else ():
            begin(
                "frames",
                f"frames-{row}-{options.seed}-{options.frames}",
                run_frame_part,
                row,
                options.frames,
                options.seed,
            )
        found = {name: Found() for name in (*LIVE, "frames")}
        for name, job in jobs:
            found[name].merge(job.result())
    return compute_figures(found)


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--faults", type=int, default=20 * len(PROCESS_ROWS))
    parser.add_argument("--hangs", type=int, default=60)
    parser.add_argument("--restarts", type=int, default=500)
    parser.add_argument("--frames", type=int, default=1000, help="faults of each row, by the decisions alone")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="where the parts that are done are kept, to go on there")
    parser.add_argument("--done", action="store_true", help="take what is in the folder, and measure nothing")
    figures = pages.run_study("kills", parser, lambda options: str(options.seed), measure)
    sys.exit(not all(goal["met"] for goal in figures["goals"].values()))


if __name__ == "__main__":
    main()
