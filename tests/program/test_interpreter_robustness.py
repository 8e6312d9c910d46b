"""For any text, the result is motions or a ProgramError with its line, within the budget."""

from __future__ import annotations

import math

from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.errors import ProgramError
from fdhil.program import Budget, Dwell, interpret
from tests.program.program_generator import GROUPS, generate_program

BUDGET = Budget(max_blocks=300, max_repeated_blocks=100, max_call_depth=5, max_motions_per_block=200)
NUMBERS = st.sampled_from(
    [
        "0",
        "1",
        "2",
        "3",
        "-1",
        "0.5",
        "17",
        "18",
        "19",
        "20",
        "21",
        "28",
        "30",
        "41.1",
        "42.1",
        "40",
        "43.1",
        "49",
        "53",
        "54",
        "55",
        "59.3",
        "73",
        "80",
        "81",
        "83",
        "90",
        "91",
        "92",
        "93",
        "94",
        "98",
        "99",
        "1e9",
        "99999999",
        ".5",
        "[1+2]",
        "#1",
        "#<a>",
        "[#2*3]",
        "sin[30]",
        "-[2]",
        "2.",
    ]
)
LETTERS = st.sampled_from(list("GGGGXYZABCIJKRPQLFSTDHMN@^E/%#"))
WORDS = st.tuples(LETTERS, NUMBERS).map("".join)
KEYWORDS = [
    "sub",
    "endsub",
    "call",
    "while[1]",
    "while[#1]",
    "endwhile",
    "do",
    "repeat[3]",
    "endrepeat",
    "if[1]",
    "if[0]",
    "else",
    "elseif[1]",
    "endif",
    "break",
    "continue",
    "return",
    "call[1][2]",
]
O_WORDS = st.tuples(st.sampled_from(["o1", "o2", "o<a>", "o[1]"]), st.sampled_from(KEYWORDS)).map(" ".join)
LINES = st.one_of(st.lists(WORDS, max_size=6).map(" ".join), O_WORDS, st.just("#1=[#1+1]"), st.text(max_size=30))


def require_motions_or_error(lines: list[str]) -> None:
    """Interpret lines; every motion must be finite, every refusal a ProgramError with a line of the program."""
    refused = 1
    try:
        for motion in interpret(lines, BUDGET):
            assert 1 <= motion.line <= len(lines)
            if isinstance(motion, Dwell):
                assert motion.seconds >= 0.0
            else:
                assert all(math.isfinite(value) for value in motion.end)
    except ProgramError as error:
        refused = error.line
    assert 1 <= refused <= len(lines) + 1


@settings(max_examples=120, deadline=None)
@given(st.lists(LINES, max_size=25))
def test_random_words_give_motions_or_error(lines: list[str]) -> None:
    require_motions_or_error(lines)


@settings(max_examples=80, deadline=None)
@given(st.sampled_from(sorted(GROUPS)), st.integers(0, 10_000), st.data())
def test_damaged_program_gives_motions_or_error(group: str, seed: int, data: st.DataObject) -> None:
    lines = generate_program(group, seed, 8).splitlines()
    for _ in range(data.draw(st.integers(0, 4))):
        row = data.draw(st.integers(0, len(lines) - 1))
        at = data.draw(st.integers(0, len(lines[row])))
        lines[row] = lines[row][:at] + data.draw(st.text(max_size=3)) + lines[row][at + data.draw(st.integers(0, 3)) :]
    require_motions_or_error(lines)
