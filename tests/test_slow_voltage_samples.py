"""A sensor slower than the SYNC keeps its own samples, with their times and the clock's error."""

from __future__ import annotations

import numpy as np

from fdhil import config as machine_config
from fdhil.pipeline.sample_buffer import SampleBuffer
from fdhil.records import AxisSamples, Float, TickTimes, VoltageSamples, freeze_array, freeze_integers
from tests.bench import bench_axis

PERIOD_NS = 1_000_000
SKEW = 1.0002  # the sensor's clock runs slower than the drive's by this factor


def _make_buffer(rate_hz: float, begin_ticks: float, samples: int, lost: int = -1) -> tuple[SampleBuffer, Float]:
    """Return a buffer with 2 s of a drive and of a sensor whose sample c is c V and begins ``begin_ticks`` late.

    Block ``lost`` of the sensor's 20 is left out.
    """
    axis = machine_config.parse_config({"machine": {"name": "bench"}, "axis": {"X": bench_axis()}}, "test").axis["X"]
    section = axis.model_copy(update={"voltage": axis.voltage.model_copy(update={"source": "modbus"})})
    recent, ticks = SampleBuffer("X", section, 30_000, 1e-3), np.arange(2000)
    zero = freeze_array(np.zeros(ticks.size))
    recent.append_block(TickTimes(freeze_integers(ticks), freeze_integers(ticks * PERIOD_NS)))
    recent.append_block(
        AxisSamples("X", freeze_integers(ticks), zero, zero, zero, zero, None, zero, freeze_integers(ticks * 0))
    )
    counter = np.arange(samples)
    begins = (begin_ticks + counter * SKEW * 1e3 / rate_hz) * PERIOD_NS
    for k, part in enumerate(np.array_split(counter, 20)):
        if k == lost:
            continue
        recent.append_block(
            VoltageSamples(
                sensor="voltage sensor X",
                axis="X",
                counter=freeze_integers(part),
                t_ns=freeze_integers(np.round(begins[part])),
                t_error_ns=freeze_integers(np.full(part.size, 150_000)),
                voltage_v=freeze_array(part),
                sample_rate_hz=rate_hz,
            )
        )
    return recent, begins / PERIOD_NS


def test_slow_samples_keep_own_times() -> None:
    recent, begins = _make_buffer(200.0, 2.4, 390)
    recording = recent.extract_recording(500, 1500)
    assert recording.voltage_v is None
    slow = recording.slow_voltage
    assert slow is not None
    first = int(slow.voltage_v[0])
    assert begins[first] >= 500 > begins[first - 1]
    np.testing.assert_array_equal(slow.voltage_v, first + np.arange(slow.voltage_v.size))
    times = 500 + 1e3 * (slow.begin_s + slow.period_s * np.arange(slow.voltage_v.size))
    np.testing.assert_allclose(times, begins[first : first + times.size], atol=0.05)
    assert times[-1] + 1e3 * slow.period_s <= 1499 + 0.05
    assert abs(slow.error_s - 150e-6) < 1e-12


def test_lost_slow_samples_stay_nan() -> None:
    recent, _ = _make_buffer(100.0, 0.0, 196, lost=10)
    slow = recent.extract_recording(500, 1500).slow_voltage
    assert slow is not None
    assert 5 < np.isnan(slow.voltage_v).sum() < 12


def test_window_waits_for_sensor() -> None:
    recent, _ = _make_buffer(200.0, 0.0, 300)
    assert recent.has_voltage_until(1400)
    assert not recent.has_voltage_until(1600)


def test_sensor_at_sync_rate_is_placed_on_grid() -> None:
    recent, _ = _make_buffer(1000.0, 0.0, 1990)
    recording = recent.extract_recording(500, 1500)
    assert recording.slow_voltage is None
    assert recording.voltage_v is not None


def test_polled_meter_keeps_time_of_each_value() -> None:
    recent, _ = _make_buffer(100.0, 0.0, 0)
    rng, counter = np.random.default_rng(2), np.arange(195)
    true = counter * 10.0 + rng.uniform(-4.0, 4.0, counter.size)
    for part in np.array_split(counter, 40):
        t_ns, error_ns = freeze_integers(np.round(true[part] * PERIOD_NS)), freeze_integers(np.full(part.size, 300_000))
        recent.append_block(
            VoltageSamples(
                "meter", "X", freeze_integers(part), t_ns, error_ns, freeze_array(part), 100.0, on_grid=False
            )
        )
    slow = recent.extract_recording(500, 1500).slow_voltage
    assert slow is not None
    assert slow.late_s is not None
    at = 500 + 1e3 * (slow.begin_s + slow.period_s * np.arange(slow.voltage_v.size) + slow.late_s)
    np.testing.assert_allclose(at, true[slow.voltage_v.astype(int)], atol=0.1)
    assert (np.diff(at) > 0).all()
