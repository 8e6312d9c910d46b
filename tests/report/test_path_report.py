"""The page of a prediction and of a correction."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from fdhil.correction import plan_correction
from fdhil.prediction import predict_path
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.records import Correction, freeze_array
from fdhil.report import figures, path_maps, write_page
from fdhil.report.path_report import (
    APART_MM,
    build_correction_page,
    build_prediction_page,
    find_nearest_mm,
    find_worst_positions,
    list_planes,
)
from fdhil.report.svg_drawing import open_drawing
from tests.bench import bench_config
from tests.paths import build_bench_trajectory, build_trajectory, smooth_demand

CONFIG = bench_config()
MODELS = build_nominal_models(CONFIG)


@pytest.fixture(scope="module", name="correction")
def _correction() -> Correction:
    return plan_correction(build_bench_trajectory(10), MODELS, CONFIG)


@pytest.mark.usefixtures("long_computation")
def test_correction_page_shows_both_errors(correction: Correction, tmp_path: Path) -> None:
    """A map and a scale for each, every corner enlarged with both curves, the zones with both errors."""
    page = build_correction_page("part.ngc", "bench", correction)
    along, places, zones = page.sections
    assert [caption.partition(":")[0] for caption, _ in along.figures][:2] == [
        "uncorrected, plane XY",
        "inverse correction, plane XY",
    ]
    corners = [caption for caption, _ in places.figures if "corner" in caption]
    assert len(corners) == 4
    assert all("times as large" in caption for caption in corners)
    assert all("inverse correction" in svg and "desired" in svg for _, svg in places.figures)
    for row in zones.tables[0].rows:
        assert float(row[-1]) < 0.05 * float(row[-2])
    write_page(page, tmp_path / "page.html")
    assert (tmp_path / "page.html").stat().st_size < 2_000_000


def test_magnified_deviation_is_the_contour_error(correction: Correction) -> None:
    """A lag along the path does not count: the drawn point lies as far from the path as its contour error."""
    before = correction.before
    rows = slice(300, 600)
    actual = np.column_stack([before.predicted_mm[axis] for axis in "XY"])[rows]
    away_um = np.linalg.norm(actual - find_nearest_mm(before, rows), axis=1) * 1e3
    assert np.allclose(away_um, before.contour_um[rows], atol=1e-6)


@pytest.mark.usefixtures("long_computation")
def test_refused_correction_page_shows_the_reasons() -> None:
    """The page shows the uncorrected path and the advice."""
    refused = plan_correction(build_bench_trajectory(20, (0.030, 0.015)), MODELS, CONFIG)
    page = build_correction_page("part.ngc", "bench", refused)
    assert ("correction", "refused") in page.headline
    assert "lower the feed to" in page.sections[0].text
    assert not re.search(r"\de[+-]\d", " ".join(value for _, value in page.headline))


def test_worst_positions_are_separate_and_in_path_order(correction: Correction) -> None:
    """One picture per position, however many zones it has."""
    found = find_worst_positions(correction.before)
    rows = [row for _, row in found]
    assert rows == sorted(rows)
    path = np.column_stack([correction.before.reference.position_mm[axis] for axis in "XY"])
    assert all(np.linalg.norm(path[a] - path[b]) > APART_MM for a, b in pairwise(rows))


def test_planes_are_listed_for_three_axes_and_for_one() -> None:
    """The plane with most of the path comes first; a single axis has no map, but still a page."""
    flat = build_bench_trajectory(10)
    z = 30 * np.sin(flat.time_s)
    solid = replace(flat, position_mm={**flat.position_mm, "Z": freeze_array(z)})
    assert list_planes(solid) == [("X", "Y"), ("X", "Z")]
    alone = build_trajectory(np.asarray(flat.position_mm["Y"])[:, None], "Y")
    assert list_planes(alone) == []
    page = build_prediction_page("up.ngc", "bench", predict_path(alone, MODELS, CONFIG))
    assert [caption for caption, _ in page.sections[0].figures] == ["Contour error over time"]


def test_single_axis_error_is_drawn_over_time() -> None:
    """At a reversal, the error of the axis is drawn over time."""
    there = np.linspace(0.0, 60.0, 360)
    path = smooth_demand(np.concatenate([there, there[::-1], np.zeros(300)])[:, None], (0.060, 0.030), 0.001)
    page = build_prediction_page("up.ngc", "bench", predict_path(build_trajectory(path, "Y"), MODELS, CONFIG))
    (caption, svg), *_ = page.sections[1].figures
    assert "reversal" in caption
    assert "Y ahead of the desired (um)" in svg
    assert page.sections[2].tables[0].rows


@pytest.mark.usefixtures("long_computation")
def test_long_path_is_drawn_by_points_with_limited_zones(tmp_path: Path) -> None:
    """Each position has the colour of its own error, and no other pass is in its picture; equal positions appear a few
    times.
    """
    once = np.column_stack([build_bench_trajectory(10).position_mm[axis] for axis in "XY"])
    both = np.concatenate([once, once[::-1]])
    path = np.concatenate([both + np.array([0.0, 0.5 * k]) for k in range(14)])
    predicted = predict_path(build_trajectory(path), MODELS, CONFIG)
    assert len(predicted.zones) > 50
    page = build_prediction_page("long.ngc", "bench", predicted)
    along, places, zones = page.sections
    assert "<image" in along.figures[0][1]
    assert len(places.figures) <= 8
    assert len(zones.tables[0].rows) == 50
    assert "smaller ones are left out" in zones.text
    write_page(page, tmp_path / "long.html")
    assert (tmp_path / "long.html").stat().st_size < 1_000_000


def test_map_points_show_the_largest_local_error() -> None:
    """A single bad sample in ten minutes of path is visible at its position."""
    n = 120_000
    angle = np.linspace(0, 60 * np.pi, n)
    circle = 50 * np.column_stack([np.cos(angle), np.sin(angle)])
    error = np.ones(n)
    error[n // 7] = 80.0
    with open_drawing() as made:
        seen = path_maps._draw_points(made.axes, circle, error).get_array()
    assert seen is not None
    row, column = np.unravel_index(int(np.argmax(seen)), seen.shape)
    at = circle.min(axis=0) + (np.array([column, row]) + 0.5) * np.ptp(circle, axis=0).max() / path_maps.POINTS
    assert seen.max() == 80.0
    assert np.linalg.norm(at - circle[n // 7]) < 1.0


def test_small_error_is_visible_next_to_a_large_one() -> None:
    """On one linear scale it would be a line at 0."""
    both = figures.draw_contour_errors(0.001, {"before": np.full(9, 100.0), "after": np.full(9, 0.2)})
    assert ">0.1<" in both
    assert ">0.1<" not in figures.draw_contour_errors(0.001, {"before": np.full(9, 100.0)})


def test_path_without_error_yields_a_page() -> None:
    still = build_trajectory(np.zeros((300, 2)))
    page = build_prediction_page("nothing.ngc", "bench", predict_path(still, MODELS, CONFIG))
    assert page.sections[1].text == page.sections[2].text == "No zone stands out."
    assert ("predicted, largest", "below 0.001 um") in page.headline
