"""The decoder puts every signal on the row it belongs to, and counts what is lost."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.drivers.bus_decoder import BusDecoder
from fdhil.drivers.frames import Frames
from fdhil.records import AxisSamples, Notice
from tests.drivers.wire import Wire, machine

PER_MM = 65536 / 20


def decode_all(
    blocks: Sequence[Frames], decoder: BusDecoder | None = None, **kwargs: object
) -> tuple[dict[str, np.ndarray], list[Notice], BusDecoder]:
    decoder = decoder or BusDecoder("can0", machine(**kwargs))  # type: ignore[arg-type]
    records = [r for block in blocks for r in decoder.feed(block, int(block["t_ns"][-1]) if block.size else 0)]
    samples = [r for r in records if isinstance(r, AxisSamples)]
    names = ("tick", "demand_mm", "position_mm", "speed_rad_s", "current_a", "voltage_v", "offset_mm", "statusword")
    joined = {name: np.concatenate([getattr(s, name) for s in samples] or [np.empty(0)]) for name in names}
    joined["lost"] = np.array([s.lost for s in samples])
    return joined, [r for r in records if isinstance(r, Notice)], decoder


def check_rows(wire: Wire, got: dict[str, np.ndarray]) -> None:
    ticks = got["tick"]
    reference = np.array([wire.reference[int(k)] for k in ticks])
    offset = np.array([wire.offset[int(k)] for k in ticks])
    first = np.array([wire.tpdo1(int(k)) for k in ticks])
    second = np.array([wire.tpdo2(int(k)) for k in ticks])
    after = np.array([wire.tpdo2(int(k) + 1) for k in ticks])
    np.testing.assert_allclose(got["demand_mm"] * PER_MM, reference, atol=1e-9)
    np.testing.assert_allclose(got["offset_mm"] * PER_MM, offset, atol=1e-9)
    np.testing.assert_allclose(got["position_mm"] * PER_MM, first[:, 0], atol=1e-9)
    np.testing.assert_allclose(got["speed_rad_s"], first[:, 1] * 2 * math.pi / 65536)
    np.testing.assert_allclose(got["current_a"], second[:, 1] * 0.05)
    np.testing.assert_allclose(got["voltage_v"], after[:, 2] * 0.02, err_msg="the mean of [k, k+1) is sent at SYNC k+1")


def test_every_signal_is_on_its_row() -> None:
    wire = Wire()
    got, notices, decoder = decode_all([wire.frames()])
    check_rows(wire, got)
    assert got["tick"].tolist() == list(range(2, 198))  # r[2] is the first target that was seen
    assert notices == []
    assert got["lost"].sum() == 0
    assert decoder.counters()["pdo_lost"] == 0


@settings(deadline=None, max_examples=30)
@given(cuts=st.lists(st.integers(0, 800), max_size=12), counter=st.booleans())
def test_blocks_do_not_matter(cuts: list[int], counter: bool) -> None:
    wire = Wire(n=120, counter=counter)
    frames = wire.frames()
    edges = [0, *sorted(min(c, frames.size) for c in cuts), frames.size]
    blocks = [frames[a:b] for a, b in pairwise(edges)]
    got, notices, _ = decode_all(blocks)
    check_rows(wire, got)
    assert got["tick"].tolist() == list(range(2, 118))
    assert notices == []
