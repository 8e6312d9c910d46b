"""Endless loops are distinguished from long ones, and repeated execution has its own limit."""

from __future__ import annotations

from pathlib import Path

import pytest

from fdhil.errors import ProgramError
from fdhil.program import Budget, interpret

WIDE = Budget(max_repeated_blocks=1_000_000)


@pytest.mark.parametrize(
    ("text", "line", "word"),
    [
        ("o1 while [1]|o1 endwhile", 2, "O1 ENDWHILE"),
        ("o<wait> do|G4 P0.1|o<wait> while [1]", 3, "O<WAIT> WHILE"),
        ("F100|o1 while [1]|G1 X1|X0|o1 endwhile", 5, "O1 ENDWHILE"),
        ("F100|o1 while [1]|G2 I5|G81 X0 Z-1 R1 L3|o1 endwhile", 5, "O1 ENDWHILE"),
        ("#1=1|o1 while [#1]|#1=-#1|o1 endwhile", 4, "O1 ENDWHILE"),  # repeats in every other turn
        ("o1 sub|#1=[#1+5]|o1 endsub|o2 while [1]|o1 call [3]|o2 endwhile", 6, "O2 ENDWHILE"),
        ("o1 while [1]|o2 if [#1 lt 100]|#1=[#1+1]|o1 continue|o2 endif|o1 endwhile", 6, "O1 ENDWHILE"),
        ("F9 G41.1 D1|o1 while [1]|G1 X9|Y9|X0|Y0|o1 endwhile", 7, "O1 ENDWHILE"),
        ("o1 while [1]|o2 repeat [3]|o3 while [#2 lt 3]|#2=[#2+1]|o3 endwhile|#2=0|o2 endrepeat|o1 endwhile", 8,
         "O1 ENDWHILE"),
    ],
)  # fmt: skip
def test_loop_with_repeated_state_is_refused_as_endless(text: str, line: int, word: str) -> None:
    with pytest.raises(ProgramError, match="never ends") as caught:
        for _ in interpret(text.split("|"), WIDE):
            pass
    assert (caught.value.line, caught.value.word) == (line, word)


@pytest.mark.parametrize(
    "text",
    [
        "#1=0|o1 while [#1 lt 3000]|#1=[#1+1]|o1 endwhile|G0 X1",
        "o1 repeat [3000]|o1 endrepeat|G0 X1",
        "#1=0|o1 do|o2 repeat [70]|o2 endrepeat|#1=[#1+1]|o1 while [#1 lt 90]|G0 X1",
        "#<_turns>=0|o1 while [#<_turns> lt 900]|o2 call|o1 endwhile|G0 X1|M2|o2 sub|#<_turns>=[#<_turns>+1]|o2 endsub",
        "o1 while [#<_x> lt 99.5]|G91 G0 X1|o1 endwhile|G90 G0 X1",
        "M98 P1 L3000|G0 X1|M2|O1|M99",
        "o1 while [#5220 lt 1.5]|G10 L20 P1 X#1|#1=[#1+1]|o2 if [#1 gt 300]|G55|o2 endif|o1 endwhile|G54 G53 G0 X1",
    ],
)
def test_long_loop_with_changing_state_ends(text: str) -> None:
    assert [motion.end[0] for motion in interpret(text.split("|"), WIDE)][-1] == 1.0  # type: ignore[union-attr]


def test_repeated_blocks_are_limited_and_others_are_not() -> None:
    """A main program that calls subroutines after it is not a repetition, however long it is."""
    straight = [f"G1 X{number} F9" for number in range(500)]
    narrow = Budget(max_repeated_blocks=100)
    main = ["M98 P1", *straight, "M98 P1", *straight, "M2", "O1", "G0 Y1", "M99"]
    assert sum(1 for _ in interpret(main, narrow)) == 1002
    loop = ["o1 repeat [2]", *straight, "o1 endrepeat"]
    with pytest.raises(ProgramError, match="raise max_repeated_blocks") as caught:
        list(interpret(loop, narrow))
    assert caught.value.line == 102
    after = [
        "o1 repeat [9]",
        "G0 X1",
        "o1 endrepeat",
        *straight,
        "o2 sub",
        "o3 repeat [2]",
        "o2 return",
        "o3 endrepeat",
    ]
    assert sum(1 for _ in interpret([*after, "o2 endsub", "o2 call", *straight], narrow)) == 1009


def test_motions_of_repeated_block_count() -> None:
    with pytest.raises(ProgramError, match="executed again"):
        list(interpret(["F9", "o1 repeat [9]", "G81 X1 Z-1 R1 L50", "o1 endrepeat"], Budget(max_repeated_blocks=300)))


def test_repeated_lines_from_file_match_those_from_memory(tmp_path: Path) -> None:
    """The call is in the last line, so that every return reads beyond the read-ahead."""
    text = "F9\n#1=0\no1 sub\n#1=[#1+1]\nG1 X#1\no1 endsub\no2 repeat [3]\no1 call [#5420]\no2 endrepeat"
    path = tmp_path / "program.ngc"
    path.write_text(text)
    expected = [1.0, 2.0, 3.0]
    assert [motion.end[0] for motion in interpret(path)] == expected  # type: ignore[union-attr]
    assert [motion.end[0] for motion in interpret(iter(text.split("\n")))] == expected  # type: ignore[union-attr]
