"""Single codes: motions derived by hand or by geometry, without another interpreter."""

from __future__ import annotations

import math
import tracemalloc
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from fdhil.config import parse_config
from fdhil.errors import ProgramError
from fdhil.program import Budget, Dwell, Feed, Motion, interpret
from fdhil.program.motions import BLEND, Corner
from fdhil.records import Float
from tests.bench import bench_document

ALMOST = 1e-9


def run_program(*lines: str) -> list[Motion]:
    return list(interpret(lines))


def list_ends(*lines: str) -> Float:
    """Ends of the motions, without dwells."""
    return np.array([motion.end for motion in run_program(*lines) if not isinstance(motion, Dwell)])


def list_kinds(*lines: str) -> str:
    return "".join(type(motion).__name__[0] for motion in run_program(*lines))


def test_nurbs_with_circle_weights_is_quarter_circle() -> None:
    """Quadratic, three points, the middle one with weight cos 45 degrees."""
    motions = run_program("G0 X10", "F300 G5.2 P1 L3", f"X10 Y10 P{math.sqrt(0.5):.15f}", "X0 Y10 P1", "G5.3")
    places = np.array([m.end for m in motions if isinstance(m, Feed)])
    assert np.hypot(places[:, 0], places[:, 1]) == pytest.approx(10.0, abs=1e-6)
    assert places[-1] == pytest.approx([0.0, 10.0, 0.0], abs=ALMOST)
    corners = np.concatenate([[[10.0, 0.0, 0.0]], places])
    middles = (corners[1:] + corners[:-1]) / 2.0
    assert np.hypot(middles[:, 0], middles[:, 1]).min() >= 10.0 - 0.001
    assert {m.feed for m in motions if isinstance(m, Feed)} == {300.0}


def test_nurbs_of_order_two_is_polyline() -> None:
    places = list_ends("F100 G5.2 X0 Y1 P1 L2", "X2 Y2 P1", "X2 Y0 P3", "G5.3")
    for corner in ([0.0, 1.0, 0.0], [2.0, 2.0, 0.0]):
        assert np.linalg.norm(places - corner, axis=1).min() < ALMOST
    assert places[-1] == pytest.approx([2.0, 0.0, 0.0])
    first = places[places[:, 1] <= 1.0][:-1]
    assert first[first[:, 0] < 1.0][:, 0] == pytest.approx(0.0, abs=ALMOST)


def test_nurbs_of_order_three_is_parabola_between_midpoints() -> None:
    """Uniform inner knots: the curve passes the middle of two inner control points along the line between them."""
    places = list_ends("F100 G5.2 X0 Y4 P1 L3", "X8 Y4 P1", "X8 Y0 P1", "G5.3")
    assert np.linalg.norm(places - [4.0, 4.0, 0.0], axis=1).min() < ALMOST
    assert places[:, 1].max() == pytest.approx(4.0, abs=ALMOST)
    assert places[:, 0].max() == pytest.approx(8.0, abs=ALMOST)


@pytest.mark.parametrize("lines", [
    ("F1 G5.2 X1 Y1 P1 L3", "G5.3"), ("G5.2 X1 Y1 P1 L3", "X2 Y2 P1", "G5.3"), ("F1 G5.2 X1 P1 L3",),
    ("F1 G5.2 X1 Y1 P-1 L3",), ("F1 G5.2 X1 Y1 P1 L21",), ("F1 G18", "G5.2 X1 Y1 P1 L3"),
])  # fmt: skip
def test_invalid_nurbs_is_refused(lines: tuple[str, ...]) -> None:
    with pytest.raises(ProgramError, match=r"'(G5|P|L|G18)"):
        run_program(*lines)


STEP = ("F100 G18", "O100 sub", "G0 X2 Z0", "G1 Z-10", "X10", "O100 endsub", "G0 X10 Z2")


def test_g71_cuts_along_z_in_steps_of_i_down_to_the_contour() -> None:
    """A shaft of radius 2 and length 10, from one of radius 10: cuts at 10, 8, 6 and 4, then along the contour."""
    motions = run_program(*STEP, "G71 Q100 X10 Z2 D0 I2 R0.5")
    cuts = [m for m in motions if isinstance(m, Feed)]
    at_wall = [m.end for m in cuts if m.end[2] == pytest.approx(-10.0, abs=1e-3)]
    assert [round(x, 3) for x, _, _ in at_wall] == [10.0, 8.0, 6.0, 4.0, 2.0, 10.0]
    assert all(m.end[0] >= 2.0 - ALMOST and m.end[2] >= -10.0 - ALMOST for m in motions if not isinstance(m, Dwell))
    assert {m.feed for m in cuts} == {100.0}


