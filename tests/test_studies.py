"""The arithmetic of the studies: their conclusions follow from their runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.records import freeze_array
from fdhil.store.recording_csv import parse_recording
from studies import bench, comparison, drift, estimators, faults, judging
from studies.pages import wrap_paragraph

SHUTTLE = parse_recording(
    bench.format_as_csv(bench.simulate_bench(bench.Plant(), bench.make_shuttle_demand(moves=2)), 0.001, 1)
)


def test_hausman_test_detects_only_bias() -> None:
    rng = np.random.default_rng(1)
    errors = rng.standard_normal((400, 2, 3, 6))
    errors[:, 0, 1, 3] += 8.0
    shares = comparison.compute_rejection_shares(errors)
    assert shares[0, 1, 3] == 1.0
    unbiased = np.delete(shares[:, :-1].ravel(), 6 + 3)
    assert unbiased.mean() == pytest.approx(0.05, abs=0.01)
    assert (shares[:, -1] == 0).all()


def test_every_method_identifies_low_noise_rapid() -> None:
    windows = estimators.add_white_noise(comparison.record_clean_rapid(1e-3), 1e-5, 0)
    found = comparison.estimate_by_methods(windows, Identification().lowpass_hz)
    assert len(found) == len(comparison.METHODS) - 1
    for name, values in zip(comparison.METHODS, found, strict=False):
        assert values == pytest.approx(estimators.TRUTH, rel=0.08), name


@pytest.mark.parametrize("period_s", comparison.PERIODS_S)
def test_bound_grows_with_period_and_noise(period_s: float) -> None:
    quiet, loud = (estimators.compute_bound(comparison.record_clean_rapid(period_s), noise) for noise in (0.001, 0.005))
    assert loud == pytest.approx(5 * quiet, rel=0.05)


def test_load_step_is_reported_at_once_in_study() -> None:
    codes, published, alone = drift.detect_step(0)
    assert codes == ("LoadChanged",)
    assert published == 2
    assert alone


def test_paragraphs_fit_page_width() -> None:
    lines = wrap_paragraph("a low-pass " * 60)
    assert max(map(len, lines)) <= 120
    assert lines[-1] == ""


def test_wrong_verdicts_are_counted_for_valid_and_faulty() -> None:
    kinds = {"stuck": faults.Kind(lambda _: faults.FaultyRecording(SHUTTLE), frozenset({"StuckValue"}), "s", "B11")}
    made = [
        judging.Judged(1, judging.GOOD, 0.0, 2, 0, True, (), (), ("L",)),
        judging.Judged(2, judging.GOOD, 0.0, 1, 1, False, ("LoadDetected",), ("LoadDetected: a torque",), ()),
        judging.Judged(3, "stuck", 0.02, 1, 1, False, ("StuckValue",), ("StuckValue: 2 A",), ()),
        judging.Judged(4, "stuck", 0.01, 1, 0, True, (), (), (), harm=("2 um beside the path",)),
    ]
    counted = judging.count_by_kind(made, kinds)
    assert counted[judging.GOOD].wrong == [2]
    assert counted["stuck"].wrong == [4]
    reported = " ".join("\n".join(judging.describe_results(counted, kinds)).split())
    assert "Good: 3 windows of 2 recordings, 1 windows refused (33.33%" in reported
    assert "1 windows are accepted with a null and its reason: 1 without L." in reported
    assert "Bad: 2 recordings, 1 accepted, 1 of them without a warning, 1 to harm" in reported
    assert "Judged wrongly, or without a warning, by seed: good 2; stuck 4." in reported
    assert "| stuck | B11 | 2 | 0.01 s | 1 | 1 | 1 | 50% | 1 StuckValue |" in reported


def test_valid_recording_is_accepted_and_inverted_one_refused() -> None:
    assert judging.assess_recording(judging.GOOD, 1, faults.FaultyRecording(SHUTTLE)).accepted
    assert SHUTTLE.voltage_v is not None
    turned = replace(SHUTTLE, voltage_v=freeze_array(-SHUTTLE.voltage_v))
    judged = judging.assess_recording("wrong sign", 1, faults.FaultyRecording(turned, 1.0))
    assert not judged.accepted
    assert "Unphysical" in judged.codes
    assert judged.refused == judged.windows == 2
