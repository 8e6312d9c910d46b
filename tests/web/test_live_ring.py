"""Rings, envelopes and messages of the live page, without a socket."""

from __future__ import annotations

import json
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.daemon.live_stream import LIVE_SIGNALS, encode_base64
from fdhil.web.live_feed import LiveFeed
from fdhil.web.live_ring import DRAWN, TEMPERATURE, VOLTAGE, Ring
from fdhil.web.live_view import MOST_UNSEEN, View, finite

PERIOD_S = 0.001


def rows(ticks: Any) -> Any:
    return np.outer(np.arange(1, 1 + len(LIVE_SIGNALS)), np.asarray(ticks)).astype(np.float32)


def filled(capacity: int, *parts: Any) -> Ring:
    ring = Ring(capacity)
    for part in parts:
        ring.put(np.asarray(part, np.int64), rows(part))
    return ring


@settings(max_examples=40)
@given(st.lists(st.integers(1, 30), min_size=1, max_size=30), st.integers(0, 10**9), st.randoms(use_true_random=False))
def test_a_ring_keeps_the_newest_rows_and_what_is_missing_stays_missing(
    sizes: list[int], start: int, chance: Any
) -> None:
    ring, tick = Ring(50), start
    sent: dict[int, int] = {}
    for size in sizes:
        ticks = np.array(sorted(chance.sample(range(tick, tick + size + 5), size)), np.int64)
        ring.put(ticks, rows(ticks))
        sent.update((int(each), each) for each in ticks)
        tick = int(ticks[-1]) + 1
    assert ring.end == tick
    assert ring.begin == max(min(sent), tick - 50)
    kept = ring.rows(tick - 60, tick + 5)
    for column, each in zip(kept.T, range(tick - 60, tick + 5), strict=True):
        if each in sent and each >= ring.begin:
            np.testing.assert_allclose(column[: len(LIVE_SIGNALS)], rows([each])[:, 0])
        else:
            assert np.isnan(column).all()


def test_an_envelope_is_the_least_and_the_greatest_of_whole_columns() -> None:
    ring = filled(1000, range(103, 140), range(160, 203))
    part = ring.envelope(100, 205, 10)
    assert (part.first_tick, part.per_column, part.low.shape) == (100, 10, (len(DRAWN), 10))
    assert part.low[0].tolist()[:4] == [103, 110, 120, 130]
    assert part.high[0].tolist()[:4] == [109, 119, 129, 139]
    assert np.isnan(part.low[:, 4:6]).all()  # lost
    assert part.high[1][-1] == 2 * 199
    assert ring.envelope(101, 109, 10).low.shape[1] == 0


def test_temperature_holds_and_a_sensor_of_its_own_is_laid_on_the_rows() -> None:
    ring = filled(100, range(10))
    ring.warm(23.5)
    ring.put(np.arange(10, 20), rows(range(10, 20)))
    ring.put_voltage(np.array([-5, 12, 13, 50]), np.array([7.0, 8.0, 9.0, 10.0]))
    kept = ring.rows(0, 20)
    assert np.isnan(kept[TEMPERATURE, :10]).all()
    assert (kept[TEMPERATURE, 10:] == 23.5).all()
    assert kept[VOLTAGE, 11:15].tolist() == [11, 8, 9, 14]


def decoded(message: bytes) -> tuple[dict[str, Any], list[Any]]:
    (length,) = struct.unpack_from("<I", message)
    header, place, low = json.loads(message[4 : 4 + length]), 4 + length, []
    assert place % 4 == 0
    for part in header["parts"]:
        count = part["signals"] * part["columns"]
        low.append(np.frombuffer(message, "<f4", count, place).reshape(part["signals"], -1))
        place += 8 * count
    assert place == len(message)
    return header, low


def test_a_browser_is_told_each_column_once_and_in_order() -> None:
    ring, view, told = filled(10_000, range(2000)), View(["X"], 1.0, 100, PERIOD_S), []
    for end in range(2003, 4000, 37):
        ring.put(np.arange(ring.end, end), rows(range(ring.end, end)))
        assert view.may_send()
        header, low = decoded(view.message({"X": ring}, {"trouble": ""}))
        told += [each for part in low for each in part[0].tolist()]
        assert all(part["per_column"] == 10 and part["skipped_ticks"] == 0 for part in header["parts"])
        view.drawn(header["number"])
    assert told == list(range(1010, 1010 + 10 * len(told), 10))  # one second back, then what came
    assert told[-1] == ring.end // 10 * 10 - 10


