"""Changed feeds in a program: F words are replaced, everything else is identical, and the motions never change."""

from __future__ import annotations

from pathlib import Path

import pytest

from fdhil.errors import ProgramError
from fdhil.program.budget import Budget
from fdhil.program.feed_words import cut_to_digits, replace_feeds


def write_program(folder: Path, program: bytes, shares: dict[int, float]) -> bytes:
    path = folder / "part.ngc"
    path.write_bytes(program)
    return replace_feeds(path, shares, Budget())


@pytest.mark.parametrize(
    ("program", "shares", "new"),
    [
        (b"%\r\nG1 F1500 X1\r\nX2\r\nX3\r\n%\r\n", {3: 0.333}, b"%\r\nG1 F1500 X1\r\nX2 F499\r\nX3 F1500\r\n%\r\n"),
        (b"G1 X1 f 1 500\nM2", {1: 0.5}, b"G1 X1 f750\nM2"),
        (b"(F1) F200 ;F3\nG1 X1 (\xfc) ; F4\nM2\n", {2: 0.5}, b"(F1) F200 ;F3\nG1 X1 F100 (\xfc) ; F4\nM2\n"),
        (b"G20\nG1 X1 F10\nX2\nM2\n", {2: 0.5}, b"G20\nG1 X1 F5\nX2 F10\nM2\n"),
        (b"G95 S100 M3\nG1 X1 F.1\nX2\nM2\n", {2: 0.5}, b"G95 S100 M3\nG1 X1 F0.05\nX2 F.1\nM2\n"),
        (b"G93\nG1 X1 F10\nX2 F20\nM2\n", {2: 0.5}, b"G93\nG1 X1 F5\nX2 F20\nM2\n"),
        (b"#<fix>=3\nG1 X FIX[2.5] F[#<fix>*2]\nM2\n", {2: 0.5}, b"#<fix>=3\nG1 X FIX[2.5] F[0.5 * [#<fix>*2]]\nM2\n"),
        (
            b"G91 F1000\no1 repeat [3]\nG1 X1\nX2\no1 endrepeat\nM2\n",
            {4: 0.5},
            b"G91 F1000\no1 repeat [3]\nG1 X1 F1000\nX2 F500\no1 endrepeat\nM2\n",
        ),
        (
            b"o1 if [0]\nX&& F[1/0] F3\no1 endif\n/N5 G1 X1 F100\nM2\n",
            {4: 0.5},
            b"o1 if [0]\nX&& F[1/0] F3\no1 endif\n/N5 G1 X1 F50\nM2\n",
        ),
        (b"G1 X1 F100\nM2\n", {}, b"G1 X1 F100\nM2\n"),
    ],
    ids=[
        "modal",
        "blanks",
        "comments",
        "inch",
        "per turn",
        "inverse time",
        "expression",
        "loop",
        "skipped",
        "nothing to do",
    ],
)
def test_only_feeds_change(tmp_path: Path, program: bytes, shares: dict[int, float], new: bytes) -> None:
    assert write_program(tmp_path, program, shares) == new


def test_line_with_two_inherited_feeds_is_refused(tmp_path: Path) -> None:
    program = b"o1 sub\nG91 G1 X1\no1 endsub\nF100\no1 call\nF200\no1 call\nM2\n"
    with pytest.raises(ProgramError, match=r"line 2.*by hand"):
        write_program(tmp_path, program, {2: 0.5})


def test_program_in_several_files_is_refused(tmp_path: Path) -> None:
    (tmp_path / "part2.ngc").write_text("o<part2> sub\nG1 X1 F100\no<part2> endsub\n")
    with pytest.raises(ProgramError, match="subroutines in other files"):
        write_program(tmp_path, b"o<part2> call\nM2\n", {2: 0.5})


def test_feed_is_truncated_never_rounded_up() -> None:
    assert [cut_to_digits(value) for value in (5999.9, 0.12345, 100.0, 0.0)] == [5990, pytest.approx(0.123), 100, 0]
