"""The language beyond single moves: flow, subroutines in files, cycles, compensation, threads, splines, saved modes."""

from __future__ import annotations

from pathlib import Path

import pytest

from fdhil.errors import GcodeBudget, ProgramError
from fdhil.program import Arc, Budget, Dwell, Feed, Motion, Probe, Rapid, interpret


def list_ends(motions: list[Motion]) -> list[tuple[float, ...]]:
    """Ends of the motions, 4 decimals; for a dwell its time."""
    return [(m.seconds,) if isinstance(m, Dwell) else tuple(round(v, 4) + 0.0 for v in m.end) for m in motions]


def run_program(text: str) -> list[Motion]:
    """Interpret lines separated by "|"."""
    return list(interpret(text.split("|")))


@pytest.mark.parametrize(
    ("text", "x"),
    [
        ("o1 while [#1 lt 3]|G0 X#1|#1=[#1+1]|o1 endwhile", [0, 1, 2]),
        ("o1 do|G0 X#1|#1=[#1+1]|o1 while [#1 lt 3]", [0, 1, 2]),
        ("o1 repeat [2.7]|#1=[#1+1]|G0 X#1|o1 endrepeat", [1, 2, 3]),
        ("o1 while [1]|#1=[#1+1]|o2 if [#1 eq 2]|o1 break|o2 endif|G0 X#1|o1 endwhile", [1]),
        ("o1 while [#1 lt 3]|#1=[#1+1]|o2 if [#1 eq 2]|o1 continue|o2 endif|G0 X#1|o1 endwhile", [1, 3]),
        ("o1 if [0]|G0 X1|o1 elseif [1]|G0 X2|o1 else|G0 X3|o1 endif", [2]),
        ("o1 if [0]|$$$|o1 else|G0 X3|o1 endif", [3]),
        ("o1 sub|G0 X#1|o1 return [#1+1]|o1 endsub|o1 call [4]|G0 X#<_value>", [4, 5]),
        ("o1 sub|G0 X#1|o2 if [#1 gt 1]|o1 call [#1-1]|o2 endif|o1 endsub|o1 call [3]", [3, 2, 1]),
        ("#1=7|o1 sub|#1=[#1+1]|#<a>=5|o1 endsub|o1 call [1]|G0 X#1", [7]),
        ("M98 P7 L2|G0 X9|M2|O7|#1=[#1+1]|G0 X#1|M99", [1, 2, 9]),
        ("o5 call|M2|o5 sub|G0 X1|o5 endsub", [1]),
    ],
)
def test_control_flow_executes_expected_motions(text: str, x: list[float]) -> None:
    assert [end[0] for end in list_ends(run_program(text))] == x


def test_subroutines_are_found_in_files_next_to_program(tmp_path: Path) -> None:
    (tmp_path / "slot.ngc").write_text("(a slot)\no<slot> sub\nG1 X#1 F100\no<slot> endsub\n")
    (tmp_path / "77.ngc").write_text("O0077\nG0 Y7\nM99\n")
    (tmp_path / "main.ngc").write_text("O<Slot> call [3]\nM98 P77\nG0 Z1\nM2\n")
    assert list(interpret(tmp_path / "main.ngc")) == [
        Feed(3, (3.0, 0.0, 0.0), 100.0),
        Rapid(2, (3.0, 7.0, 0.0)),
        Rapid(3, (3.0, 7.0, 1.0)),
    ]
    (tmp_path / "main.ngc").write_text("o<../slot> call [3]\n")
    with pytest.raises(ProgramError, match="ends before"):
        list(interpret(tmp_path / "main.ngc"))


def test_drilling_repeats_while_the_cycle_is_in_force() -> None:
    motions = run_program("G0 Z5|G98 G81 X1 Y1 Z-10 R2 F100|X2|G80")
    assert list_ends(motions)[1:5] == [(1, 1, 5), (1, 1, 2), (1, 1, -10), (1, 1, 5)]
    assert list_ends(motions)[5:] == [(2, 1, 5), (2, 1, 2), (2, 1, -10), (2, 1, 5)]


def test_pecks_retract_to_clearance() -> None:
    depths = [end[2] for end in list_ends(run_program("G0 Z2|G99 G83 X0 Z-4 R2 Q3 F100"))]
    assert depths == [2, 2, -1, 2, -0.746, -4, 2]
    assert [e[2] for e in list_ends(run_program("G0 Z2|G99 G73 X0 Z-4 R2 Q3 F100"))] == [2, 2, -1, -0.746, -4, 2]


