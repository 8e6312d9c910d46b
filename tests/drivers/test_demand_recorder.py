"""The recorder of an air cut: what it keeps, what it counts as lost, when it is complete."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from fdhil import config as configuration
from fdhil.drivers.demand_recorder import DemandRecorder, Gap
from fdhil.errors import ConfigError, RecordingError
from fdhil.program import load_trajectory, write_demand_csv
from fdhil.records import AxisSamples, Float, Notice, freeze_array, freeze_integers
from tests.bench import bench_config, bench_document

PATH = np.concatenate([np.zeros(500), np.linspace(0.0, 10.0, 301), np.full(3000, 10.0)])


def build_samples(axis: str, demand: Float, ticks: Sequence[int]) -> AxisSamples:
    tick = np.array(ticks, dtype=np.int64)
    values, rest = freeze_array(demand[tick]), freeze_array(np.zeros(tick.size))
    return AxisSamples(axis, freeze_integers(tick), values, values, rest, rest, None, rest, freeze_integers(rest))


def feed_recorder(recorder: DemandRecorder, lost: Sequence[int] = (), until: int = PATH.size) -> None:
    """Feed blocks of 40 rows of X and of Y, which lacks the rows ``lost``."""
    for first in range(0, until, 40):
        if recorder.is_done:
            return
        rows = range(first, min(first + 40, until))
        recorder.add_record(build_samples("X", PATH, rows))
        recorder.add_record(build_samples("Y", 2.0 * PATH, [row for row in rows if row not in lost]))


def test_demand_spans_first_motion_to_final_rest() -> None:
    recorder = DemandRecorder(bench_config(), rest_s=1.0)
    assert not recorder.has_all_axes
    feed_recorder(recorder)
    assert recorder.is_done
    recorded = recorder.build_demand()
    assert recorded is not None
    assert recorded.is_complete
    first = 500
    rows = recorded.reference.time_s.size
    assert rows == 300 + 500 + 1
    np.testing.assert_array_equal(recorded.reference.position_mm["X"], PATH[first : first + rows])
    np.testing.assert_array_equal(recorded.reference.position_mm["Y"], 2.0 * PATH[first : first + rows])


def test_lost_samples_are_gaps_and_never_filled(tmp_path: Path) -> None:
    recorder = DemandRecorder(bench_config(), rest_s=1.0)
    feed_recorder(recorder, lost=(10, 600, 601, 700))
    recorded = recorder.build_demand()
    assert recorded is not None
    assert not recorded.is_complete
    assert recorded.gaps == (Gap("Y", 100, 102), Gap("Y", 200, 201))
    assert np.flatnonzero(np.isnan(recorded.reference.position_mm["Y"])).tolist() == [100, 101, 200]
    write_demand_csv(recorded.reference, tmp_path / "marked.csv")
    with pytest.raises(RecordingError, match="line 102 has 'nan' instead of a finite number"):
        load_trajectory(tmp_path / "marked.csv", bench_config())


def test_doubtful_demand_is_not_complete() -> None:
    recorder = DemandRecorder(bench_config(), rest_s=1.0)
    recorder.add_record(Notice("DemandMismatch", "MAJOR", "another demand", "X"))
    recorder.add_record(Notice("BusSilent", "info", "heard again"))
    feed_recorder(recorder)
    recorded = recorder.build_demand()
    assert recorded is not None
    assert recorded.doubts == ("another demand",)
    assert not recorded.is_complete


def test_rest_without_motion_is_not_recorded() -> None:
    recorder = DemandRecorder(bench_config(), rest_s=1.0)
    feed_recorder(recorder, until=500)
    assert recorder.has_all_axes
    assert not recorder.is_done
    assert recorder.build_demand() is None


def test_early_stop_ends_the_demand_there() -> None:
    recorder = DemandRecorder(bench_config(), rest_s=1.0)
    feed_recorder(recorder, until=600)
    assert not recorder.is_done
    recorded = recorder.build_demand()
    assert recorded is not None
    assert recorded.reference.position_mm["X"][-1] == PATH[599]


def test_axes_on_two_buses_are_refused() -> None:
    document = bench_document()
    document["bus"] = {"can0": {}, "can1": {}}
    document["axis"]["Y"]["drive"] = {"bus": "can1"}
    with pytest.raises(ConfigError, match="common count"):
        DemandRecorder(configuration.parse_config(document), 1.0)