def test_g71_leaves_d_for_finishing_and_g72_cuts_along_x() -> None:
    left = [m.end for m in run_program(*STEP, "G71 Q100 X10 Z2 D0.5 I2 R0.5") if isinstance(m, Feed)]
    assert min(x for x, _, _ in left) == pytest.approx(2.5, abs=1e-6)
    assert min(z for _, _, z in left) == pytest.approx(-9.5, abs=1e-6)
    face = ("F100 G18", "O100 sub", "G0 Z-6", "G1 X2", "Z2", "O100 endsub", "G0 X10 Z2")
    cuts = [m.end for m in run_program(*face, "G72 Q100 X10 Z2 D0 I2 R0.5") if isinstance(m, Feed)]
    assert [round(z, 3) for x, _, z in cuts if x == pytest.approx(2.0, abs=1e-3)] == [2.0, 0.0, -2.0, -4.0, -6.0, 2.0]


def test_g70_follows_the_contour_from_d_to_e_in_p_passes() -> None:
    motions = run_program(*STEP, "G70 Q100 X10 Z2 D1 E0 P2")
    turned = [m.end[0] for m in motions if isinstance(m, Feed) and m.end[2] < -5.0 and m.end[0] < 5.0]
    assert turned == pytest.approx([2.5, 2.0])


@pytest.mark.parametrize("line", ["G71 X1", "G71 Q7 X10 Z2", "G71 Q100 X10 Z2 I0", "G17 G71 Q100 X10 Z2"])
def test_invalid_roughing_is_refused(line: str) -> None:
    with pytest.raises(ProgramError):
        run_program(*STEP, line)


def test_contour_with_oversized_corners_is_refused() -> None:
    """LinuxCNC's own interpreter never ends on it."""
    lines = ("G0 X1 Z0", "G1 Z-2 A0.4", "G1 X2 Z-8 C0.5", "G1 X4 Z-11", "G1 X8 Z-17 C0.5", "O100 endsub", "G0 X11 Z2")
    with pytest.raises(ProgramError, match="a line of the contour has no length"):
        run_program("F100 G18", "O100 sub", *lines, "G71.2 Q100 X11 Z2 D0.2 I0.5 R0.5")


def test_arc_outside_xy_of_rotated_system_becomes_chords() -> None:
    """A half circle in XZ, rotated by 30 degrees about Z: all of it lies in the rotated plane, 5 mm from its centre."""
    places = list_ends("G10 L2 P1 R30", "F100 G18", "G2 X10 Z0 I5")
    way = np.array([math.cos(math.radians(30.0)), math.sin(math.radians(30.0)), 0.0])
    assert places[-1] == pytest.approx(10.0 * way, abs=1e-9)
    assert places @ [way[1], -way[0], 0.0] == pytest.approx(0.0, abs=1e-9)
    assert np.linalg.norm(places - 5.0 * way, axis=1) == pytest.approx(5.0, abs=1e-9)
    assert np.abs(np.diff(places[:, 2])).max() < 0.3
    assert places[:, 2].min() == pytest.approx(-5.0, abs=1e-2)  # clockwise seen from +Y, with Z to the right and X up


def test_g70_enters_compensation_on_its_way_to_the_contour_in_every_pass() -> None:
    places = list_ends(*STEP, "G42.1 D1", "G70 Q100 X10 Z2 P2", "G40")
    first, second = places[2:6], places[6:10]
    assert first[[0, 2, 3]].tolist() == [[10, 0, 2], [2.5, 0, -9.5], [10, 0, -9.5]]
    assert (second == first).all()
    assert len(places) == 10


@pytest.mark.parametrize(("before", "feed"), [("F100 G1 X1", 100.0), ("G93 G1 X1 F50", 50.0)])
def test_a_spline_under_g93_keeps_the_feed_before_it(before: str, feed: float) -> None:
    motions = run_program(before, "G93 G5.1 X10 Y10 I5 J0 F2")
    assert {m.feed for m in motions if isinstance(m, Feed)} == {feed}