def test_compensation_rounds_outside_corners_and_cuts_inside_ones() -> None:
    outside = run_program("F100|G41.1 D2|G1 X10|Y-10|X20|G40|X30")
    assert list_ends(outside) == [(10, 1, 0), (11, 0, 0), (11, -9, 0), (20, -9, 0), (30, -10, 0)]
    assert outside[1] == Arc(4, (11.0, 0.0, 0.0), (10.0, 0.0, None), -1, "XY", 100.0)
    assert list_ends(run_program("F100|G41.1 D2|G1 X10|Z-5|G3 X20 Y10 R10 Z5|G1 X10 Y15")) == [
        (10, 1, 0), (10, 1, -5), (18.9795, 9.3922, 5), (9.5528, 14.1056, 5),
    ]  # fmt: skip
    for text in ("F100|G41.1 D2|G1 X0.5", "F100|G41.1 D2|G1 X10|Y0.5|X20", "F100|G41.1 D2|G1 X10|G55", "T1 M6|G41",
                 "F100|G41.1 D2|G1 X10|G40|G2 X20 I5", "F100|G41.1 D2|G1 X10|G3 X10.5 Y0.5 J0.5"):  # fmt: skip
        with pytest.raises(ProgramError):
            run_program(text)


def test_thread_passes_feed_at_pitch_times_speed() -> None:
    motions = run_program("S100 M3 G18|G0 X20 Z5|G76 P1 Z-5 I1 J0.5 K1 Q30 H1")
    assert list_ends(motions)[1:5] == [(19.5, 0, 4.7113), (21.5, 0, 4.7113), (21.5, 0, -4.7113), (19.5, 0, -4.7113)]
    assert sum(isinstance(m, Feed) for m in motions) == 3
    assert {m.feed for m in motions if isinstance(m, Feed)} == {100.0}


def test_splines_are_followed_within_a_micrometre() -> None:
    motions = run_program("G5 X10 Y10 I10 J0 P0 Q-10 F100|G5 X20 Y0 P0 Q10|G5.1 X30 Y0 I5 J5")
    assert list_ends(motions)[-1] == (30, 0, 0)
    assert any(end == (10, 10, 0) for end in list_ends(motions))
    middle = min(list_ends(motions), key=lambda e: abs(e[0] - 8.75))  # the cubic's middle is (8.75, 1.25)
    assert middle[1] == pytest.approx(1.25, abs=0.3)


def test_modes_are_saved_and_restored() -> None:
    assert list_ends(run_program("M70|G20 G91|G0 X1|M72|G0 X1")) == [(25.4, 0, 0), (1, 0, 0)]
    assert list_ends(run_program("o1 sub|M73|G91|G0 X5|o1 endsub|o1 call|o1 call|G0 X1")) == [
        (5, 0, 0),
        (10, 0, 0),
        (1, 0, 0),
    ]


@pytest.mark.parametrize(
    ("text", "feed"),
    [("F10 G38.2 X5", 10.0), ("G20|F10 G38.3 X5", 254.0), ("G95 S100 F0.5|G38.4 X5", 50.0), ("F7 G38.5 X5|X9", 7.0)],
)
def test_probe_moves_at_feed_to_target(text: str, feed: float) -> None:
    for motion in run_program(text):
        assert isinstance(motion, Probe)
        assert motion.feed == pytest.approx(feed)


def test_probes_rotary_axes_and_block_delete() -> None:
    assert list_ends(run_program("F10 G38.2 X5|G0 Y1|A5 B6 U7")) == [(5, 0, 0), (5, 1, 0), (5, 1, 0)]
    assert len(list(interpret(["/G0 X1", "G0 X2"], block_delete=True))) == 1
    assert len(list(interpret(["/G0 X1", "G0 X2"]))) == 2


@pytest.mark.parametrize(
    "text",
    [
        "o1 while [1]|#1=1|o1 endwhile", "F1|o1 while [1]|G1 X1|o1 endwhile", "o1 sub|o1 call|o1 endsub|o1 call",
        "M98 P1 L9999999|M2|O1|G0 X1|M99", "G81 X1 Z-1 R1 L99999999 F1", "F1 G83 X1 Z-1 R1 Q0.00000001",
        "#1=10|o1 repeat [99]|#1=[#1*#1]|o1 endrepeat", "G0 X[10**300]", "F1 G2 I1 P99999999",
    ],
)  # fmt: skip
@pytest.mark.fault("G6")
def test_hostile_programs_raise_error_with_line(text: str) -> None:
    small = Budget(max_blocks=5000, max_repeated_blocks=1000, max_motions_per_block=500)
    with pytest.raises(ProgramError) as caught:
        list(interpret(text.split("|"), small))
    assert caught.value.line >= 1


@pytest.mark.fault("G6")
def test_file_with_endless_line_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "long.ngc"
    with path.open("wb") as file:
        file.truncate(10_000_000_000)  # a sparse file of zero bytes
    with pytest.raises(GcodeBudget, match="longer than"):
        list(interpret(path))
