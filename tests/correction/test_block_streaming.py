"""The correction of a path that is still being generated."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator, Mapping

import numpy as np
import pytest

from fdhil.correction import PlanLimits, check_offsets, plan_correction
from fdhil.correction.block_streaming import stream_blocks
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.records import Float
from tests.bench import bench_config
from tests.correction.test_correction_planner import change_config
from tests.paths import build_bench_demand, build_trajectory

CONFIG = bench_config()
MODELS = build_nominal_models(CONFIG)


def split_path(demand: Float, size: int) -> Iterator[Mapping[str, Float]]:
    for first in range(0, len(demand), size):
        yield {axis: demand[first : first + size, a] for a, axis in enumerate("XY")}


@pytest.mark.parametrize("size", [7, 500, 2500, 100_000])
def test_streamed_offsets_equal_planned_offsets(size: int) -> None:
    demand = build_bench_demand(10)
    whole = plan_correction(build_trajectory(demand), MODELS, CONFIG, "inverse")
    blocks = list(stream_blocks(split_path(demand, size), MODELS, CONFIG))
    assert [block.final for block in blocks] == [False, True]
    for axis in "XY":
        assert np.array_equal(np.concatenate([block.offset_um[axis] for block in blocks]), whole.offset_um[axis])
    assert np.allclose(np.concatenate([block.after_um for block in blocks]), whole.after.contour_um, atol=1e-9)
    assert np.allclose(np.concatenate([block.before_um for block in blocks]), whole.before.contour_um, atol=1e-9)


def test_block_needs_only_its_look_ahead() -> None:
    """The first 2 s are available when 2.5 s and a row of the path are."""
    demand = build_bench_demand(10)
    taken = 0

    def count_pieces() -> Iterator[Mapping[str, Float]]:
        nonlocal taken
        for piece in split_path(demand, 10):
            taken += 10
            yield piece

    first = next(stream_blocks(count_pieces(), MODELS, CONFIG))
    assert first.first_row == 0
    assert first.before_um.size == 2000
    assert taken <= 2510


def test_longer_path_keeps_settled_offsets() -> None:
    demand = build_bench_demand(10)
    other = demand.copy()
    other[2501:] = demand[2500]
    first, changed_first = (next(stream_blocks(split_path(d, 50), MODELS, CONFIG)) for d in (demand, other))
    assert np.array_equal(first.offset_um["X"], changed_first.offset_um["X"])


def test_refused_block_ends_stream() -> None:
    blocks = list(stream_blocks(split_path(build_bench_demand(10), 500), MODELS, change_config(speed_feedforward=0.5)))
    assert len(blocks) == 1
    assert "LagTooLarge" in {reason.code for reason in blocks[0].refused}
    assert not blocks[0].offset_um["X"].any()


def test_saturation_ends_stream() -> None:
    blocks = list(stream_blocks(split_path(build_bench_demand(20, (0.030, 0.015)), 500), MODELS, CONFIG))
    assert "DemandTooHigh" in {reason.code for reason in blocks[-1].refused}


def test_continued_stream_reports_every_refusal() -> None:
    calm = build_bench_demand(10)
    shift, hard = calm[-1] - calm[0], build_bench_demand(20, (0.030, 0.015))
    between = np.concatenate([calm, calm[::-1], calm]) + 2 * shift
    path = np.concatenate([calm, hard + shift, between, hard + 3 * shift])
    starts = np.cumsum([0, len(calm), len(hard), len(between)])
    blocks = list(stream_blocks(split_path(path, 500), MODELS, CONFIG, goes_on=True))
    assert sum(block.before_um.size for block in blocks) == len(path)
    places = [row for block in blocks for row, reason in zip(block.at, block.refused, strict=True)]
    assert all(starts[1] <= row < starts[2] or starts[3] <= row for row in places)
    assert any(row < starts[2] for row in places)
    assert any(row >= starts[3] for row in places)
    assert any(not block.refused and block.first_row > starts[1] for block in blocks)
    assert next(stream_blocks(split_path(path, 500), MODELS, CONFIG)).refused == ()


def test_block_seams_cause_no_error() -> None:
    """Near a seam the error is no larger than with the seams elsewhere, to 0.05 um."""
    there = build_bench_demand(10)
    shift = 731  # rows of rest ahead: every seam moves to another place of the path
    paths = there, np.concatenate([np.repeat(there[:1], shift, axis=0), there])
    one, other = (
        np.concatenate([block.after_um for block in stream_blocks(split_path(p, 500), MODELS, CONFIG)]) for p in paths
    )
    near = slice(2000 - 100, 2000 + 100)
    assert one[near].max() < max(other[shift:][near].max(), one.max(where=np.arange(one.size) < 1900, initial=0)) + 0.05
    offsets = [block.offset_um for block in stream_blocks(split_path(there, 500), MODELS, CONFIG)]
    for axis in "XY":
        joined = (
            np.concatenate([block[axis] for block in offsets])
            / PlanLimits.derive(CONFIG.axis[axis], 0.001).um_per_increment
        )
        assert check_offsets(np.rint(joined).astype(np.int64), PlanLimits.derive(CONFIG.axis[axis], 0.001)) == []


@pytest.mark.usefixtures("long_computation")
def test_stream_memory_is_constant() -> None:
    there = build_bench_demand(20)
    loop = np.concatenate([there, there[::-1]])

    def generate_long_path() -> Iterator[Mapping[str, Float]]:
        for _ in range(12):
            yield from split_path(loop, 200)

    tracemalloc.start()
    try:
        held = [tracemalloc.get_traced_memory()[0] for _ in stream_blocks(generate_long_path(), MODELS, CONFIG)]
    finally:
        tracemalloc.stop()
    assert len(held) > 20
    # what a few lengths of rests need comes and goes (60 kB each); a path that is kept grows by 32 kB a block
    assert max(held[6:]) < 1.10 * max(held[:6])
    assert max(held[-6:]) < 1.05 * max(held[6:12])


def test_empty_path_gives_no_block() -> None:
    assert list(stream_blocks(iter([]), MODELS, CONFIG)) == []
