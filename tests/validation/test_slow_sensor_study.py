"""Every fault of the verdict study is drawn with a slow voltage, too."""

from __future__ import annotations

import numpy as np

from studies import faults
from studies.judging import GOOD
from studies.slow_recordings import KINDS, TO_AND_FRO, make_study_recording


def test_slow_sensor_study_covers_all_fault_kinds() -> None:
    assert set(faults.KINDS) <= set(KINDS)
    assert {name for name in KINDS if name.startswith("voltage")} > {"voltage stuck", "voltage turned"}
    for name, kind in faults.KINDS.items():
        assert KINDS[name].matrix == kind.matrix, name


def test_every_fault_kind_yields_slow_sensor_samples() -> None:
    for name in (GOOD, TO_AND_FRO, *KINDS):
        corrupted = make_study_recording(3, 1, name)
        slow = corrupted.recording.slow_voltage
        assert slow is not None, name
        assert slow.period_s > corrupted.recording.dt_s, name
        assert slow.voltage_v.size > 20, name
        assert (corrupted.severity > 0.0) == (name in KINDS), name


def test_fault_never_affects_unrecorded_voltage() -> None:
    for seed in range(12):
        recording = make_study_recording(seed, 1, "not finite").recording
        assert not (np.isfinite(recording.current_a).all() and np.isfinite(recording.speed_rad_s).all())
