"""Long life: a week of work at speed-up, and real hours with faults (``python -m studies.soak``).

The real daemon, guard, pages, publisher and simulated machine run as processes; after each round of rapids, and in the
rest after it, it is noted what each of them uses. The samples are kept below ``--folder`` as they come, one JSON object
a line. Real hours may be those of several shops at a time (``--shops``), each with processes of its own. With
``--rapids 0 --hours 0`` nothing is run: the page is made of what is there so far. ``--add`` keeps the figures of
earlier runs: the real hours are the sum, and the week is the last that was run.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import shutil
import signal
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from studies import pages
from studies.soak_life import EVENTS, NOTE_S, RAPIDS, RESTARTS, Life
from studies.soak_shop import KEPT_WINDOWS, STORE_MB, MachineRig, make_config
from studies.usage import Slope, fit_slope

PERIOD_S = 0.004
A_DAY = 1440  # rapids of a machine in a day: one a minute, around the clock
WEEK_H, REAL_H = 168.0, 8.0  # what the goal asks for
MOST_MB_A_DAY = 1.0
EMERGENCIES = 1_000_000
RESTARTING = 0.15  # of the rounds at speed-up, at the beginning, in which daemon and guard are restarted
RESTARTED = 12  # rounds by the clock in which they are
AT_ONCE = 200  # first rounds by the clock, with no rest: whatever happens has happened often when they are over
WARM = 0.5  # of a process' life, before anything is concluded
SEEN = 2000  # rapids of each axis that the pages hold: a shop that works in real time has had as many before
BY_CLOCK = 4  # rapids in a round by the clock
OURS = ("daemon", "guard", "pages", "publisher")
FLAT = ("descriptors", "threads", "children")


# -- running


def run_accelerated(folder: Path, seed: int, rounds: int) -> None:
    """Let a plant work for this many rounds at speed-up."""
    _provenance(folder, f"--rapids {rounds * RAPIDS} --hours 0", seed)
    shop = MachineRig(folder, make_config(folder, PERIOD_S, lockstep=True))
    with _open_plant(shop):
        life = Life(shop, folder / "samples.jsonl", seed)
        while life.rounds < rounds:
            life.round({**EVENTS, **RESTARTS} if life.rounds < RESTARTING * rounds else EVENTS)


def fill_store(folder: Path, seed: int) -> Path:
    """Return a store filled by an accelerated plant until the pages do not grow with another rapid."""
    shop = MachineRig(folder, make_config(folder, PERIOD_S, lockstep=True))
    kept = folder / "kept"
    if not kept.exists():
        with _open_plant(shop):
            life = Life(shop, folder / "samples.jsonl", seed)
            while life.rounds * RAPIDS < SEEN * len(shop.config.axis):
                life.round({})
            for name in OURS:
                shop.processes.pop(name).stop()
            shutil.copytree(shop.store, kept)
    return kept


def run_real_time(folder: Path, seed: int, hours: float, rest_s: float, filled: Path, command: str) -> None:
    """Let a plant with a filled store work by the clock, with a rest after each round but the first ones."""
    _provenance(folder, command, seed)
    shop = MachineRig(folder, make_config(folder, PERIOD_S, lockstep=False), filled)
    with _open_plant(shop):
        life = Life(shop, folder / "samples.jsonl", seed, BY_CLOCK)
        while life.at_s < 3600 * hours:
            life.round({**EVENTS, **RESTARTS} if life.rounds < RESTARTED else EVENTS)
            if life.rounds >= AT_ONCE:
                life.rest(rest_s)


def run_plants(folder: Path, options: argparse.Namespace) -> None:
    """Let this many plants work by the clock at the same time."""
    command = f"--rapids 0 --hours {options.hours:g} --rest {options.rest:g} --shops {options.shops}"
    filled = fill_store(folder / "filled", options.seed)
    common = options.hours, options.rest, filled, command
    shops = [
        multiprocessing.Process(target=run_real_time, args=(folder / f"hours{k}", options.seed + k, *common))
        for k in range(options.shops)
    ]
    try:
        for shop in shops:
            shop.start()
        for shop in shops:
            shop.join()
    finally:
        for shop in shops:
            shop.terminate()


def _provenance(folder: Path, what: str, seed: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    run = pages.describe_provenance(f"python -m studies.soak {what}") | {"seeds": str(seed)}
    (folder / "run.json").write_text(json.dumps(run), "utf-8")


@contextmanager
def _open_plant(shop: MachineRig) -> Iterator[None]:
    """Keep a shop open for the time of a with block; a termination ends all that was started."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    try:
        shop.open()
        yield
    finally:
        shop.close()