@pytest.mark.parametrize("before", ["G93", "F100 G1 X1|G94", "M3 S100 G95 F1 G1 X1"])
def test_a_spline_under_g93_without_a_feed_before_it_is_refused(before: str) -> None:
    with pytest.raises(ProgramError, match="there is none"):
        run_program(*before.split("|"), "G93 G5.1 X10 Y10 I5 J0 F2")


def test_home_moves_via_given_words() -> None:
    assert list_ends("G0 X1 Y2 Z3", "G28.1", "G0 X5", "G28 Z9", "G30").tolist() == [
        [1, 2, 3], [5, 2, 3], [5, 2, 9], [5, 2, 3], [5, 2, 3], [0, 0, 0]
    ]  # fmt: skip


@pytest.mark.parametrize(("lines", "last"), [
    (("G52 X5", "G0 X1"), [6, 0, 0]),
    (("G10 L20 P1 X5", "G0 X0"), [-5, 0, 0]),
    (("G10 L2 P9 X3", "G59.3", "G0 X1"), [4, 0, 0]),
    (("G43.1 Z2", "G0 Z1"), [0, 0, 1]),
    (("G92 X5", "G0 X7", "G92.1", "G0 X7"), [7, 0, 0]),
    (("G92 X5", "G92.2", "G0 X7", "G92.3", "G0 X7"), [2, 0, 0]),
    (("G7 G0 X10",), [5, 0, 0]),
    (("G7 G0 X10", "G8 X10"), [10, 0, 0]),
    (("G20 G0 X1", "G21 X1"), [1, 0, 0]),
    (("G91 G0 X1", "X1", "G90 X1.5"), [1.5, 0, 0]),
    (("G0 @10 ^90",), [0, 10, 0]),
    (("M70", "G91", "M72", "G0 X1", "X1"), [1, 0, 0]),
    (("G80 G80", "G0 X1"), [1, 0, 0]),
    (("#5221=10", "G0 X1", "G55", "G54", "G0 X3"), [13, 0, 0]),
])  # fmt: skip
def test_axis_end_positions(lines: tuple[str, ...], last: list[float]) -> None:
    assert list_ends(*lines)[-1] == pytest.approx(last, abs=ALMOST)


def test_path_control_is_attached_to_each_motion() -> None:
    text = ("G0 X1", "G61 X2", "G61.1 X3", "G64 P0.1 X4", "G64 P0.1 Q0.02 X5", "G64 X6", "G20 G64 P0.01 X1")
    assert [getattr(motion, "corner", None) for motion in run_program(*text)] == [
        BLEND, Corner("exact_path", 0.0), Corner("exact_stop", 0.0), Corner("blend", 0.1, 0.1),
        Corner("blend", 0.1, 0.02), BLEND, Corner("blend", 0.254, 0.254),
    ]  # fmt: skip


def test_feed_follows_spindle() -> None:
    assert run_program("M3 S100", "G33 Z-5 K1.5") == [Feed(2, (0.0, 0.0, -5.0), 150.0)]
    assert run_program("M3 S0", "G33 Z-5 K1") == [
        Feed(2, (0.0, 0.0, -5.0), 0.0)
    ]  # the spindle is stopped; no plan accepts it
    assert [m.feed for m in run_program("M3 S100", "G33.1 Z-5 K1 I2") if isinstance(m, Feed)] == [100.0, 200.0]
    with pytest.raises(ProgramError, match="spindle"):
        run_program("G33 Z-5 K1")


@pytest.mark.parametrize(("line", "expected"), [
    ("G81 X1 Z-3 R2", "RRFR"), ("G82 X1 Z-3 R2 P1", "RRFDR"), ("G85 X1 Z-3 R2", "RRFFR"), ("G86 X1 Z-3 R2 P1", "RRFDR"),
    ("G89 X1 Z-3 R2 P1", "RRFDF"), ("G83 X1 Z-3 R2 Q3", "RRFRRFR"), ("G73 X1 Z-3 R2 Q3", "RRFRFR"),
    ("G81 X1 Z-3 R2 L2", "RRFRRFR"),
])  # fmt: skip
def test_canned_cycle_orders_its_motions(line: str, expected: str) -> None:
    """From Z5: to R above the hole, down by feed, a dwell, and back by rapid, or by feed and a rapid of no length."""
    assert list_kinds("F100 M3 S100 G99", "G0 Z5", line)[1:] == expected


