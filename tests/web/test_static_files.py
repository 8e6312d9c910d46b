"""The static files: complete, consistent, and without requests to other servers."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from fdhil.report import typography
from fdhil.report.svg_drawing import COLOURS, SHADES
from fdhil.web.application import SHELL, STATIC

SCRIPTS = sorted(STATIC.rglob("*.js"))
WORDS = re.compile(r'^\s*"([\w.()]+)": ', re.MULTILINE)


ENGLISH = [STATIC / "text" / "en.js", *sorted((STATIC / "text" / "en").glob("*.js"))]
OTHERS = sorted(set((STATIC / "text").glob("*.js")) - set(ENGLISH))


def test_each_page_has_its_script() -> None:
    assert [name for name in SHELL if not (STATIC / "pages" / f"{name}.js").is_file()] == []


def test_each_imported_module_exists() -> None:
    for path in SCRIPTS:
        for found in re.findall(r'(?:from|import) "/static/([\w./]+)"', path.read_text("utf-8")):
            assert (STATIC / found).is_file(), (path.name, found)


def test_each_text_key_is_defined_once() -> None:
    parts = [key for path in ENGLISH for key in WORDS.findall(path.read_text("utf-8"))]
    known = set(parts)
    for path in SCRIPTS:
        code = "\n".join(line for line in path.read_text("utf-8").splitlines() if not line.startswith("//"))
        used = set(re.findall(r'\bt\("([\w.]+)"', code))
        assert used <= known, (path.name, used - known)
    assert [key for key in known if parts.count(key) > 1] == []


def find_sentences(*paths: Path) -> dict[str, set[str]]:
    found = re.findall(
        r'^\s*"([\w.()]+)": "(.*)",?$', "\n".join(path.read_text("utf-8") for path in paths), re.MULTILINE
    )
    return {key: set(re.findall(r"\{\w+\}", text)) for key, text in found}


@pytest.mark.parametrize("path", OTHERS, ids=lambda path: path.stem)
def test_translations_have_english_keys_and_placeholders(path: Path) -> None:
    english, other = find_sentences(*ENGLISH), find_sentences(path)
    assert other
    assert {key: filled for key, filled in other.items() if english.get(key) != filled} == {}
    chosen = re.search(r"const LANGUAGES = (\[.*?\]);", (STATIC / "text.js").read_text("utf-8"))
    assert chosen is not None
    assert path.stem in json.loads(chosen[1])


@pytest.mark.parametrize(
    "path", sorted([*SCRIPTS, *STATIC.rglob("*.css"), *STATIC.glob("*.html")]), ids=lambda p: p.name
)
def test_no_foreign_requests_and_no_inline_code(path: Path) -> None:
    text = path.read_text("utf-8")
    elsewhere = [found for found in re.findall(r"https?://[\w.-]+", text) if "www.w3.org" not in found]
    assert elsewhere == []
    assert not re.search(
        r"\.innerHTML|insertAdjacentHTML|\beval\(|new Function|document\.write|<script>|\bstyle=\"", text
    )


def test_units_are_typeset_like_reports() -> None:
    text = (STATIC / "typeset.js").read_text("utf-8")
    table = re.search(r"const PRINTED = \{(.*?)\};", text, re.DOTALL)
    assert table is not None
    assert json.loads("{" + table[1].strip().rstrip(",") + "}") == typography._PRINTED


def test_colours_equal_those_of_reports() -> None:
    styles = "".join((STATIC / name).read_text("utf-8") for name in ("app.css", "pages/program.css"))
    for name, colours in (("series", COLOURS), ("shade", SHADES)):
        light = dict(reversed(re.findall(rf"--{name}-(\d): (#\w+);", styles)))
        assert tuple(light[key] for key in sorted(light)) == colours
