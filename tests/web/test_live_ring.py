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
from fdhil.web.live_ring import DRAWN, TEMPERATURE, VOLTAGE, SampleRing
from fdhil.web.live_view import MOST_UNSEEN, LiveView, round_finite

PERIOD_S = 0.001


def make_samples(ticks: Any) -> Any:
    return np.outer(np.arange(1, 1 + len(LIVE_SIGNALS)), np.asarray(ticks)).astype(np.float32)


def make_filled_ring(capacity: int, *parts: Any) -> SampleRing:
    ring = SampleRing(capacity)
    for part in parts:
        ring.put_samples(np.asarray(part, np.int64), make_samples(part))
    return ring


@settings(max_examples=40)
@given(st.lists(st.integers(1, 30), min_size=1, max_size=30), st.integers(0, 10**9), st.randoms(use_true_random=False))
def test_ring_keeps_newest_samples_and_gaps(sizes: list[int], start: int, chance: Any) -> None:
    ring, tick = SampleRing(50), start
    sent: dict[int, int] = {}
    for size in sizes:
        ticks = np.array(sorted(chance.sample(range(tick, tick + size + 5), size)), np.int64)
        ring.put_samples(ticks, make_samples(ticks))
        sent.update((int(each), each) for each in ticks)
        tick = int(ticks[-1]) + 1
    assert ring.end == tick
    assert ring.begin == max(min(sent), tick - 50)
    kept = ring.read_samples(tick - 60, tick + 5)
    for column, each in zip(kept.T, range(tick - 60, tick + 5), strict=True):
        if each in sent and each >= ring.begin:
            np.testing.assert_allclose(column[: len(LIVE_SIGNALS)], make_samples([each])[:, 0])
        else:
            assert np.isnan(column).all()


def test_envelope_is_minimum_and_maximum_of_complete_columns() -> None:
    ring = make_filled_ring(1000, range(103, 140), range(160, 203))
    part = ring.compute_envelope(100, 205, 10)
    assert (part.first_tick, part.per_column, part.low.shape) == (100, 10, (len(DRAWN), 10))
    assert part.low[0].tolist()[:4] == [103, 110, 120, 130]
    assert part.high[0].tolist()[:4] == [109, 119, 129, 139]
    assert np.isnan(part.low[:, 4:6]).all()  # lost
    assert part.high[1][-1] == 2 * 199
    assert ring.compute_envelope(101, 109, 10).low.shape[1] == 0


def test_temperature_holds_and_separate_voltage_is_aligned() -> None:
    ring = make_filled_ring(100, range(10))
    ring.set_temperature(23.5)
    ring.put_samples(np.arange(10, 20), make_samples(range(10, 20)))
    ring.put_voltage(np.array([-5, 12, 13, 50]), np.array([7.0, 8.0, 9.0, 10.0]))
    kept = ring.read_samples(0, 20)
    assert np.isnan(kept[TEMPERATURE, :10]).all()
    assert (kept[TEMPERATURE, 10:] == 23.5).all()
    assert kept[VOLTAGE, 11:15].tolist() == [11, 8, 9, 14]


def decode_message(message: bytes) -> tuple[dict[str, Any], list[Any]]:
    (length,) = struct.unpack_from("<I", message)
    header, place, low = json.loads(message[4 : 4 + length]), 4 + length, []
    assert place % 4 == 0
    for part in header["parts"]:
        count = part["signals"] * part["columns"]
        low.append(np.frombuffer(message, "<f4", count, place).reshape(part["signals"], -1))
        place += 8 * count
    assert place == len(message)
    return header, low


def test_browser_receives_each_column_once_in_order() -> None:
    ring, view, reported = make_filled_ring(10_000, range(2000)), LiveView(["X"], 1.0, 100, PERIOD_S), []
    for end in range(2003, 4000, 37):
        ring.put_samples(np.arange(ring.end, end), make_samples(range(ring.end, end)))
        assert view.may_send()
        header, low = decode_message(view.make_message({"X": ring}, {"trouble": ""}))
        reported += [each for part in low for each in part[0].tolist()]
        assert all(part["per_column"] == 10 and part["skipped_ticks"] == 0 for part in header["parts"])
        view.acknowledge_drawn(header["number"])
    assert reported == list(range(1010, 1010 + 10 * len(reported), 10))  # one second back, then what came
    assert reported[-1] == ring.end // 10 * 10 - 10


