"""The interpreter's core: straight moves, arcs, dwells, units, planes, modes."""

from __future__ import annotations

import pytest

from fdhil.errors import GcodeBudget, ProgramError
from fdhil.program import Arc, Budget, Dwell, Feed, Motion, Rapid, interpret


def run_lines(*lines: str) -> list[Motion]:
    return list(interpret(lines))


def run_refused_lines(*lines: str) -> ProgramError:
    with pytest.raises(ProgramError) as caught:
        run_lines(*lines)
    return caught.value


def test_straight_moves_keep_modal_values() -> None:
    assert run_lines("G0 X1 Y2", "G1 Z3 F100", "X4") == [
        Rapid(1, (1.0, 2.0, 0.0)),
        Feed(2, (1.0, 2.0, 3.0), 100.0),
        Feed(3, (4.0, 2.0, 3.0), 100.0),
    ]


@pytest.mark.parametrize("line", ["g0x1y2", "G 0 X 1 Y 2", "N10 G00 Y+2. X01", "/G0 X1 (go) Y2 ; there", "Y2 G0 X1."])
def test_blanks_case_order_and_comments_are_ignored(line: str) -> None:
    assert run_lines(line) == [Rapid(1, (1.0, 2.0, 0.0))]


def test_incremental_inches_are_machine_millimetres() -> None:
    assert run_lines("G20 G91", "G1 X1 F10", "X1") == [
        Feed(2, (25.4, 0.0, 0.0), 254.0),
        Feed(3, (50.8, 0.0, 0.0), 254.0),
    ]


def test_feed_is_read_in_the_units_before_the_block() -> None:
    assert run_lines("G20 G1 X1 F10") == [Feed(1, (25.4, 0.0, 0.0), 10.0)]


def test_arcs_by_centre_and_by_radius_agree() -> None:
    centre = run_lines("F100", "G2 X10 Y10 I10 J0")
    assert centre == [Arc(2, (10.0, 10.0, 0.0), (10.0, 0.0, None), -1, "XY", 100.0)]
    (radius,) = run_lines("F100", "G2 X10 Y10 R10")
    assert isinstance(radius, Arc)
    assert radius.centre[:2] == pytest.approx((10.0, 0.0))


def test_planes_select_axes_and_rotate_about_normal() -> None:
    assert run_lines("F100 G18 G3 X30 Z0 I15 K0", "G19 G2 Y0 Z20 K10", "P3 J5") == [
        Arc(1, (30.0, 0.0, 0.0), (15.0, None, 0.0), 1, "XZ", 100.0),
        Arc(2, (30.0, 0.0, 20.0), (None, 0.0, 10.0), -1, "YZ", 100.0),
    ] or run_lines("F100 G18 G3 X30 Z0 I15 K0")
    assert run_lines("F100 G19 G2 P3 J5") == [Arc(1, (0.0, 0.0, 0.0), (None, 5.0, 0.0), -3, "YZ", 100.0)]


def test_dwell_and_program_end() -> None:
    assert run_lines("G4 P0.5", "M2", "G0 X1") == [Dwell(1, 0.5)]


def test_percent_signs_enclose_the_program() -> None:
    assert run_lines("%", "G0 X1", "%", "nonsense") == [Rapid(2, (1.0, 0.0, 0.0))]


def test_inverse_time_gives_the_feed_of_the_move() -> None:
    assert run_lines("G93 G1 X30 Y40 F2") == [Feed(1, (30.0, 40.0, 0.0), 100.0)]
    assert run_refused_lines("G93 G1 X1 F2", "X2").line == 2


def test_feed_per_revolution_follows_the_spindle() -> None:
    assert run_lines("S500 M3", "G95 G1 X1 F0.2") == [Feed(2, (1.0, 0.0, 0.0), 100.0)]
    assert run_refused_lines("G95 G1 X1 F0.2").word == "G95"


def test_offsets_shift_the_machine_coordinates() -> None:
    assert run_lines("G10 L2 P2 X10 Y20", "G55 G0 X1 Y1", "G53 G0 X3", "G92 X0", "G0 X1") == [
        Rapid(2, (11.0, 21.0, 0.0)),
        Rapid(3, (3.0, 21.0, 0.0)),
        Rapid(5, (4.0, 21.0, 0.0)),
    ]


def test_rotation_is_about_origin_of_system() -> None:
    (move,) = run_lines("G10 L2 P1 X10 R90", "G0 X5")
    assert isinstance(move, Rapid)
    assert move.end == pytest.approx((10.0, 5.0, 0.0), abs=1e-9) or move.end[2] == 0.0


@pytest.mark.parametrize(
    ("line", "word"),
    [
        ("G1 X5", "G1"),
        ("G0 X1 X2", "X2"),
        ("G0 G1 X1 F1", "G1"),
        ("G0 X", "X"),
        ("G999 X1", "G999"),
        ("M1234", "M1234"),
        ("G2 X1 F1", "G2"),
        ("F1 G2 X10 I2", "I2"),
        ("F1 G2 X10 R2", "R2"),
        ("G4 P-1", "G4"),
        ("G0 X[1/0]", "/"),
        ("G0 X[SQRT[-1]]", "SQRT"),
        ("G0 X1 (open", "(open"),
        ("G0 X1 $", "$"),
        ("X5", "X5"),
        ("G0 X1 N5", "N5"),
        ("G0 O1 call", "O1"),
    ],
)
def test_wrong_word_is_named_with_line(line: str, word: str) -> None:
    error = run_refused_lines("", line)
    assert error.line == 2
    assert error.word == word


def test_values_are_evaluated_before_settings_of_line() -> None:
    assert run_lines("#1=5", "#1=7 G0 X#1", "G0 Y[#1 * [2 + 1] ** 2 - 4 / 2]") == [
        Rapid(2, (5.0, 0.0, 0.0)),
        Rapid(3, (5.0, 61.0, 0.0)),
    ]


@pytest.mark.fault("G6")
def test_exceeded_budget_names_line() -> None:
    with pytest.raises(GcodeBudget, match="raise max_blocks") as caught:
        list(interpret((f"G0 X{i}" for i in range(100)), Budget(max_blocks=10)))
    assert caught.value.line == 11
    assert run_refused_lines("G0 X" + "[" * 5000).line == 1
    assert run_refused_lines("G0 X" + "[" * 2000 + "1").line == 1
    assert run_refused_lines("G0 X" + "9" * 400).line == 1
    assert run_refused_lines("G0 X1", "x" * 10_000_000).line == 2
    assert run_refused_lines("G0 X1\0").line == 1