def test_a_slow_browser_gets_wider_columns_and_is_told_what_was_skipped() -> None:
    ring, view = filled(100_000, range(5000)), View(["X"], 5.0, 500, PERIOD_S)
    for _ in range(MOST_UNSEEN):
        assert view.may_send()
        first, _ = decoded(view.message({"X": ring}, {}))
    assert not view.may_send()
    ring.put(np.arange(5000, 8000), rows(range(5000, 8000)))
    view.drawn(first["number"])
    assert view.may_send()
    header, low = decoded(view.message({"X": ring}, {}))
    assert [(p["per_column"], p["skipped_ticks"]) for p in header["parts"]] == [(80, 0)]
    assert low[0].shape[1] <= 50  # what half a second has in full
    assert header["parts"][0]["first_tick"] == 4960  # no hole: a wide column begins where one may
    ring.put(np.arange(8000, 20_000), rows(range(8000, 20_000)))
    view.drawn(header["number"])
    header, _ = decoded(view.message({"X": ring}, {}))
    assert header["parts"][0]["skipped_ticks"] == 20_000 - 5000 - 8000
    assert header["parts"][0]["first_tick"] > 15_000 - header["parts"][0]["per_column"]
    view.drawn(10**9)  # a browser that says more than it was sent gains nothing
    assert view.may_send()
    for _ in range(MOST_UNSEEN):
        view.message({"X": ring}, {})
    assert not view.may_send()


def test_json_has_no_number_where_there_is_none() -> None:
    assert finite(np.array([1.00004, np.nan, np.inf, -np.inf, -2.5], np.float32)) == [1.0, None, None, None, -2.5]


def feed_of(axes: str = "XY") -> LiveFeed:
    return LiveFeed(Path("/nowhere"), dict.fromkeys(axes), PERIOD_S)


def line(axis: str, ticks: Any) -> dict[str, Any]:
    ticks = np.asarray(ticks)
    whole = int(ticks[-1] - ticks[0]) == ticks.size - 1
    holes = {} if whole else {"ticks": encode_base64(ticks - ticks[0], "<i4")}
    return {
        "live": "samples",
        "axis": axis,
        "tick": int(ticks[0]),
        "values": encode_base64(rows(ticks), "<f4"),
        **holes,
    }


def test_two_buses_and_a_daemon_that_begins_anew_share_one_count() -> None:
    feed = feed_of()
    for first in range(0, 400, 50):
        feed.take(line("X", range(first, first + 50)))
        feed.take(line("Y", range(70_000 + first, 70_050 + first)))  # another bus counts otherwise
    x, y = feed.rings["X"], feed.rings["Y"]
    assert abs(x.end - y.end) * PERIOD_S < 60  # both by when they came, on however busy a host
    assert abs(x.end - time.monotonic() / PERIOD_S) * PERIOD_S < 60
    before = x.end
    feed.take(line("X", range(20)))  # the count begins anew
    assert x.end >= before + 20
    assert np.isfinite(x.rows(x.end - 20, x.end)[0]).all()
    assert np.isfinite(x.rows(before - 400, before)[0]).all()
    feed.take(line("Z", range(5)))  # an axis that is not in the configuration


def test_two_axes_of_one_bus_stay_side_by_side_and_gaps_stay() -> None:
    feed = feed_of()
    feed.take(line("X", [0, 1, 3]))
    feed.take(line("Y", [0, 1, 2, 3]))
    assert feed.rings["X"].end == feed.rings["Y"].end
    end = feed.rings["X"].end
    assert np.isnan(feed.rings["X"].rows(end - 4, end)[0]).tolist() == [False, False, True, False]


def test_the_voltage_of_a_sensor_is_laid_by_the_time_of_the_ticks() -> None:
    feed = feed_of("X")
    feed.take(
        {
            "live": "voltage",
            "axis": "X",
            "t_ns": encode_base64(np.array([1]), "<i8"),
            "values": encode_base64(np.ones(1), "<f4"),
        }
    )
    feed.take({"live": "times", "tick": [100, 149], "t_ns": [7_000_000, 56_000_000]})
    feed.take(line("X", range(100, 150)))
    stamps = np.array([10_200_000, 11_300_000])
    feed.take(
        {
            "live": "voltage",
            "axis": "X",
            "t_ns": encode_base64(stamps, "<i8"),
            "values": encode_base64(np.array([3.5, 4.5]), "<f4"),
        }
    )
    end = feed.rings["X"].end
    assert feed.rings["X"].rows(end - 50, end)[VOLTAGE, 2:6].tolist() == [102, 3.5, 4.5, 105]


def test_lines_that_are_no_block_are_a_fault_of_the_line() -> None:
    with pytest.raises(ValueError, match="base64"):
        feed_of("X").take({**line("X", range(5)), "values": "no base64"})
    feed = feed_of("X")
    feed.take({"live": "skipped", "lines": 7})
    feed.take({"live": "something new"})
    assert feed.skipped_lines == 7
