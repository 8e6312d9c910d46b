"""The pipeline of one axis: complete windows, lost samples stay NaN, jumps are held back, bit-identical results."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.config import MachineConfig
from fdhil.daemon.kernel_warmup import simulate_nominal_rapid
from fdhil.identification.rapid_windows import find_windows
from fdhil.pipeline import AxisPipeline, Record, analyse_window
from fdhil.pipeline.axis_pipeline import WAITING_RAPIDS
from fdhil.pipeline.sample_buffer import SampleBuffer
from fdhil.records import (
    AxisSamples,
    MoveEvent,
    MoveKind,
    Notice,
    Outcome,
    ParameterSet,
    Reason,
    Skill,
    Temperature,
    TickTimes,
    Verdict,
    VoltageSamples,
    Window,
    WindowOutcome,
    freeze_array,
    freeze_integers,
)
from fdhil.store.window_file import decode_window, encode_window
from studies.judging import GOOD
from studies.slow_recordings import make_study_recording
from tests.daemon.simulated_machine import config_of, rapids
from tests.store.sample_records import is_bit_identical, view_bits


@pytest.fixture
def config(tmp_path: Path) -> MachineConfig:
    """The bench, one axis; least squares, because the sequence is tested here, not the estimator."""
    return config_of(tmp_path, identification={"method": "least_squares"})


def feed_records(pipeline: AxisPipeline, records: Sequence[Record]) -> list[Outcome]:
    return [outcome for record in records for outcome in pipeline.process_record(record)]


def select_windows(outcomes: Sequence[Outcome]) -> list[Window]:
    return [outcome.window for outcome in outcomes if isinstance(outcome, WindowOutcome)]


def list_numbers(outcomes: Sequence[Outcome]) -> list[object]:
    reported: list[object] = []
    for outcome in outcomes:
        if isinstance(outcome, WindowOutcome):
            estimate = outcome.estimate
            assert estimate is not None
            reported += [view_bits(estimate.values), view_bits(estimate.covariance), repr(outcome.verdict)]
        elif isinstance(outcome, ParameterSet):
            reported += [repr(outcome.parameters), view_bits(outcome.covariance), outcome.revision, outcome.windows]
        else:
            reported.append(repr(outcome))
    return reported


def test_each_rapid_yields_one_window(config: MachineConfig) -> None:
    outcomes = feed_records(AxisPipeline("X", config), rapids(config, count=2, first_tick=5000))
    first, second = select_windows(outcomes)
    assert (first.direction, second.direction) == (1, -1)
    for window, start in ((first, 5400), (second, 5400 + 850 + 400)):
        assert abs(window.start_tick - start) <= 60  # the margin of rest begins where the made one does
        assert window.start_s == pytest.approx((window.start_tick - 5000) * 0.001)
        stages = window.stages
        assert None not in (stages.accelerate, stages.cruise, stages.brake)
        assert np.abs(window.speed_rad_s[:20]).max() < 1.0
        assert np.abs(window.speed_rad_s[-20:]).max() < 1.0
        assert window.source == "test"
        assert window.offset_mm is None
    sets = [outcome for outcome in outcomes if isinstance(outcome, ParameterSet)]
    assert [(s.revision, s.windows, s.config_digest) for s in sets] == [(1, 1, config.digest), (2, 2, config.digest)]
    skills = [outcome for outcome in outcomes if isinstance(outcome, Skill)]
    assert len(skills) == 2


@settings(deadline=None, max_examples=8)
@given(cut=st.lists(st.integers(1, 160), min_size=1, max_size=12), seed=st.integers(0, 9))
def test_block_sizes_do_not_change_outcomes(cut: list[int], seed: int) -> None:
    config = config_of(Path(), identification={"method": "least_squares"})
    records = rapids(config, count=1)
    assert list_numbers(feed_records(AxisPipeline("X", config), split_blocks(records, cut))) == list_numbers(
        feed_records(AxisPipeline("X", config), records)
    )


def split_blocks(records: Sequence[Record], cut: Sequence[int]) -> list[Record]:
    blocks = [record for record in records if isinstance(record, AxisSamples)]
    names = ("tick", "demand_mm", "position_mm", "speed_rad_s", "current_a", "voltage_v", "offset_mm", "statusword")
    whole = {name: np.concatenate([getattr(block, name) for block in blocks]) for name in names}
    out: list[Record] = [record for record in records if not isinstance(record, AxisSamples | TickTimes)]
    start, k = 0, 0
    while start < whole["tick"].size:
        stop = start + cut[k % len(cut)]
        part: dict[str, Any] = {name: values[start:stop] for name, values in whole.items()}
        out.append(AxisSamples(axis="X", **part))
        start, k = stop, k + 1
    return out


def test_window_replayed_from_file_is_bit_identical(config: MachineConfig) -> None:
    live = feed_records(AxisPipeline("X", config), rapids(config, count=1))
    (window,) = select_windows(live)
    stored = decode_window(encode_window(window, config.digest))
    assert is_bit_identical(stored, window)
    assert list_numbers(AxisPipeline("X", config).process_record(stored)) == list_numbers(live)


def test_constant_gain_error_is_reported_once(config: MachineConfig) -> None:
    """No window can show it; the sets are published nevertheless, since the data sheet may be wrong."""
    records = [
        replace(r, voltage_v=freeze_array(1.2 * r.voltage_v))
        if isinstance(r, AxisSamples) and r.voltage_v is not None
        else r
        for r in rapids(config, count=2)
    ]
    outcomes = feed_records(AxisPipeline("X", config), records)
    assert sum(isinstance(outcome, ParameterSet) for outcome in outcomes) == 2
    (notice,) = [outcome for outcome in outcomes if isinstance(outcome, Notice)]
    assert notice.code == "CalibrationSuspect"
    assert "the voltage is read 1.20 times as large as it is" in notice.text
    assert not any(isinstance(o, Notice) for o in feed_records(AxisPipeline("X", config, with_skill=False), records))


def test_lost_samples_are_nan_and_refused(config: MachineConfig) -> None:
    records = rapids(config, count=1)
    lost = range(800, 812)
    records = [drop_ticks(record, lost) if isinstance(record, AxisSamples) else record for record in records]
    outcomes = feed_records(AxisPipeline("X", config), records)
    (window,) = select_windows(outcomes)
    start = 800 - window.start_tick
    assert window.gaps == ((start, start + 12),)
    assert np.isnan(window.speed_rad_s[start : start + 12]).all()
    assert window.voltage_v is not None
    assert np.isnan(window.voltage_v[start : start + 12]).all()


def drop_ticks(block: AxisSamples, ticks: range) -> AxisSamples:
    keep = ~np.isin(block.tick, list(ticks))
    names = ("tick", "demand_mm", "position_mm", "speed_rad_s", "current_a", "voltage_v", "offset_mm", "statusword")
    return replace(block, **{name: getattr(block, name)[keep] for name in names})


def test_window_has_newest_temperature(config: MachineConfig) -> None:
    pipeline = AxisPipeline("X", config)
    pipeline.process_record(Temperature("X", 0, 21.5, "slideway"))
    pipeline.process_record(Temperature("Y", 0, 99.0, "slideway"))
    stranger = [replace(r, axis="Y") for r in rapids(config, count=1) if isinstance(r, AxisSamples)]
    assert feed_records(pipeline, stranger) == []
    (window,) = select_windows(feed_records(pipeline, rapids(config, count=1)))
    assert window.temperature_c == 21.5


def test_restarted_sync_count_discards_old_samples(config: MachineConfig) -> None:
    pipeline = AxisPipeline("X", config)
    records = rapids(config, count=1, first_tick=70_000)
    assert select_windows(feed_records(pipeline, records[: len(records) // 2])) == []
    (window,) = select_windows(feed_records(pipeline, rapids(config, count=1)))
    assert window.start_tick < 500


def test_load_change_is_reported_at_once_and_used_from_second_window(config: MachineConfig) -> None:
    pipeline = AxisPipeline("X", config)
    axis = config.axis["X"]
    heavy = axis.model_copy(update={"nominal": axis.nominal.model_copy(update={"Jt": 0.085})})

    def make_rapid(settings: object, k: int) -> Window:
        made = simulate_nominal_rapid("X", heavy if settings == "heavy" else axis, 0.001, 1 if k % 2 else -1, seed=k)
        return replace(made, start_tick=2000 * k)

    for k in range(1, 5):
        assert any(isinstance(o, ParameterSet) for o in pipeline.process_record(make_rapid("light", k)))
    third = pipeline.process_record(make_rapid("heavy", 5))
    assert [o.code for o in third if isinstance(o, Notice)] == ["LoadChanged"]
    assert not any(isinstance(o, ParameterSet) for o in third)
    assert pipeline.published is not None
    assert pipeline.published.parameters.Jt == pytest.approx(0.075, rel=0.01)
    fourth = pipeline.process_record(make_rapid("heavy", 6))
    (published,) = [o for o in fourth if isinstance(o, ParameterSet)]
    assert published.parameters.Jt == pytest.approx(0.085, rel=0.01)
    assert published.windows == 2  # the windows with the old load are no part of it


def test_single_outlier_window_has_no_effect(config: MachineConfig) -> None:
    pipeline = AxisPipeline("X", config)
    axis = config.axis["X"]
    odd = axis.model_copy(update={"nominal": axis.nominal.model_copy(update={"R": 0.7, "K": 0.9})})
    sets = []
    for k, real in enumerate((axis, axis, axis, odd, axis), start=1):
        window = replace(simulate_nominal_rapid("X", real, 0.001, seed=k), start_tick=2000 * k)
        outcomes = pipeline.process_record(window)
        sets.append([o for o in outcomes if isinstance(o, ParameterSet)])
        assert [o.code for o in outcomes if isinstance(o, Notice)] == (["ParameterJump"] if k == 4 else [])
    assert [len(s) for s in sets] == [1, 1, 1, 0, 1]
    assert sets[4][0].windows == 4
    last = sets[4][0].parameters
    assert abs(last.K - 0.8) < 0.008


def record_with_sensor(config: MachineConfig) -> SampleBuffer:
    axis = config.axis["X"]
    section = axis.model_copy(update={"voltage": axis.voltage.model_copy(update={"source": "modbus"})})
    return SampleBuffer("X", section, 20_000, 1e-3)


@pytest.mark.parametrize("late_s", [0.0, 0.0003, -0.0004])
@pytest.mark.parametrize("ratio", [1, 4])
def test_sensor_voltage_is_placed_by_count_at_any_host_delay(config: MachineConfig, ratio: int, late_s: float) -> None:
    period_ns, n = 1_000_000, 4000
    rng = np.random.default_rng(5)
    recent = record_with_sensor(config)
    tick = np.arange(100, 100 + n)
    # a host that is late by up to 5 ms, in bursts: arrivals are true only as a whole
    arrival = np.maximum.accumulate(tick * period_ns + rng.exponential(3e5, n).astype(np.int64))
    recent.append_block(TickTimes(freeze_integers(tick), freeze_integers(arrival)))
    signal = np.sin(np.arange(n + 200) / 50)
    counter = np.arange(7 * ratio, (7 + n) * ratio)  # its sample 7 * ratio begins with tick 107, but for late_s
    begins = 107 + (counter - 7 * ratio) / ratio - late_s / 1e-3
    t_ns = np.interp(begins, tick, arrival)
    volts = signal[np.minimum((begins - 100).round().astype(int).clip(0), n + 199)]
    for part in np.array_split(np.arange(counter.size), 80):
        block = (freeze_integers(counter[part]), freeze_integers(t_ns[part]), freeze_integers(np.full(part.size, 9)))
        recent.append_block(VoltageSamples("s", "X", *block, freeze_array(volts[part]), 1000.0 * ratio))
    recent.append_block(make_samples(np.arange(100, 100 + n)))
    recording = recent.extract_recording(1000, 2000)
    assert recording.voltage_v is not None
    left_over = late_s - round(late_s * 1e3 * ratio) / (1e3 * ratio)  # whole samples are placed
    assert recording.voltage_delay_s == pytest.approx(left_over, abs=1.2e-4 / ratio)
    assert recent.has_voltage_until(3000)
    assert not recent.has_voltage_until(5000)
    if ratio == 1 and late_s == 0.0:
        assert np.array_equal(recording.voltage_v, signal[900:1900])


def test_lost_sensor_samples_stay_nan(config: MachineConfig) -> None:
    recent = record_with_sensor(config)
    tick = np.arange(2000)
    recent.append_block(TickTimes(freeze_integers(tick), freeze_integers(tick * 1_000_000)))
    recent.append_block(make_samples(tick))
    counter = np.delete(np.arange(2000), np.arange(500, 510))
    block = (freeze_integers(counter), freeze_integers(counter * 1_000_000), freeze_integers(np.ones(counter.size)))
    recent.append_block(VoltageSamples("s", "X", *block, freeze_array(np.ones(counter.size)), 1000.0))
    recording = recent.extract_recording(400, 600)
    assert recording.voltage_v is not None
    assert np.flatnonzero(np.isnan(recording.voltage_v)).tolist() == list(range(100, 110))
    unfit = record_with_sensor(config)
    unfit.append_block(TickTimes(freeze_integers(tick), freeze_integers(tick * 1_000_000)))
    unfit.append_block(VoltageSamples("s", "X", *block, freeze_array(np.ones(counter.size)), 730.0))
    assert unfit.extract_recording(400, 600).voltage_v is None


def make_samples(tick: np.ndarray) -> AxisSamples:
    zeros = freeze_array(np.zeros(tick.size))
    ticks = freeze_integers(tick)
    return AxisSamples("X", ticks, zeros, zeros, zeros, zeros, None, zeros, freeze_integers(zeros))


def test_buffer_memory_is_bounded(config: MachineConfig) -> None:
    recent = SampleBuffer("X", config.axis["X"], 1000, 1e-3)
    for start in range(0, 100_000, 50):
        tick = np.arange(start, start + 50)
        recent.append_block(make_samples(tick))
        recent.append_block(TickTimes(freeze_integers(tick), freeze_integers(tick * 1_000_000)))
    assert len(recent._samples) <= 22
    assert len(recent._times) <= 22
    assert math.isnan(recent.extract_recording(0, 10).speed_rad_s[0])


def test_window_without_l_is_accepted_but_not_published(tmp_path: Path) -> None:
    (open_end,) = find_windows(make_study_recording(59, 2, GOOD).recording)  # instants of a sensor of 200 Hz
    (outcome,) = AxisPipeline("X", config_of(tmp_path)).process_record(open_end)
    assert isinstance(outcome, WindowOutcome)
    assert outcome.verdict.accepted
    assert outcome.estimate is not None
    assert set(outcome.estimate.missing) == {"L"}


def make_vertical_axis(config: MachineConfig, k: int, load_nm: float) -> Window:
    axis, side = config.axis["X"], 1 if k % 2 else -1
    nominal = axis.nominal.model_copy(update={"Cd": 5.0 + side * load_nm})
    made = simulate_nominal_rapid("X", axis.model_copy(update={"nominal": nominal}), 0.001, side, seed=k)
    return replace(made, start_tick=2000 * k)


@pytest.mark.usefixtures("real_time")
def test_published_load_is_independent_of_direction(config: MachineConfig) -> None:
    pipeline, sets = AxisPipeline("X", config), []
    for k in (1, 2, 3, 4, 5, 7, 9, 11, 13):  # from the fifth on all in one direction
        outcomes = pipeline.process_record(make_vertical_axis(config, k, 1.0))
        assert not any(isinstance(o, Notice) for o in outcomes)
        sets += [o for o in outcomes if isinstance(o, ParameterSet)]
    assert len(sets) == 9
    assert [warning.code for warning in sets[0].warnings] == ["OneDirection"]
    for each in sets[1:]:
        assert each.parameters.get_term("load") == pytest.approx(1.0, abs=0.1)
        assert each.parameters.Cd == pytest.approx(5.0, rel=0.1)
        assert each.covariance.shape == (7, 7)
        assert each.loops == {}
    assert sets[-1].windows == 6  # the newest four, and the newest two of the other direction
    assert sets[-1].window_ticks == (4000, 8000, 14000, 18000, 22000, 26000)


def test_nothing_is_published_if_one_direction_is_refused(
    config: MachineConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse_direction(window: Window, *known: Any) -> WindowOutcome:
        outcome = analyse_window(window, *known)
        reason = Reason("ValidationFailed", "the drive has an effect that the model lacks")
        return outcome if window.direction > 0 else replace(outcome, verdict=Verdict(False, 90.0, (reason,)))

    monkeypatch.setattr("fdhil.pipeline.identified_loops.analyse_window", refuse_direction)
    pipeline, reported = AxisPipeline("X", config), []
    for k in range(1, 7):
        outcomes = pipeline.process_record(make_vertical_axis(config, k, 0.0))
        reported.append([type(o).__name__ for o in outcomes if isinstance(o, Notice | ParameterSet)])
    # the first came before the other direction was known to be refused; then it is said once
    assert reported == [["ParameterSet"], [], ["Notice"], [], [], []]


def test_rapids_without_samples_are_bounded(config: MachineConfig) -> None:
    pipeline = AxisPipeline("X", config)
    for k in range(2 * WAITING_RAPIDS):
        for kind, tick in ((MoveKind.RAPID, 2000 * k), (MoveKind.REST, 2000 * k + 800)):
            assert pipeline.process_record(MoveEvent("X", kind, tick, "test")) == []
    assert len(pipeline._rapids) == WAITING_RAPIDS
    after = 4000 * WAITING_RAPIDS
    assert len(select_windows(feed_records(pipeline, rapids(config, "X", 1, first_tick=after)))) == 1
