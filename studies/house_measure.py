"""Measures the package itself: verbs in names, one-word names, doors between rooms, doubles, dialect, lines a room.

``python -m studies.house_measure`` prints the figures; ``--json`` prints one JSON document. A room is a folder or a
file directly below ``fdhil``; its budget of lines is ``[tool.fdhil.budget]`` of ``pyproject.toml``.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "fdhil"
OFTEN = 10  # files in which one function name is listed
OTHERS = "."  # the room of the files directly below the package
VERBS = frozenset(
    re.findall(
        r"\w+",
        """
    accept acknowledge add adjust adopt advance advise aim align analyse announce answer append apply approve arm ask
    assemble assert assess attach await become begin bind block bound break build calculate call cancel capture carry
    cast change check choose claim classify clean clear clip close collect combine come commission commit compare
    compensate compile compress compute configure confirm connect consume contain continue control convert copy correct
    count cover create cut decide decode decompress decrease define delay delete deliver demand derive describe detach
    detect determine diagnose differentiate disable disarm discard disconnect dispatch display divide do download draw
    drain drive drop dump edit emit enable encode encrypt end enforce enqueue ensure enter erase escape estimate
    evaluate examine exceed exchange exclude execute exit expand expect expire explain export extend extract fail fall
    feed fetch fill filter find finish fit fix flush fold follow forbid forecast forget fork format free freeze gather
    generate get give go grant group grow guard guess halt handle has hash help hide hold home identify ignore import
    improve include increase index infer inform inherit init initialise initialize insert inspect install integrate
    interpolate interpret invert invite is iterate join jump keep kill label latch launch lay learn leave lengthen limit
    linearise list listen load locate lock log look loop lower make map mark match may measure meet merge modify monitor
    move multiply name narrow need normalise note notice notify observe obtain offer omit open order own pack pad paint
    parse pass pause peek perform persist pick place plan play plot poll pool post predict prepare present press prevent
    print probe process produce propagate propose protect prove prune publish pull push put query queue quit quote
    raise ramp reach read reanalyse rebuild receive recognise recompute reconnect record recover reduce refine refit
    refuse register reject release reload remember remove rename render repair repeat replace replay report request
    require reset resolve respond restart restore resume retain retry return reverse revert rewrite rotate round route
    run sample save say scale scan schedule score search see seed seek select send separate serialise serve set settle
    shift shorten show shut sign simulate skip sleep smooth solve sort split spread start step stop store stream stretch
    strip subscribe subtract suggest sum summarise supervise suppress swap sweep switch synchronise take tell terminate
    test throttle tick time touch trace track train transform translate transmit trigger trim truncate try tune turn
    unlink unlock unpack unsubscribe unwrap update upgrade upload use validate verify visit wait wake walk want warm
    warn watch weigh widen withdraw wrap write yield zero can
    """,
    )
)
DIALECT = re.compile(
    r"\b(told|tells?|foretells?|hears?|heard|knows?|believe[sd]?|mend(s|ed)?|anew|astray|nil|sought|vouch(es)?|spoilt"
    r"|whoever|seldom|alike|unlike|beside|what stands|what is left|at rest|is no |nobody|somebody|the works|twin"
    r"|sisters?|pupil|lessons?|desk|crew|letterbox|teller|asker|doorkeeper|dress(es)?|wardrobe|tailor|to and fro)\b"
)
Function = ast.FunctionDef | ast.AsyncFunctionDef


def read_budget() -> dict[str, int]:
    """Return the most lines of each room."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    budget: dict[str, int] = project["tool"]["fdhil"]["budget"]
    return budget


def count_lines() -> dict[str, int]:
    """Return the lines of Python of each room."""
    counted: Counter[str] = Counter()
    for path in PACKAGE.rglob("*.py"):
        counted[room_of(path)] += len(path.read_text("utf-8").splitlines())
    return dict(counted)


def room_of(path: Path) -> str:
    """Return the room of a file of the package."""
    parts = path.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else OTHERS


def find_doors(tree: ast.Module, room: str) -> Iterator[tuple[str, bool]]:
    """Yield each name imported from another room: the room, and whether it comes from a file inside it."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith("fdhil."):
            continue
        _, other, *inner = str(node.module).split(".")
        if other == room or not (PACKAGE / other).is_dir():
            continue
        for alias in node.names:
            beneath = PACKAGE / other / alias.name
            yield other, bool(inner) or beneath.with_suffix(".py").is_file() or beneath.is_dir()


def split_name(name: str) -> list[str]:
    """Return the words of a name."""
    return [word for word in name.strip("_").split("_") if word]


def measure() -> dict[str, Any]:
    """Return all figures of the package."""
    functions: list[tuple[str, Path]] = []
    doors: Counter[tuple[str, bool]] = Counter()
    docstrings: list[str] = []
    files: dict[str, set[str]] = defaultdict(set)
    for path in sorted(PACKAGE.rglob("*.py")):
        tree, room = ast.parse(path.read_text("utf-8")), room_of(path)
        if path.stem != "__init__":
            files[path.stem].add(str(path))
        doors.update(find_doors(tree, room))
        for node in ast.walk(tree):
            if isinstance(node, Function) and not node.name.startswith("__"):
                functions.append((node.name, path))
            if isinstance(node, Function | ast.ClassDef | ast.Module) and (text := ast.get_docstring(node)):
                docstrings.append(text)
    names: dict[str, set[Path]] = defaultdict(set)
    for name, path in functions:
        names[name].add(path)
    doubled = Counter({name: len(paths) for name, paths in names.items()})
    lines, total, words = count_lines(), len(functions), [split_name(name) for name, _ in functions]
    reached = Counter({room: count for (room, inner), count in doors.items() if inner})
    return {
        "lines": sum(lines.values()),
        "rooms": dict(sorted(lines.items(), key=lambda item: -item[1])),
        "functions": total,
        "verb_percent": 100 * sum(not VERBS.isdisjoint(each[:1]) for each in words) / total,
        "one_word_percent": 100 * sum(len(each) == 1 for each in words) / total,
        "words_per_name": sum(map(len, words)) / total,
        "imports_between_rooms": doors.total(),
        "imports_past_the_door": reached.total(),
        "past_the_door_of": dict(reached.most_common()),
        "doubled_file_names": sorted(name for name, paths in files.items() if len(paths) > 1),
        "doubled_function_names": {name: count for name, count in doubled.most_common() if count >= OFTEN},
        "docstrings": len(docstrings),
        "dialect_percent": 100 * sum(bool(DIALECT.search(text.lower())) for text in docstrings) / len(docstrings),
    }


def main() -> None:
    """Print the figures, and each room against its budget."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--json", action="store_true", help="print one JSON document")
    found, budget = measure(), read_budget()
    if options.parse_args().json:
        print(json.dumps(found | {"budget": budget}, indent=1))
        return
    for key in ("verb_percent", "one_word_percent", "dialect_percent"):
        print(f"{key:24} {found[key]:8.1f} %")
    for key in ("functions", "words_per_name", "docstrings", "imports_between_rooms", "imports_past_the_door", "lines"):
        print(f"{key:24} {found[key]:8.6g}")
    print(f"{'doubled_file_names':24} {len(found['doubled_file_names']):8}")
    print(f"function names in ten files or more: {found['doubled_function_names']}")
    print(f"past the door of: {found['past_the_door_of']}")
    print(f"{'room':24} {'lines':>8} {'budget':>8}")
    for room, lines in found["rooms"].items():
        print(f"{room:24} {lines:8} {budget.get(room, 0):8}")


if __name__ == "__main__":
    main()