def test_slow_browser_gets_wider_columns_and_skip_count() -> None:
    ring, view = make_filled_ring(100_000, range(5000)), LiveView(["X"], 5.0, 500, PERIOD_S)
    for _ in range(MOST_UNSEEN):
        assert view.may_send()
        first, _ = decode_message(view.make_message({"X": ring}, {}))
    assert not view.may_send()
    ring.put_samples(np.arange(5000, 8000), make_samples(range(5000, 8000)))
    view.acknowledge_drawn(first["number"])
    assert view.may_send()
    header, low = decode_message(view.make_message({"X": ring}, {}))
    assert [(p["per_column"], p["skipped_ticks"]) for p in header["parts"]] == [(80, 0)]
    assert low[0].shape[1] <= 50  # what half a second has in full
    assert header["parts"][0]["first_tick"] == 4960  # no hole: a wide column begins where one may
    ring.put_samples(np.arange(8000, 20_000), make_samples(range(8000, 20_000)))
    view.acknowledge_drawn(header["number"])
    header, _ = decode_message(view.make_message({"X": ring}, {}))
    assert header["parts"][0]["skipped_ticks"] == 20_000 - 5000 - 8000
    assert header["parts"][0]["first_tick"] > 15_000 - header["parts"][0]["per_column"]
    view.acknowledge_drawn(10**9)  # a browser that says more than it was sent gains nothing
    assert view.may_send()
    for _ in range(MOST_UNSEEN):
        view.make_message({"X": ring}, {})
    assert not view.may_send()


def test_non_finite_numbers_are_null_in_json() -> None:
    assert round_finite(np.array([1.00004, np.nan, np.inf, -np.inf, -2.5], np.float32)) == [1.0, None, None, None, -2.5]


def make_feed(axes: str = "XY") -> LiveFeed:
    return LiveFeed(Path("/nowhere"), dict.fromkeys(axes), PERIOD_S)


def make_line(axis: str, ticks: Any) -> dict[str, Any]:
    ticks = np.asarray(ticks)
    whole = int(ticks[-1] - ticks[0]) == ticks.size - 1
    holes = {} if whole else {"ticks": encode_base64(ticks - ticks[0], "<i4")}
    return {
        "live": "samples",
        "axis": axis,
        "tick": int(ticks[0]),
        "values": encode_base64(make_samples(ticks), "<f4"),
        **holes,
    }


def test_two_buses_and_restarted_daemon_share_one_tick_count() -> None:
    feed = make_feed()
    for first in range(0, 400, 50):
        feed.take_line(make_line("X", range(first, first + 50)))
        feed.take_line(make_line("Y", range(70_000 + first, 70_050 + first)))  # another bus counts otherwise
    x, y = feed.rings["X"], feed.rings["Y"]
    assert abs(x.end - y.end) * PERIOD_S < 60  # both by when they came, on however busy a host
    assert abs(x.end - time.monotonic() / PERIOD_S) * PERIOD_S < 60
    before = x.end
    feed.take_line(make_line("X", range(20)))  # the count begins again
    assert x.end >= before + 20
    assert np.isfinite(x.read_samples(x.end - 20, x.end)[0]).all()
    assert np.isfinite(x.read_samples(before - 400, before)[0]).all()
    feed.take_line(make_line("Z", range(5)))  # an axis that is not in the configuration


def test_axes_of_one_bus_stay_aligned_over_gaps() -> None:
    feed = make_feed()
    feed.take_line(make_line("X", [0, 1, 3]))
    feed.take_line(make_line("Y", [0, 1, 2, 3]))
    assert feed.rings["X"].end == feed.rings["Y"].end
    end = feed.rings["X"].end
    assert np.isnan(feed.rings["X"].read_samples(end - 4, end)[0]).tolist() == [False, False, True, False]


def test_voltage_is_aligned_by_tick_times() -> None:
    feed = make_feed("X")
    feed.take_line(
        {
            "live": "voltage",
            "axis": "X",
            "t_ns": encode_base64(np.array([1]), "<i8"),
            "values": encode_base64(np.ones(1), "<f4"),
        }
    )
    feed.take_line({"live": "times", "tick": [100, 149], "t_ns": [7_000_000, 56_000_000]})
    feed.take_line(make_line("X", range(100, 150)))
    stamps = np.array([10_200_000, 11_300_000])
    feed.take_line(
        {
            "live": "voltage",
            "axis": "X",
            "t_ns": encode_base64(stamps, "<i8"),
            "values": encode_base64(np.array([3.5, 4.5]), "<f4"),
        }
    )
    end = feed.rings["X"].end
    assert feed.rings["X"].read_samples(end - 50, end)[VOLTAGE, 2:6].tolist() == [102, 3.5, 4.5, 105]


def test_invalid_line_is_rejected() -> None:
    with pytest.raises(ValueError, match="base64"):
        make_feed("X").take_line({**make_line("X", range(5)), "values": "no base64"})
    feed = make_feed("X")
    feed.take_line({"live": "skipped", "lines": 7})
    feed.take_line({"live": "something new"})
    assert feed.skipped_lines == 7
