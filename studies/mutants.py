"""What the guard's tests notice (``make mutants``): one mistake at a time is put into the guard, and a test must fail.

Options choose the modules, and for how long a mistake is judged. The page goes to ``docs/studies/mutants.md``, the
figures beside it as JSON; mistakes that no test can notice are told by the patterns of
``studies/mutants_kept.json``, each with why.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from studies import pages
from studies.mutation import Mutant, mutate_code, mutate_values
from studies.trial import NOTICED, UNCALLED, judge

PACKAGE = "fdhil.guard"
DECIDING = (
    *(
        "guard_step",
        "state_transitions",
        "interlock_checks",
        "interlocks",
        "offset_limits",
        "read_back_checks",
        "offset_adoption",
        "corrected_path",
        "path_tracking",
    ),
    *("feedforward_law", "feedforward_step", "emergency_ramp", "correction_table", "guard_state"),
)
"""What decides what leaves; the rest turns bytes into records, or shows them."""
ELSEWHERE = ("test_guard_size", "test_guard_process", "test_simulated_drive", "test_attacks", "test_guard_memory")
"""Tests that measure the text or the memory, or run the guard as a process of its own, where no mistake is put."""
KEPT = Path(__file__).with_name("mutants_kept.json")
GOAL = 0.95


def main() -> None:
    """Measure, and write figures and page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--modules", nargs="+", default=list(DECIDING))
    parser.add_argument("--tests", nargs="+", default=["tests/guard"])
    parser.add_argument("--seconds", type=float, default=60.0, help="of processor time for each mistake")
    parser.add_argument("--again", action="store_true", help="judge only what is new, or was not noticed the last time")
    parser.add_argument("--every", type=int, default=1, help="judge one mistake of so many")
    pages.run_study("mutants", parser, lambda _: "none", measure_modules)


def measure_modules(options: argparse.Namespace) -> dict[str, Any]:
    """Return how many mistakes of each module were noticed, and those that were not."""
    if options.again and options.every != 1:
        raise SystemExit("--again goes on with a run that judged every mistake: leave --every out")
    mutants = list(choose_mutants(options.modules))[:: options.every]
    known = list_detected_before(options.out / "mutants.json", mutants) if options.again else {}
    results = dict(known)
    chosen = [mutant for mutant in mutants if mutant.name not in known]

    def note(mutant: Mutant, result: str, _by: str) -> None:
        results[mutant.name] = result
        if not result.startswith(NOTICED):
            print(f"{result}: {mutant.name}", flush=True)
        if (len(results) - len(known)) % 100 == 0:
            print(f"{len(results) - len(known)} of {len(chosen)}", flush=True)

    tests = [*options.tests, *(f"--ignore=tests/guard/{name}.py" for name in ELSEWHERE)]
    judge(chosen, tests, options.processes, options.seconds, note)
    return compute_figures([mutant for mutant in mutants if mutant.name in results], results, options.every)


def list_detected_before(file: Path, mutants: Sequence[Mutant]) -> dict[str, str]:
    """Return the mutants that the last run detected, in unchanged modules."""
    figures = json.loads(file.read_text("utf-8"))["figures"]
    left = {row["what"] for row in figures["left"]}
    same = {module for module, digest in figures["texts"].items() if digest == compute_text_digest(module)}
    return {m.name: NOTICED for m in mutants if m.home in same and m.name not in left}


def compute_text_digest(module: str) -> str:
    """Return a digest of a module's text."""
    return hashlib.sha256(Path(str(import_module(f"{PACKAGE}.{module}").__file__)).read_bytes()).hexdigest()[:12]


def choose_mutants(modules: Sequence[str]) -> Iterator[Mutant]:
    """Return each mistake of the modules once."""
    seen = set()
    for module in modules:
        for mutant in (*mutate_code(f"{PACKAGE}.{module}"), *mutate_values(f"{PACKAGE}.{module}")):
            if mutant.name not in seen:
                seen.add(mutant.name)
                yield mutant


