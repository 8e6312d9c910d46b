"""The NC's state is shown; unusual states are reported once, and once when they end."""

from __future__ import annotations

from dataclasses import replace

from fdhil.cli.status_view import format_nc_state
from fdhil.daemon.nc_watch import NcWatch
from fdhil.records import MoveKind, NcState, Notice

WORKING = NcState(
    0, 1000, MoveKind.RAPID, 12, 1000.0, 500.0, 1.0, 1.0, False, 3, "/nc/part.ngc", {"X": 1.0}, 77, 0.001
)  # fmt: skip
TROUBLE = Notice("DriveFault", "MAJOR", "the drive has a fault", "X")


def test_override_and_feed_hold_are_reported_once_and_at_their_end() -> None:
    watch, result = NcWatch(), []
    for state in (
        WORKING,
        replace(WORKING, rapid_override=0.5),
        replace(WORKING, rapid_override=0.4),
        replace(WORKING, rapid_override=0.4, feed_hold=True),
        replace(WORKING, motion=MoveKind.UNKNOWN, rapid_override=None),
        WORKING,
    ):
        result += [(notice.code, notice.severity) for notice in watch.take_state(state, 1.0)]
    assert result == [
        ("OverrideChanged", "minor"), ("FeedHold", "minor"), ("FeedHold", "info"), ("OverrideChanged", "info"),
    ]  # fmt: skip


def test_problem_is_reported_with_the_current_nc_line() -> None:
    watch = NcWatch()
    assert watch.add_nc_line(TROUBLE, 0.0) == TROUBLE
    watch.take_state(WORKING, 1.0)
    assert watch.add_nc_line(TROUBLE, 1.5).text == "the drive has a fault (the NC is at line 12 of part.ngc)"
    assert watch.add_nc_line(replace(TROUBLE, severity="info"), 1.5).text == TROUBLE.text
    assert watch.add_nc_line(TROUBLE, 3.0) == TROUBLE, "an NC that is not heard any more is nowhere"
    watch.take_state(replace(WORKING, motion=MoveKind.REST), 4.0)
    assert watch.add_nc_line(TROUBLE, 4.0) == TROUBLE


def test_status_shows_the_nc_state() -> None:
    watch = NcWatch()
    assert watch.build_status(0.0) is None
    watch.take_state(replace(WORKING, rapid_override=0.5, feed_hold=True), 1.0)
    status = watch.build_status(1.25)
    assert status is not None
    assert (status["heard_s_ago"], status["motion"], status["tool"]) == (0.25, "rapid", 3)
    line = "NC: rapid line 12 of part.ngc, feed override 100 %, rapid override 50 %, feed hold"
    assert format_nc_state(status) == line
    watch.take_state(NcState(0, 0, MoveKind.UNKNOWN), 2.0)
    status = watch.build_status(5.0)
    assert status is not None
    assert format_nc_state(status) == "NC: no data for 3 s, its moves are unknown"


def test_non_unicode_program_name_is_escaped() -> None:
    watch = NcWatch()
    watch.take_state(replace(WORKING, program="/nc/b\udcf6hlen.ngc"), 1.0)
    assert watch.add_nc_line(TROUBLE, 1.5).text == "the drive has a fault (the NC is at line 12 of b\\udcf6hlen.ngc)"
    assert watch.add_nc_line(replace(TROUBLE, severity="info", text="\udcf6"), 1.5).text == "\\udcf6"
    status = watch.build_status(1.5)
    assert status is not None
    assert status["program"] == "/nc/b\\udcf6hlen.ngc"
