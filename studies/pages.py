"""A study's page and the figures under it: NAME.json holds what was measured and how, NAME.md is written from it alone.

A study is a module with ``page(run, figures)``, which returns the page's text, and, where there is a plot,
``draw(figures, path)``. So a page can be written anew without measuring anew (``python -m studies --pages``), and a
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


def conduct(
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
        f" --{key.replace('_', '-')}{_given(value)}"
        for key, value in vars(options).items()
        if key not in ("processes", "out", "folder", "done") and value != parser.get_default(key)
    ]
    run = provenance(f"python -m studies.{name}{''.join(changed)}") | {"seeds": seeds(options)}
    document = {"study": name, "run": run, "figures": plain(measure(options))}
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / f"{name}.json").write_text(json.dumps(document, separators=(",", ":")) + "\n", "utf-8")
    print(write_page(options.out / f"{name}.json"))
    return document["figures"]


def _given(value: Any) -> str:
    """Return what follows an option on the command line; nothing follows a switch."""
    return "" if value is True else f" {' '.join(map(str, value)) if isinstance(value, list) else value}"


def provenance(command: str) -> dict[str, str]:
    """Return what a reader needs to measure the same again: command, commit, versions; and the day."""
    told = {"Python": platform.python_version()} | {name: version(name) for name in ("numpy", "scipy", "numba")}
    return {
        "command": command,
        "commit": commit(),
        "date": f"{datetime.now(UTC):%Y-%m-%d}",
        "versions": ", ".join(f"{name} {number}" for name, number in told.items()),
    }


def commit() -> str:
    """Return the commit of the code that runs, and whether it was changed since (pages and figures do not count)."""
    try:
        head = _git("rev-parse", "--short", "HEAD")
        dirty = _git("status", "--porcelain", "--", "fdhil", "studies", "benchmarks", "tests")
    except (OSError, subprocess.CalledProcessError):
        return "unknown, outside of a repository"
    return f"{head} with local changes" if dirty else head


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def plain(value: Any) -> Any:
    """Return figures as JSON has them: lists, six significant digits, null for what is no number."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None
    return value


def write_page(path: Path) -> str:
    """Write the page and the plot of the figures in ``path`` next to it; return the page."""
    document = json.loads(path.read_text("utf-8"))
    text = rendered(document)
    path.with_suffix(".md").write_text(text, "utf-8")
    draw = getattr(import_module(f"studies.{document['study']}"), "draw", None)
    if draw is not None:
        draw(document["figures"], path.with_suffix(".svg"))
    return text


def rendered(document: Mapping[str, Any]) -> str:
    """Return the page of a study's document."""
    text: str = import_module(f"studies.{document['study']}").page(document["run"], document["figures"])
    return text.rstrip() + "\n"


def head(title: str, name: str, run: Run) -> list[str]:
    """Return the first lines of a page: title, and what wrote it."""
    return [
        f"# {title}",
        "",
        *paragraph(
            f"""Written by `{run["command"]}` on {run["date"]}, commit {run["commit"]}, {run["versions"]}. Seeds: {
                run["seeds"]
            }. All figures: [{name}.json]({name}.json)."""
        ),
    ]


def paragraph(words: str) -> list[str]:
    """Return words as lines of a page, and the empty line after them."""
    return [*wrap(" ".join(words.split()), 120, break_on_hyphens=False, break_long_words=False), ""]


def grid(names: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return a table of a page."""
    told = ["| " + " | ".join(row) + " |" for row in (names, *rows)]
    return [told[0], "|---" * len(names) + "|", *told[1:]]


def of(count: int, total: int) -> str:
    """Return a share in words: in none, in all, in 3 of 9."""
    return f"in all {total}" if count == total else f"in none of {total}" if count == 0 else f"in {count} of {total}"


def listed(words: Sequence[str], nothing: str = "none") -> str:
    """Return words as a sentence lists them."""
    if len(words) < 2:
        return words[0] if words else nothing
    return f"{', '.join(words[:-1])} and {words[-1]}"
