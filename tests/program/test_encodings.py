"""Encodings: a program may be stored in several, and text that no NC reads is refused by name."""

from __future__ import annotations

import codecs
from pathlib import Path

import pytest

from fdhil.errors import ProgramError
from fdhil.program import Rapid, interpret

LOOP = "%\r\no1 repeat [2] (Fr\u00e4sen)\r\nG91 G0 X1\r\no1 endrepeat\r\n%\r\n"


@pytest.mark.parametrize(
    "stored",
    [
        LOOP.encode("utf-8"), LOOP.encode("latin-1"), codecs.BOM_UTF8 + LOOP.encode("utf-8"),
        LOOP.replace("\r", "").encode("cp1252"), LOOP[:-2].encode("utf-8"),
    ],
)  # fmt: skip
def test_text_of_common_editors_is_read(stored: bytes, tmp_path: Path) -> None:
    path = tmp_path / "program.ngc"
    path.write_bytes(stored)
    expected = [Rapid(3, (1.0, 0.0, 0.0)), Rapid(3, (2.0, 0.0, 0.0))]
    assert list(interpret(path)) == expected
    assert list(interpret(("\ufeff" + LOOP).split("\n"))) == expected


@pytest.mark.parametrize("stored", ["utf-16", "utf-16-le", "utf-16-be"])
def test_utf_16_is_refused_by_name(stored: str, tmp_path: Path) -> None:
    path = tmp_path / "program.ngc"
    path.write_bytes(("" if stored == "utf-16" else "\ufeff").encode(stored) + LOOP.encode(stored))
    with pytest.raises(ProgramError, match="UTF-16"):
        list(interpret(path))


@pytest.mark.parametrize(
    ("line", "word", "name"),
    [
        ("G0 X\u20131", "X\u2013", "U\\+2013, en dash"),
        ("G0\u00a0X1", "\u00a0", "U\\+00A0, no-break space"),
        ("G0 X1 \u201ca\u201d", "\u201c", "U\\+201C, left double quotation mark"),
        ("G0 X\u0663", "X\u0663", "arabic-indic digit three"),
        ("G0 X1 \U0001f6e0", "\U0001f6e0", "U\\+1F6E0"),
        ("X\u00b2", "X\u00b2", "superscript two"),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "latin-1", None])
def test_character_of_text_processor_is_named(
    line: str, word: str, name: str, encoding: str | None, tmp_path: Path
) -> None:
    path = tmp_path / "program.ngc"
    if encoding is not None and (encoding != "latin-1" or max(line) <= "\xff"):
        path.write_bytes(b"G0 X0\n" + line.encode(encoding))
    with pytest.raises(ProgramError, match=name) as caught:
        list(interpret(path if path.exists() else ["G0 X0", line]))
    assert (caught.value.line, caught.value.word) == (2, word)


def test_names_of_any_alphabet_are_shown_as_written() -> None:
    assert list(interpret(["#<gr\u00f6\u00dfe>=2", "G0 X#<gr\u00f6\u00dfe>"])) == [Rapid(2, (2.0, 0.0, 0.0))]
    with pytest.raises(ProgramError) as caught:
        list(interpret(["G0 X#<gr\u00f6\u00dfe>"]))
    assert caught.value.word == "#<gr\u00f6\u00dfe>"


def test_file_with_only_byte_order_mark_is_empty(tmp_path: Path) -> None:
    path = tmp_path / "program.ngc"
    path.write_bytes(codecs.BOM_UTF8)
    with pytest.raises(ProgramError, match="empty"):
        list(interpret(path))