def test_negative_dwell_takes_no_time_and_minus_one_is_missing() -> None:
    assert run_program("G4 P-0.5") == [Dwell(1, 0.0)]
    with pytest.raises(ProgramError, match="'G4'"):
        run_program("G4 P-1")


def test_g92_1_is_allowed_with_cutter_compensation() -> None:
    assert list_ends("F100 G41.1 D2", "G1 X10", "G92.1", "Y10", "G40", "X5").tolist() == [
        [9, 1, 0],
        [9, 10, 0],
        [5, 10, 0],
    ]


def test_outputs_order_no_motion() -> None:
    assert run_program("M62 P-1", "M64 P3", "M67 E0 Q1", "M66 P0 L0", "M66 E0 L0") == []


@pytest.mark.parametrize(("text", "line", "word"), [
    ("O1 while [1]\nO1 endwhile", 2, "O1 ENDWHILE"), ("O1 do\n#1=[#1+1]\nO1 while [1]", 3, "O1 while [1]"),
    ("O1 sub\nO1 call\nO1 endsub\nO1 call", 2, "O<1>"), ("M98 P1\nM2\nO1\nM98 P1\nM99", 4, "O<1>"),
    ("F1\nG0 X99999999", 2, "X1e+08"), ("G0 X[" + "9" * 400 + "]", 1, "9" * 12), ("F1 G2 I5 P2000000", 1, "P2e+06"),
    ("G0 X" + "[" * 200 + "1" + "]" * 200, 1, "X" + "[" * 11),
])  # fmt: skip
def test_budgets_of_the_configuration_name_line_and_word(text: str, line: int, word: str) -> None:
    document = bench_document()
    document["nc"] = {"max_blocks": 3000, "max_repeated_blocks": 1001, "max_call_depth": 7}
    budget = Budget.create_from_config(parse_config(document).nc)
    with pytest.raises(ProgramError) as caught:
        list(interpret(text.splitlines(), budget))
    assert (caught.value.line, caught.value.word) == (line, word)


def test_calls_nest_up_to_configured_depth() -> None:
    lines = ["O1 sub", "#1=[#1-1]", "O2 if [#1 gt 0]", "O1 call [#1]", "O2 endif", "O1 endsub"]
    assert not list(interpret([*lines, "O1 call [7]"], Budget(max_call_depth=7)))
    with pytest.raises(ProgramError, match="deeper than 7"):
        list(interpret([*lines, "O1 call [8]"], Budget(max_call_depth=7)))


LINES = 1_000_000


@pytest.mark.usefixtures("long_computation")
def test_million_lines_are_read_in_constant_memory(tmp_path: Path) -> None:
    """A file of 20 Mbyte: memory after twenty thousand lines equals that after five hundred."""
    path = tmp_path / "long.ngc"
    thousand = "".join(f"G1 X{number} Y{number % 89} F600\n" for number in range(1000))
    path.write_text(thousand * (LINES // 1000))
    motions = interpret(path)
    held = []
    tracemalloc.start()
    for count in (500, 2000, 18_000):
        tracemalloc.reset_peak()
        assert sum(1 for _ in islice(motions, count)) == count
        held.append(tracemalloc.get_traced_memory()[1])
    tracemalloc.stop()
    assert held[2] < held[0] + 20_000
    assert held[2] < 1_000_000


@pytest.mark.usefixtures("real_time")
def test_streamed_lines_use_at_most_four_megabytes() -> None:
    """A loop might need them again: beyond 4 Mbyte they are stored on disk."""
    motions = interpret(f"G1 X{number % 997} F600 ({'x' * 3900})" for number in range(1500))
    tracemalloc.start()
    assert sum(1 for _ in motions) == 1500
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10_000_000


def test_missing_called_block_is_reported_by_number() -> None:
    """As written, and without fdhil's internal name for such a block."""
    with pytest.raises(ProgramError, match="line 1, 'O99': is called but does not exist"):
        run_program("M98 P99", "M2")


def test_s_curve_cornering_is_refused_by_name() -> None:
    for cycle in ("G80", "G81 X1 Z-1 R1"):
        with pytest.raises(ProgramError, match=r"line 2, 'G64 R': is for the S-curve planner of LinuxCNC 2\.10"):
            list(interpret([f"F100 {cycle}", "G64 P0.01 R2", "G0 X1"]))
