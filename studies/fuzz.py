"""Fuzzing: any bytes at every way in, looked for by atheris; and one wrong character at every place of a configuration.

``--add`` goes on: the inputs of this run are counted to those that the figures have already.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Mapping
from typing import Any

from studies import slips
from studies.pages import ROOT, join_words, run_study, wrap_paragraph, write_head, write_table
from tests.fuzz import TARGETS
from tests.fuzz.input_assessment import LONGEST_S, MOST_BYTES, list_found_inputs

GOAL = 1_000_000
PORTION = 20_000
CORPUS = ROOT / "out" / "fuzz"
Figures = dict[str, Any]


def main() -> None:
    """Fuzz and write the figures."""
    parser = argparse.ArgumentParser(prog="python -m studies.fuzz")
    parser.add_argument("--inputs", type=int, default=10_000, help="for each way in")
    parser.add_argument("--seconds", type=float, default=1e6, help="for each way in, where that is sooner")
    parser.add_argument("--targets", nargs="+", choices=TARGETS, default=list(TARGETS))
    parser.add_argument("--slips", type=int, default=2_000, help="of one character, at random; 0: all there are")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--add", action="store_true", help="count to the figures that are there")
    figures = run_study("fuzz", parser, lambda options: f"{options.seed}", measure)
    if any(part["found"] for part in figures["targets"].values()) or not figures["slips"]["met"]:
        sys.exit("what hurts is in out/fuzz/found: mend it, and keep the input in tests/fuzz/found")


def measure(options: argparse.Namespace) -> Figures:
    """Fuzz the targets one after another, then assess slips."""
    path = options.out / "fuzz.json"
    before = json.loads(path.read_text("utf-8"))["figures"] if options.add and path.is_file() else {}
    parts: dict[str, Figures] = dict(before.get("targets", {}))
    for name in options.targets:
        until_s = time.monotonic() + options.seconds
        for k, inputs in enumerate(divide_inputs(options.inputs)):
            if k and (parts[name]["found"] or time.monotonic() >= until_s):
                break
            now = fuzz_target(name, inputs, until_s - time.monotonic(), options.seed + k)
            parts[name] = merge_figures(parts.get(name), now)
            print(f"{name}: {parts[name]['inputs']:,} inputs", flush=True)
    letters = before.get("slips")
    if letters is None or (not letters["all"] and (options.slips == 0 or options.slips > letters["count"])):
        letters = assess_slips(options.slips, options.seed)
    reported = {name: parts[name] for name in TARGETS if name in parts}
    figures = {"targets": reported, "mended": load_fixed_inputs(), "slips": letters}
    return {**figures, "goals": evaluate_goals(figures)}


def divide_inputs(inputs: int) -> list[int]:
    """Divide the inputs among processes: atheris keeps each array that it compared for as long as it lives."""
    return [min(PORTION, inputs - begun) for begun in range(0, inputs, PORTION)]


def fuzz_target(name: str, inputs: int, seconds: float, seed: int) -> Figures:
    """Fuzz one target in a process of its own."""
    given = ["--inputs", inputs, "--seconds", seconds, "--seed", seed]
    command = [sys.executable, "-m", "tests.fuzz", name, *map(str, given), "--corpus", str(CORPUS / "corpus" / name)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    if lines:
        message: Figures = json.loads(lines[-1])
        if message["found"]:
            print(done.stderr[-4000:], file=sys.stderr)
        return message
    print(done.stderr[-4000:], file=sys.stderr)
    ended = {"kind": f"the process ended with {done.returncode}", "place": name, "inputs": 1}
    return {"target": name, "inputs": 0, "cpu_s": 0.0, "slowest_s": 0.0, "peak_mib": 0.0, "found": [ended]}


def merge_figures(before: Mapping[str, Any] | None, now: Mapping[str, Any]) -> Figures:
    """Return the figures of several runs of one target; what was found counts from the last alone."""
    was = before or {"inputs": 0, "cpu_s": 0.0, "slowest_s": 0.0, "peak_mib": 0.0}
    sums = {key: was[key] + now[key] for key in ("inputs", "cpu_s")}
    return {**sums, **{key: max(was[key], now[key]) for key in ("slowest_s", "peak_mib")}, "found": list(now["found"])}


def load_fixed_inputs() -> dict[str, list[str]]:
    """Return the inputs that once hurt, by the names of their files."""
    found = {name: [path.name for path in list_found_inputs(name)] for name in TARGETS}
    return {name: names for name, names in found.items() if names}


def assess_slips(count: int, seed: int) -> Figures:
    """Judge so many slips of one character in the sample configuration, or all."""
    text = slips.SAMPLE.read_text("utf-8")
    chosen = slips.sample_slips(text, count, seed) if count else list(slips.generate_slips(text))
    counts, wrong = slips.count_outcomes(chosen, text)
    return {"count": len(chosen), "all": not count, "outcomes": dict(counts), "wrong": wrong[:10], "met": not wrong}


def evaluate_goals(figures: Mapping[str, Any]) -> Figures:
    """Return the goals R12 and R17 by these figures."""
    parts, letters = figures["targets"], figures["slips"]
    total, found = sum(part["inputs"] for part in parts.values()), sum(len(part["found"]) for part in parts.values())
    whole = sum(part["inputs"] >= GOAL for part in parts.values())
    met = whole == len(TARGETS) and total >= 10 * GOAL and not found
    fuzzing = f"{total:,} inputs to {len(parts)} ways in, {whole} of them with {GOAL:,} or more; {found} undeclared"
    outcome = letters["outcomes"]
    typed = (
        f"of {letters['count']:,} slips {outcome.get('same', 0):,} mean the same, {outcome.get('refused', 0):,} are "
        f"refused with line or key, {outcome.get('value', 0) + outcome.get('absent', 0):,} change what was mistyped "
        f"alone, {sum(outcome.get(wrong, 0) for wrong in slips.WRONG)} do anything else"
    )
    return {"R12": {"met": met, "figure": fuzzing}, "R17": {"met": letters["met"] and letters["all"], "figure": typed}}


def page(run: Mapping[str, str], figures: Mapping[str, Any]) -> str:
    """Return the page."""
    parts, letters = figures["targets"], figures["slips"]
    total, found = sum(part["inputs"] for part in parts.values()), sum(len(part["found"]) for part in parts.values())
    whole = [name for name, part in parts.items() if part["inputs"] >= GOAL]
    lines = write_head("Any bytes at every way in", "fuzz", run)
    lines += wrap_paragraph(
        f"""atheris looked for bytes that hurt: an exception that the way in does not declare, an answer that may not be
        given, more than {LONGEST_S:g} s of processor time or more than {MOST_BYTES >> 20} MiB for one input. {total:,}
        inputs went to {len(parts)} ways in, over all runs so far, those before the last one to earlier code.
        {found or "None"} of them hurt in the last run of its way in. {len(whole)} of the ways in have had {GOAL:,}
        inputs or more. A process' memory holds what atheris keeps of each array that it compared, too. `python -m
        studies.fuzz --inputs {GOAL} --add` goes on."""
    )
    names = ("way in", "inputs", "processor s", "slowest ms", "process MiB", "hurt", "hurt before, mended")
    lines += write_table(
        names, [_format_row(name, part, figures["mended"].get(name, [])) for name, part in parts.items()]
    )
    lines += ["", "## One wrong character in a configuration", ""]
    lines += wrap_paragraph(
        f"""{"Every" if letters["all"] else "At random, a"} slip of one character in `configs/sim.toml`: one left out,
        one too many, one for another, {len(slips.TYPED)} different ones. {letters["count"]:,} slips. A number that
        became another number which a machine may have cannot be told from what was meant; that nothing but the mistyped
        key changes can. {"Nothing else changed." if letters["met"] else "Wrong: " + join_words(letters["wrong"])}"""
    )
    reported = [(words, f"{letters['outcomes'].get(key, 0):,}") for key, words in slips.OUTCOMES.items()]
    lines += write_table(("what became of it", "slips"), reported)
    return "\n".join(lines)


def _format_row(name: str, part: Mapping[str, Any], once: list[str]) -> list[str]:
    hurt = join_words([f"{each['kind']} at {each['place']}" for each in part["found"]])
    figures = [
        f"{part['inputs']:,}",
        f"{part['cpu_s']:.0f}",
        f"{1e3 * part['slowest_s']:.0f}",
        f"{part['peak_mib']:.0f}",
    ]
    return [name.replace("_", " "), *figures, hurt, join_words([each.replace("-", " ") for each in once], "")]


if __name__ == "__main__":
    main()
