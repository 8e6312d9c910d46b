"""The guard stays small enough to read: the safety page limits the lines of each part."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
GUARD = ROOT / "fdhil" / "guard"
PAGE = ROOT / "docs" / "explanation" / "safety.md"
NO_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
ROW = re.compile(r"^\| ([^|]+) \| ((?:`\w+`(?:, )?)+) \| (\d+) \|$", re.MULTILINE)
PARTS = {name: (re.findall(r"\w+", modules), int(most)) for name, modules, most in ROW.findall(PAGE.read_text("utf-8"))}


def code_lines(file: Path) -> int:
    """Return the number of lines that are neither blank nor comment nor docstring."""
    source = file.read_text("utf-8")
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in NO_CODE:
            lines |= set(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            lines -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(lines)


def test_every_module_is_counted_once() -> None:
    counted = sorted(module for modules, _ in PARTS.values() for module in modules)
    assert counted == sorted(file.stem for file in GUARD.glob("*.py") if file.stem != "__init__")


@pytest.mark.parametrize("part", PARTS)
def test_no_part_exceeds_the_lines_on_the_safety_page(part: str) -> None:
    modules, most = PARTS[part]
    counts = {module: code_lines(GUARD / f"{module}.py") for module in modules}
    assert sum(counts.values()) <= most, counts
    assert sum(counts.values()) > 0.9 * most, f"{counts}: the page may say less"
