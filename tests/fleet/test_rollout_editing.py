"""Values are edited in the text of a configuration, and the text around them is kept."""

from __future__ import annotations

import tomllib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.config.config_template import format_toml, write_template
from fdhil.config.toml_editing import NotEditable, edit_toml
from tests.bench import bench_toml

TEXT = """# the machine
[axis.X.nominal] # of the sheet
  ft = 0.05    # N.m.s, "by # the sheet"
Cd=5.0
#R = 0.5

[nc]
profile = "fir # not a comment" # a comment
smoothing_s = [0.06, 0.03] # two
"""


def test_value_is_changed_and_comment_kept() -> None:
    out = edit_toml(TEXT, {"axis.X.nominal.ft": 0.061, "nc.profile": "trapezoidal"}, "friction version 3")
    assert out == TEXT.replace("  ft = 0.05    #", "# offer friction version 3\n  ft = 0.061    #").replace(
        'profile = "fir # not a comment"', '# offer friction version 3\nprofile = "trapezoidal"'
    )


def test_default_key_is_added_below_comment_and_new_table_at_end() -> None:
    out = edit_toml(TEXT, {"axis.X.nominal.R": 0.7, "axis.X.nominal.K": 0.8, "maintenance.ft": 1.5}, "n")
    assert "#R = 0.5\n# offer n\nR = 0.7\n" in out
    assert out.endswith("\n[maintenance]\n# offer n\nft = 1.5\n")
    assert tomllib.loads(out)["axis"]["X"]["nominal"] == {"ft": 0.05, "Cd": 5.0, "R": 0.7, "K": 0.8}


def test_second_offer_replaces_note_of_first() -> None:
    out = edit_toml(edit_toml(TEXT, {"axis.X.nominal.Cd": 4.0}, "one"), {"axis.X.nominal.Cd": 3.0}, "two")
    assert out == TEXT.replace("Cd=5.0", "# offer two\nCd=3.0")


def test_line_endings_are_kept() -> None:
    out = edit_toml(TEXT.replace("\n", "\r\n"), {"axis.X.nominal.Cd": 4.0, "maintenance.ft": 1.5}, "n")
    assert out.count("\r\n") == out.count("\n")


@pytest.mark.parametrize(
    "text",
    [
        "[axis.X]\nnominal = { ft = 0.05 }\n",
        "[axis.X]\nnominal.ft = 0.05\n",
        "axis.X.nominal.ft = 0.05\n",
        "[axis.X.nominal]\nft = [\n 0.05\n]\n",
        '[axis.X.nominal]\nft = """\n0.05"""\n',
        'a = """\n[axis.X.nominal]\n"""\n[axis.X.nominal]\nft = 0.05\n',
        '[axis.X.nominal]\n"ft" = 0.05\n',
    ],
)
def test_unusual_notation_is_not_edited(text: str) -> None:
    with pytest.raises(NotEditable, match="change them by hand"):
        edit_toml(text, {"axis.X.nominal.ft": 0.06}, "n")


@pytest.mark.parametrize("text", [write_template(), bench_toml()])
def test_each_key_of_complete_file_can_be_changed(text: str) -> None:
    document = tomllib.loads(text)
    for axis in document["axis"]:
        for key, value in document["axis"][axis]["nominal"].items():
            out = edit_toml(text, {f"axis.{axis}.nominal.{key}": value * 1.5}, "n")
            assert tomllib.loads(out)["axis"][axis]["nominal"][key] == value * 1.5
            assert len(out.splitlines()) == len(text.splitlines()) + 1


VALUES = st.one_of(
    st.booleans(), st.integers(-(2**60), 2**60), st.floats(allow_nan=False, allow_infinity=False),
    st.text(st.characters(exclude_categories=["Cs", "Cc"])), st.lists(st.floats(0, 1), max_size=3),
)  # fmt: skip


@settings(max_examples=150, deadline=None)
@given(st.lists(VALUES, min_size=3, max_size=3), VALUES, st.sampled_from(["", " # x", "  #", ' # "a = 1"']))
def test_edit_changes_nothing_else(old: list[object], new: object, comment: str) -> None:
    text = "".join(f"k{n} = {format_toml(value)}{comment}\n" for n, value in enumerate(old))
    text = f"[a.b]\n{text}[c]\nk1 = 7\n"
    out = edit_toml(text, {"a.b.k1": new}, "n")
    lines = text.splitlines()
    assert out.splitlines() == [*lines[:2], "# offer n", f"k1 = {format_toml(new)}{comment}", *lines[3:]]
