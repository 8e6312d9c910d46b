"""Every fault of the verdict study is drawn with a slow voltage, too."""

from __future__ import annotations

import numpy as np

from studies import faults
from studies.judging import GOOD
from studies.slow_recordings import KINDS, TO_AND_FRO, recording_of


def test_the_slow_sensors_study_has_every_kind_of_the_other_and_the_voltages_own() -> None:
    assert set(faults.KINDS) <= set(KINDS)
    assert {name for name in KINDS if name.startswith("voltage")} > {"voltage stuck", "voltage turned"}
    for name, kind in faults.KINDS.items():
        assert KINDS[name].matrix == kind.matrix, name


def test_every_kind_makes_recordings_with_samples_of_a_slow_sensor() -> None:
    for name in (GOOD, TO_AND_FRO, *KINDS):
        spoilt = recording_of(3, 1, name)
        slow = spoilt.recording.slow_voltage
        assert slow is not None, name
        assert slow.period_s > spoilt.recording.dt_s, name
        assert slow.voltage_v.size > 20, name
        assert (spoilt.severity > 0.0) == (name in KINDS), name


def test_a_voltage_that_the_recording_does_not_hold_is_never_what_is_spoilt() -> None:
    for seed in range(12):
        recording = recording_of(seed, 1, "not finite").recording
        assert not (np.isfinite(recording.current_a).all() and np.isfinite(recording.speed_rad_s).all())