# -- concluding


def read_samples(folder: Path) -> list[dict[str, Any]]:
    """Return the samples of a run so far."""
    file = folder / "samples.jsonl"
    return [json.loads(line) for line in file.read_text("utf-8").splitlines()] if file.exists() else []


def select_longest_life(samples: Sequence[Mapping[str, Any]], name: str, where: str) -> list[Mapping[str, Any]]:
    """Return the samples of a part's process that lived longest, after its warm-up; ``where`` counts its life."""
    lives: dict[int, list[Mapping[str, Any]]] = {}
    for sample in samples:
        if name in sample["process"]:
            lives.setdefault(sample["process"][name]["pid"], []).append(sample)
    longest = max(lives.values(), key=len, default=[])
    if not longest:
        return []
    begin, end = longest[0][where], longest[-1][where]
    return [sample for sample in longest if sample[where] >= begin + WARM * (end - begin)]


def compute_figures(folder: Path, per_day: bool) -> dict[str, Any]:
    """Return a run's figures: growth of each process per day of work (``per_day``: of the clock), and all counts."""
    samples = read_samples(folder)
    if not samples:
        return {}
    last = samples[-1]
    day = 86400.0 if per_day else A_DAY / RAPIDS
    where = "at_s" if per_day else "round"
    processes = {}
    for name in (*OURS, "machine"):
        life = select_longest_life(samples, name, where)
        if life:
            processes[name] = _describe_process(name, life, where, day)
    return {
        "run": json.loads((folder / "run.json").read_text("utf-8")),
        "rounds": last["round"],
        "rapids": last["round"] * (BY_CLOCK if per_day else RAPIDS),
        "hours": last["at_s"] / 3600,
        "processes": processes,
        "store_mb": {name: [samples[0]["store_mb"][name], last["store_mb"][name]] for name in last["store_mb"]},
        "log_mb": last["log_mb"],
        "happened": last["happened"],
        "failed": last["failed"],
        "restarts": last["restarts"],
        "dropped": last["dropped"],
    }


def _describe_process(name: str, life: Sequence[Mapping[str, Any]], where: str, day: float) -> dict[str, Any]:
    reported = [sample["process"][name] for sample in life]
    over = [sample[where] for sample in life]
    grown = {
        key: None if (found := fit_slope(over, [each[key] for each in reported])) is None else asdict(found.scale(day))
        for key in ("resident_mb", "anonymous_mb", *FLAT)
    }
    return {
        "samples": len(life),
        "resident_mb": [reported[0]["resident_mb"], reported[-1]["resident_mb"]],
        "a_day": grown,
        **{key: [min(each[key] for each in reported), max(each[key] for each in reported)] for key in FLAT},
        "zombies": max(each["zombies"] for each in reported),
    }


