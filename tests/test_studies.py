"""The arithmetic of the studies: their conclusions follow from their runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.records import freeze_array
from fdhil.store.recording_csv import parse_recording
from studies import bench, comparison, drift, estimators, faults, judging
from studies.pages import paragraph

SHUTTLE = parse_recording(bench.as_csv(bench.run(bench.Plant(), bench.shuttle(moves=2)), 0.001, 1))


def test_the_hausman_test_tells_a_bias_and_nothing_else() -> None:
    rng = np.random.default_rng(1)
    errors = rng.standard_normal((400, 2, 3, 6))
    errors[:, 0, 1, 3] += 8.0
    shares = comparison.rejections(errors)
    assert shares[0, 1, 3] == 1.0
    unbiased = np.delete(shares[:, :-1].ravel(), 6 + 3)
    assert unbiased.mean() == pytest.approx(0.05, abs=0.01)
    assert (shares[:, -1] == 0).all()


def test_every_method_finds_a_quiet_rapid() -> None:
    windows = estimators.noisy(comparison.clean(1e-3), 1e-5, 0)
    found = comparison.values_of(windows, Identification().lowpass_hz)
    assert len(found) == len(comparison.METHODS) - 1
    for name, values in zip(comparison.METHODS, found, strict=False):
        assert values == pytest.approx(estimators.TRUTH, rel=0.08), name


@pytest.mark.parametrize("period_s", comparison.PERIODS_S)
def test_the_bound_grows_with_the_period_and_the_noise(period_s: float) -> None:
    quiet, loud = (estimators.bound(comparison.clean(period_s), noise) for noise in (0.001, 0.005))
    assert loud == pytest.approx(5 * quiet, rel=0.05)


def test_a_step_of_the_load_is_told_at_once_in_the_study() -> None:
    codes, published, alone = drift.stepped(0)
    assert codes == ("LoadChanged",)
    assert published == 2
    assert alone


def test_paragraphs_fit_the_page() -> None:
    lines = paragraph("a low-pass " * 60)
    assert max(map(len, lines)) <= 120
    assert lines[-1] == ""


def test_what_is_accepted_or_named_wrongly_is_counted_for_good_and_bad_alike() -> None:
    kinds = {"stuck": faults.Kind(lambda _: faults.Spoilt(SHUTTLE), frozenset({"StuckValue"}), "s", "B11")}
    made = [
        judging.Judged(1, judging.GOOD, 0.0, 2, 0, True, (), (), ("L",)),
        judging.Judged(2, judging.GOOD, 0.0, 1, 1, False, ("LoadDetected",), ("LoadDetected: a torque",), ()),
        judging.Judged(3, "stuck", 0.02, 1, 1, False, ("StuckValue",), ("StuckValue: 2 A",), ()),
        judging.Judged(4, "stuck", 0.01, 1, 0, True, (), (), (), harm=("2 um beside the path",)),
    ]
    counted = judging.tally(made, kinds)
    assert counted[judging.GOOD].wrong == [2]
    assert counted["stuck"].wrong == [4]
    told = " ".join("\n".join(judging.report(counted, kinds)).split())
    assert "Good: 3 windows of 2 recordings, 1 windows refused (33.33%" in told
    assert "1 windows are accepted with a null and its reason: 1 without L." in told
    assert "Bad: 2 recordings, 1 accepted, 1 of them without a warning, 1 to harm" in told
    assert "Judged wrongly, or without a warning, by seed: good 2; stuck 4." in told
    assert "| stuck | B11 | 2 | 0.01 s | 1 | 1 | 1 | 50% | 1 StuckValue |" in told


def test_a_good_recording_is_judged_good_and_a_turned_one_is_not() -> None:
    assert judging.judge(judging.GOOD, 1, faults.Spoilt(SHUTTLE)).accepted
    assert SHUTTLE.voltage_v is not None
    turned = replace(SHUTTLE, voltage_v=freeze_array(-SHUTTLE.voltage_v))
    judged = judging.judge("wrong sign", 1, faults.Spoilt(turned, 1.0))
    assert not judged.accepted
    assert "Unphysical" in judged.codes
    assert judged.refused == judged.windows == 2
