"""A study's page and the figures under it: NAME.json holds what was measured and how, NAME.md is written from it alone.

A study is a module with ``page(run, figures)``, which returns the page's text, and, where there is a plot,
``draw(figures, path)``. So a page can be written again without measuring again (``python -m studies --pages``), and a
test sees that each page is what its figures say.
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "docs" / "studies"
DIGITS = 6
Run = Mapping[str, str]


def run_study(
    name: str,
    parser: argparse.ArgumentParser,
    seeds: Callable[[argparse.Namespace], str],
    measure: Callable[[argparse.Namespace], Any],
) -> Any:
    """Read the options, measure, and write figures, page and plot; ``seeds`` describes the options' seeds.

    Returns the figures as the file has them.
    """
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path, default=FOLDER)
    options = parser.parse_args()
    changed = [
        f" --{key.replace('_', '-')}{_list_given_options(value)}"
        for key, value in vars(options).items()
        if key not in ("processes", "out", "folder", "done") and value != parser.get_default(key)
    ]
    run = describe_provenance(f"python -m studies.{name}{''.join(changed)}") | {"seeds": seeds(options)}
    document = {"study": name, "run": run, "figures": convert_to_json(measure(options))}
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / f"{name}.json").write_text(json.dumps(document, separators=(",", ":")) + "\n", "utf-8")
    print(write_page(options.out / f"{name}.json"))
    return document["figures"]


def _list_given_options(value: Any) -> str:
    """Return what follows an option on the command line; nothing follows a switch."""
    return "" if value is True else f" {' '.join(map(str, value)) if isinstance(value, list) else value}"


def describe_provenance(command: str) -> dict[str, str]:
    """Return what a reader needs to measure the same again: command, commit, versions; and the day."""
    reported = {"Python": platform.python_version()} | {name: version(name) for name in ("numpy", "scipy", "numba")}
    return {
        "command": command,
        "commit": read_commit(),
        "date": f"{datetime.now(UTC):%Y-%m-%d}",
        "versions": ", ".join(f"{name} {number}" for name, number in reported.items()),
    }


def read_commit() -> str:
    """Return the commit of the code that runs, and whether it was changed since (pages and figures do not count)."""
    try:
        head = _run_git("rev-parse", "--short", "HEAD")
        dirty = _run_git("status", "--porcelain", "--", "fdhil", "studies", "benchmarks", "tests")
    except (OSError, subprocess.CalledProcessError):
        return "unknown, outside of a repository"
    return f"{head} with local changes" if dirty else head


def _run_git(*arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def convert_to_json(value: Any) -> Any:
    """Return figures as JSON has them: lists, six significant digits, null for what is no number."""
    if isinstance(value, Mapping):
        return {str(key): convert_to_json(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return convert_to_json(value.tolist())
    if isinstance(value, list | tuple):
        return [convert_to_json(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None
    return value


def write_page(path: Path) -> str:
    """Write the page and the plot of the figures in ``path`` next to it; return the page."""
    document = json.loads(path.read_text("utf-8"))
    text = render_page(document)
    path.with_suffix(".md").write_text(text, "utf-8")
    draw = getattr(import_module(f"studies.{document['study']}"), "draw", None)
    if draw is not None:
        draw(document["figures"], path.with_suffix(".svg"))
    return text


def render_page(document: Mapping[str, Any]) -> str:
    """Return the page of a study's document."""
    text: str = import_module(f"studies.{document['study']}").page(document["run"], document["figures"])
    return text.rstrip() + "\n"


def write_head(title: str, name: str, run: Run) -> list[str]:
    """Return the first lines of a page: title, and what wrote it."""
    return [
        f"# {title}",
        "",
        *wrap_paragraph(
            f"""Written by `{run["command"]}` on {run["date"]}, commit {run["commit"]}, {run["versions"]}. Seeds: {
                run["seeds"]
            }. All figures: [{name}.json]({name}.json)."""
        ),
    ]


def wrap_paragraph(words: str) -> list[str]:
    """Return words as lines of a page, and the empty line after them."""
    return [*wrap(" ".join(words.split()), 120, break_on_hyphens=False, break_long_words=False), ""]


def write_table(names: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return a table of a page."""
    reported = ["| " + " | ".join(row) + " |" for row in (names, *rows)]
    return [reported[0], "|---" * len(names) + "|", *reported[1:]]


def format_share(count: int, total: int) -> str:
    """Return a share in words: in none, in all, in 3 of 9."""
    return f"in all {total}" if count == total else f"in none of {total}" if count == 0 else f"in {count} of {total}"


def join_words(words: Sequence[str], nothing: str = "none") -> str:
    """Return words as a sentence lists them."""
    if len(words) < 2:
        return words[0] if words else nothing
    return f"{', '.join(words[:-1])} and {words[-1]}"