def evaluate_goal(week: Mapping[str, Any], hours: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return whether the goal is met, and its figure.

    In a few real hours a growth per day is known to some 10 MB: there nothing may grow for certain.
    """
    worked_h, real_h = week.get("rapids", 0) / A_DAY * 24, sum(run["hours"] for run in hours)
    met, reported = worked_h >= WEEK_H and real_h >= REAL_H, []
    for runs, what, certain in (
        ([week] if week else [], f"{worked_h:.3g} of {WEEK_H:.0f} h of work at speed-up", False),
        (hours, f"{real_h:.3g} of {REAL_H:.0f} real hours", True),
    ):
        growths = [(name, growth) for run in runs for name, growth in _iterate_growth(run)]
        met &= {name for name, _ in growths} == set(OURS)
        met &= all((growth.low if certain else growth.value) < MOST_MB_A_DAY for _, growth in growths)
        name, growth = max(growths, key=lambda each: each[1].value, default=("nothing", None))
        reported.append(what + (f", steepest {name} {_describe_goal(growth)} MB a day" if growth else ""))
    emergencies = sum(run.get("happened", {}).get("emergencies", 0) for run in (week, *hours))
    met &= emergencies >= EMERGENCIES
    return {"met": met, "figure": f"{'; '.join(reported)}; {emergencies:,} emergencies"}


def _iterate_growth(run: Mapping[str, Any]) -> Iterator[tuple[str, Slope]]:
    """Yield the growth of each of fdhil's processes that lived long enough."""
    for name in OURS:
        grown = run["processes"].get(name, {}).get("a_day", {}).get("resident_mb")
        if grown is not None:
            yield name, Slope(**grown)


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Run the requested parts, or read the existing samples, and conclude."""
    path = options.out / "soak.json"
    before = json.loads(path.read_text("utf-8"))["figures"] if options.add and path.is_file() else {}
    with tempfile.TemporaryDirectory(prefix="fdhil-soak-") as temporary:
        folder = options.folder or Path(temporary)
        if options.rapids:
            run_accelerated(folder / "week", options.seed, -(-options.rapids // RAPIDS))
        if options.hours:
            run_plants(folder, options)
        worked = compute_figures(folder / "week", per_day=False) or before.get("week", {})
        newest = [compute_figures(shop, per_day=True) for shop in sorted(folder.glob("hours*"))]
        by_clock = [*before.get("hours", []), *filter(None, newest)]
    return {"week": worked, "hours": by_clock, "goals": {"R13": evaluate_goal(worked, by_clock)}}


# -- the page


def page(run: pages.Run, figures: Mapping[str, Any]) -> str:
    """Return the study's page."""
    goal = figures["goals"]["R13"]
    lines = pages.write_head("Long life: a week at speed-up, and real hours", "soak", run)
    lines += pages.wrap_paragraph(
        f"""Does anything grow? Goal: {WEEK_H:.0f} h of work at speed-up and {REAL_H:.0f} real hours with faults, memory
        below {MOST_MB_A_DAY:g} MB a day after the warm-up, descriptors and threads flat, {EMERGENCIES:,} emergencies
        absorbed. **{"Met" if goal["met"] else "Not met"}**: {goal["figure"]}."""
    )
    lines += pages.wrap_paragraph(
        f"""The daemon, the guard, the pages, a publisher and the simulated machine of two axes (SYNC every
        {PERIOD_S * 1e3:g} ms) run as processes. After each round of rapids, and every {NOTE_S:.0f} s of a rest, it is
        noted what each of them uses. In the first {RESTARTING:.0%} of the week, and in the first {RESTARTED} rounds by
        the clock, daemon and guard are restarted and killed; growth is that of the process that lived longest, in the
        second half of its life, as a straight line with its 95 % interval. The store is a disk of {STORE_MB} MB in
        memory, so that it can be full, and keeps {KEPT_WINDOWS} recordings instead of 10,000, so that it is full
        early."""
    )
    if figures["week"]:
        lines += [
            "## A week at speed-up",
            "",
            *_week_words(figures["week"]),
            *_build_tables(figures["week"], "a day's work"),
        ]
    if figures["hours"]:
        lines += ["## Real hours", ""]
        lines += pages.wrap_paragraph(
            f"""What grows with each rapid is seen in the week, what grows by the clock alone is seen here: a round of
            {BY_CLOCK} rapids, then a rest, about as many as a machine makes in a day. The first {AT_ONCE} rounds follow
            each other at once, so that what an event takes when it happens for the first time, and what the pieces of
            freed memory between used ones come to, is taken early. Some hours tell a growth per day no better than the
            intervals say, so the goal here is that nothing grows for certain. The pages hold the newest {SEEN:,} rapids
            of each axis, and the store of these shops has had as many at speed-up before. Each run is a shop with
            processes of its own; those of one command worked at the same time."""
        )
    for k, run in enumerate(figures["hours"], 1):
        lines += [f"### Run {k}", "", *_hours_words(run), *_build_tables(run, "a day")]
    return "\n".join(lines)


def _week_words(week: Mapping[str, Any]) -> list[str]:
    return pages.wrap_paragraph(
        f"""{week["rapids"]:,} rapids, {week["rapids"] / A_DAY:.2g} days of a machine that makes one a
        minute around the clock; it took {week["hours"]:.2g} h. Compressed: the standstill between rapids, and with it
        whatever grows by the clock alone. Not compressed: each rapid, its frames, its fit, what is stored and told of
        it, and what happens between. {_describe_measurement(week)}"""
    )


def _hours_words(hours: Mapping[str, Any]) -> list[str]:
    return pages.wrap_paragraph(
        f"{hours['hours']:.2f} h by the clock, {hours['rapids']:,} rapids. {_describe_measurement(hours)}"
    )


def _describe_measurement(run: Mapping[str, Any]) -> str:
    reported = run["run"]
    return f"Measured by `{reported['command']}` on {reported['date']}, commit {reported['commit']}."


def _build_tables(run: Mapping[str, Any], day: str) -> list[str]:
    rows = [_format_row(name, told) for name, told in run["processes"].items()]
    names = ("process", "samples", "memory, MB", f"MB in {day}", "descriptors", "threads", "children", "zombies")
    sizes = [[name, f"{first:.2f}", f"{last:.2f}"] for name, (first, last) in run["store_mb"].items()]
    sizes += [[f"log of {name}", "0.00", f"{size:.2f}"] for name, size in run["log_mb"].items()]
    happened = [[name, f"{times:,}"] for name, times in sorted(run["happened"].items())]
    failed = [f"* {times} times: {what}" for what, times in run["failed"].items()]
    failed += [
        f"* {name} ended by itself {times} times and was started again" for name, times in run["restarts"].items()
    ]
    return [
        *pages.write_table(names, rows), "",
        *pages.write_table(("in the store", "MB at first", "MB at last"), sizes), "",
        *pages.write_table(("what happened", "times"), happened), "",
        *(["What did not answer as asked:", "", *failed, ""] if failed else []),
    ]  # fmt: skip


def _format_row(name: str, told: Mapping[str, Any]) -> list[str]:
    first, last = told["resident_mb"]
    grown = told["a_day"]["resident_mb"]
    slope = "too few samples" if grown is None else _describe_goal(Slope(**grown))
    spans = [_format_span(*told[key]) for key in FLAT]
    return [name, str(told["samples"]), f"{first:.1f} to {last:.1f}", slope, *spans, str(told["zombies"])]


def _format_span(low: int, high: int) -> str:
    return str(low) if low == high else f"{low} to {high}"


def _describe_goal(slope: Slope) -> str:
    return f"{slope.value:+.2f} ({slope.low:+.2f} to {slope.high:+.2f})"


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rapids", type=int, default=7 * A_DAY, help="of both axes together, at speed-up; 0: none")
    parser.add_argument("--hours", type=float, default=REAL_H, help="by the clock; 0: none")
    parser.add_argument("--rest", type=float, default=230.0, help="seconds between two rounds by the clock")
    parser.add_argument("--shops", type=int, default=1, help="that work by the clock at the same time")
    parser.add_argument("--add", action="store_true", help="to the figures that are there")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="where samples, logs and sockets are kept; left out: nowhere")
    pages.run_study("soak", parser, lambda options: str(options.seed), measure)


if __name__ == "__main__":
    main()
