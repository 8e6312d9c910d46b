"""Every code visible to an operator is documented with effect and action, and has its cause in the code."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest

import fdhil
from fdhil.daemon.notice_texts import WORDS
from fdhil.guard.interlocks import INTERLOCK_CATALOGUE, REACTION_EFFECTS
from tests.fault_matrix import ROWS, TOLD_OTHERWISE

PRODUCT = Path(fdhil.__file__).parent
DOCS = PRODUCT.parent / "docs"
PAGES = ("reference/refusals.md", "reference/guard.md", "reference/notices.md", "reference/errors.md",
         "explanation/verdicts.md")  # fmt: skip
# what takes a class, a cause and a next action, in this order (a doctor's trouble: class, place, cause, effect, action)
CALLS = {"refusal": 3, "Refused": 4, "NotAcknowledged": 3, "Reason": 3, "Trouble": 5, "create_from_error": 4}
CLASS = re.compile(r"[A-Z][a-z]+[A-Za-z]*(\(\w+\))?")


@cache
def list_calls() -> tuple[tuple[str, str, int, bool], ...]:
    """Return code, location and number of words of each call, and whether the last word is a text."""
    return tuple(_find_calls())


def _find_calls() -> Iterator[tuple[str, str, int, bool]]:
    for path in sorted(PRODUCT.rglob("*.py")):
        tree = ast.parse(path.read_text("utf-8"))
        named = {
            target.id: node.value.value
            for node in ast.walk(tree)
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant)
            for target in node.targets
            if isinstance(target, ast.Name)
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and _name_call(node) in CALLS:
                words = [word for word in node.args if not isinstance(word, ast.Constant) or word.value is not False]
                first = words[1 if _name_call(node) == "Refused" else 0] if len(words) > 1 else None
                code = first.value if isinstance(first, ast.Constant) else named.get(getattr(first, "id", ""))
                if isinstance(code, str) and CLASS.fullmatch(code):
                    last = words[-1]
                    says = not (isinstance(last, ast.Constant) and not last.value)
                    yield (
                        code.partition("(")[0],
                        f"{path.name}:{node.lineno}",
                        len(words) - CALLS[_name_call(node)],
                        says,
                    )


def _name_call(call: ast.Call) -> str:
    return call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")


def list_documented_codes() -> set[str]:
    """Return the codes in the first cell of table rows whose other cells are not empty."""
    found: set[str] = set()
    for page in PAGES:
        for line in (DOCS / page).read_text("utf-8").splitlines():
            cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line.strip("|"))] if line.startswith("| `") else []
            if len(cells) > 1 and all(cells):
                found |= {word.partition("(")[0] for word in re.findall(r"`([A-Z]\w+[^`]*)`", cells[0])}
    return found


@pytest.mark.usefixtures("long_computation")
def test_each_refusal_has_code_cause_and_action() -> None:
    short = [f"{place} {code}" for code, place, left, says in list_calls() if left < 0 or not says]
    assert short == []


@pytest.mark.usefixtures("long_computation")
@pytest.mark.goal("R19")
def test_every_code_is_documented_with_effect_and_action(
    record_property: Callable[[str, object], None],
) -> None:
    reported = {code for code, *_ in list_calls()} | INTERLOCK_CATALOGUE.keys() | WORDS.keys()
    reported |= {name for row in ROWS.values() if row.id not in TOLD_OTHERWISE for name in row.classes}
    assert sorted(reported - list_documented_codes()) == []
    assert all(map(all, WORDS.values()))
    assert all(
        cause and action and REACTION_EFFECTS[reaction] for reaction, cause, action in INTERLOCK_CATALOGUE.values()
    )
    record_property("goal", f"{len(reported)} classes, each with cause, effect and next action, all in the documents")


@pytest.mark.goal("R19")
def test_every_documented_code_exists() -> None:
    product = "\n".join(path.read_text("utf-8") for path in PRODUCT.rglob("*.py"))
    assert [name for name in sorted(list_documented_codes()) if name not in product] == []
