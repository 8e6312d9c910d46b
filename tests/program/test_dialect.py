"""Programs of other NCs: P of a dwell in milliseconds, and numbers without a point in thousandths."""

from __future__ import annotations

from typing import Any

import pytest

from fdhil.config import Nc
from fdhil.program import Arc, Budget, Dwell, Motion, interpret


def run_program(text: str, **nc: Any) -> list[Motion]:
    return list(interpret(text.split("|"), Budget.create_from_config(Nc(**nc))))


def find_end(text: str, **nc: Any) -> tuple[float, float, float]:
    last = run_program(text, **nc)[-1]
    assert not isinstance(last, Dwell)
    return last.end


@pytest.mark.parametrize(
    ("unit", "text", "seconds"),
    [
        ("s", "G4 P500", 500.0),
        ("s", "G4 P0.5", 0.5),
        ("ms", "G4 P500", 0.5),
        ("ms", "G4 P500.", 0.5),
        ("ms_without_point", "G4 P500", 0.5),
        ("ms_without_point", "G4 P.5", 0.5),
        ("ms_without_point", "G4 P2.", 2.0),
        ("ms_without_point", "#1=500|G4 P#1", 500.0),
        ("ms", "F100 G82 X1 Z-1 R1 P500", 0.5),
        ("ms_without_point", "F100 G89 X1 Z-1 R1 P250", 0.25),
    ],
)
def test_dwell_is_in_configured_unit(unit: str, text: str, seconds: float) -> None:
    assert [m.seconds for m in run_program(text, dwell_unit=unit) if isinstance(m, Dwell)] == [pytest.approx(seconds)]


@pytest.mark.parametrize(
    ("text", "end"),
    [
        ("G0 X10000", (10.0, 0, 0)),
        ("G0 X10.", (10.0, 0, 0)),
        ("G0 X-2500 Y1.5", (-2.5, 1.5, 0)),
        ("G91 G0 X10000|X10000", (20.0, 0, 0)),
        ("G20 G0 X10000", (25.4, 0, 0)),
        ("G20|G0 X10000", (25.4, 0, 0)),
        ("G20|G21 G0 X10000", (10.0, 0, 0)),
        ("#1=5|G0 X#1 Y[2+1]", (5.0, 3.0, 0)),
        ("G10 L2 P1 X1000|G0 X1000", (2.0, 0, 0)),
        ("G92 X-1000|G0 X0", (1.0, 0, 0)),
        ("F100 G83 X1000 Z-3000 R1000 Q1000|G80|G0 Z2000", (1.0, 0, 2.0)),
        ("N10 G0 X10000 (X20000)", (10.0, 0, 0)),
    ],
)
def test_length_without_point_is_in_thousandths(text: str, end: tuple[float, float, float]) -> None:
    for integers in ("thousandths", "thousandths_and_feed"):
        assert find_end(text, integers=integers) == pytest.approx(end)


def test_codes_counts_and_parameters_are_not_scaled() -> None:
    arc = run_program("F100. G2 X20000 I10000 P2|M2", integers="thousandths")[0]
    assert isinstance(arc, Arc)
    assert (arc.end[0], arc.centre[0], arc.turns) == (20.0, 10.0, -2)
    assert find_end("#1=1000|o1 repeat [2]|G91 G0 X1000|o1 endrepeat", integers="thousandths") == (2.0, 0, 0)


@pytest.mark.parametrize(
    ("integers", "text", "feed"),
    [
        ("whole", "G1 X1 F1000", 1000.0),
        ("thousandths", "G1 X1 F1000", 1000.0),
        ("thousandths_and_feed", "G1 X1 F1000", 1.0),
        ("thousandths_and_feed", "G1 X1 F1000.", 1000.0),
        ("thousandths_and_feed", "G20|G1 X1 F10000", 25.4),
    ],
)
def test_feed_without_point_is_whole_unless_configured(integers: str, text: str, feed: float) -> None:
    assert run_program(text, integers=integers)[-1].feed == pytest.approx(feed)  # type: ignore[union-attr]