def compute_figures(mutants: Sequence[Mutant], results: Mapping[str, str], every: int = 1) -> dict[str, Any]:
    """Return the figures of the page, the goal among them."""
    modules: dict[str, dict[str, dict[str, int]]] = {}
    for mutant in mutants:
        counts = modules.setdefault(mutant.home, {}).setdefault(mutant.kind, {"all": 0, "noticed": 0})
        counts["all"] += 1
        counts["noticed"] += results[mutant.name].startswith(NOTICED)
    noticed, total = sum_detected({module: kinds for module, kinds in modules.items() if module in DECIDING}, "code")
    whole = modules.keys() >= set(DECIDING)
    where = "all that decides" if whole else pages.join_words([module for module in DECIDING if module in modules])
    which = "" if every == 1 else f", one of {every} of them judged"
    figure = f"{100 * noticed / max(1, total):.1f} % of {total:,} mistakes in {where} were noticed{which}"
    left = sorted(name for name, result in results.items() if not result.startswith(NOTICED))
    return {
        "modules": modules,
        "texts": {module: compute_text_digest(module) for module in modules},
        "left": [{"what": name, "result": results[name], "why": find_equivalence_reason(name)} for name in left],
        "goals": {"R11": {"met": whole and noticed >= GOAL * total, "figure": figure}},
    }


def find_equivalence_reason(name: str) -> str:
    """Return why no test can notice a mistake; empty where none is given."""
    kept: dict[str, str] = json.loads(KEPT.read_text("utf-8"))
    return next((why for pattern, why in kept.items() if re.search(pattern, name)), "")


def sum_detected(modules: Mapping[str, Mapping[str, Mapping[str, int]]], kind: str) -> tuple[int, int]:
    """Return how many mistakes of a kind were noticed, and how many there were."""
    counts = [kinds[kind] for kinds in modules.values() if kind in kinds]
    return sum(of["noticed"] for of in counts), sum(of["all"] for of in counts)


def page(run: pages.Run, figures: Mapping[str, Any]) -> str:
    """Return the page."""
    modules, left = figures["modules"], figures["left"]
    named = [row for row in left if row["why"]]
    open_ = [row for row in left if not row["why"]]
    rows = [[f"`{module}`", *_format_shares({module: counts})] for module, counts in modules.items()]
    rows.append(["**all**", *_format_shares(modules)])
    return "\n".join(
        [
            *pages.write_head("What the guard's tests notice", "mutants", run),
            *pages.wrap_paragraph(
                """One mistake at a time is put into the guard, and its tests are run until one fails. The mistakes in
                the code are mutmut's: an operator turned, a number one higher, an argument left out, a text changed.
                Those in values are a constant one higher, a row of a table missing, an alarm with another reaction. A
                mistake that no test notices is either a rule that nobody wrote down as a test, or code that cannot
                matter. The tests that run the guard as a process of its own are left out: they would notice more."""
            ),
            *pages.write_table(("module", "mistakes in the code", "noticed", "%", "in values", "noticed", "%"), rows),
            "",
            *pages.wrap_paragraph(
                f"Goal: at least {100 * GOAL:.0f} % in all that decides. {figures['goals']['R11']['figure']}."
            ),
            "## Not noticed, and why that is so",
            "",
            *pages.wrap_paragraph(
                f"""{len(named)} of {len(left)} are named here with the reason. What they change is nothing that the
                guard does, or what is said twice on purpose."""
            ),
            *_list_survivors(named),
            "## Not noticed",
            "",
            *_list_survivors(open_),
        ]
    )


def _format_shares(modules: Mapping[str, Any]) -> list[str]:
    reported = []
    for kind in ("code", "values"):
        noticed, total = sum_detected(modules, kind)
        reported += [f"{total:,}", f"{noticed:,}", f"{100 * noticed / total:.1f}"] if total else ["0", "", ""]
    return reported


def _list_survivors(rows: Sequence[Mapping[str, str]]) -> list[str]:
    lines = [f"- {_format_code(row['what'])}{_format_reason(row)}" for row in rows]
    return [*(lines or ["None."]), ""]


def _format_reason(row: Mapping[str, str]) -> str:
    return f": {row['why']}" if row["why"] else f" ({UNCALLED})" if row["result"] == UNCALLED else ""


def _format_code(text: str) -> str:
    return f"`` {text} ``" if "`" in text else f"`{text}`"


if __name__ == "__main__":
    main()
