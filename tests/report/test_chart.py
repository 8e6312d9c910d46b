"""Charts: the drawing and the exported data; typeset units; comparable maps."""

from __future__ import annotations

import html
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.errors import FdhilError
from fdhil.records import freeze_array
from fdhil.report import Page, figures, path_maps, write_pdf
from fdhil.report.chart import MOST_POINTS, Chart, Panel, Trace, decimate_curve, render_svg
from fdhil.report.svg_drawing import compute_legend_layout
from fdhil.report.typography import typeset_markup, typeset_text
from tests.report.test_report_page import PARAMETERS, build_window


def parse_chart_data(picture: str) -> dict[str, Any]:
    """Return the data that the page's script reads from a picture."""
    (text,) = re.findall(r"<metadata>(.*?)</metadata>", picture, re.DOTALL)
    found: dict[str, Any] = json.loads(html.unescape(text))
    return found


def test_decimated_curve_keeps_its_peaks() -> None:
    x = np.arange(100_000.0)
    y = np.sin(x / 7000)
    y[54_321], y[99_999], y[500] = 9.0, -7.0, np.nan
    at, drawn = decimate_curve(x, y)
    assert at.size <= MOST_POINTS
    assert np.all(np.diff(at) > 0)
    assert drawn[at == 54_321] == 9.0
    assert drawn[at == 99_999] == -7.0


def test_exported_data_match_the_drawn_chart() -> None:
    """Shared grids are exported once, lost values are null, and bounds accompany their values."""
    x = freeze_array([3.0, 1.0, 2.0])
    bars = Trace(
        "points", x, freeze_array([30.0, 10.0, 20.0]), style="points", low=x, high=freeze_array([33.0, 11.0, 22.0])
    )
    line = Trace("line", freeze_array([1.0, 2.0, 3.0]), freeze_array([1.0, np.nan, 1 / 3]))
    chart = Chart("time (s)", [Panel("um", [bars, line], levels=[("limit", 40.0)])], "words", marks=[("step", 2.0)])
    found = parse_chart_data(render_svg(chart))
    assert found["grids"] == [[1, 2, 3]]
    (panel,) = found["panels"]
    assert [trace["x"] for trace in panel["traces"]] == [0, 0]
    assert panel["traces"][0]["y"] == [10, 20, 30]
    assert panel["traces"][0]["high"] == [11, 22, 33]
    assert panel["traces"][1]["y"] == [1, None, 0.33333]
    assert (panel["levels"], found["marks"]) == ([["limit", 40]], [["step", 2]])


def test_exported_times_keep_all_digits() -> None:
    day = Trace("day", freeze_array([1_800_000_000.0, 1_800_086_400.0]), freeze_array([1.0, 2.0]))
    assert parse_chart_data(render_svg(Chart("time (UTC)", [Panel("", [day])], "", in_time=True)))["grids"] == [
        [1800000000, 1800086400]
    ]


def test_model_comparison_has_a_panel_for_the_difference() -> None:
    """Model and drive coincide on one scale, so their difference has its own panel."""
    overlay, between = parse_chart_data(figures.draw_model_comparison(build_window(), PARAMETERS, 99.5))["panels"]
    drive, model = (np.array(trace["y"]) for trace in overlay["traces"])
    assert np.allclose(between["traces"][0]["y"], drive - model, atol=1e-3)


def test_pictures_have_alternative_text() -> None:
    """For blind readers, with the figures."""
    picture = figures.draw_contour_errors(0.001, {"before": np.full(9, 100.0), "after": np.full(9, 0.2)})
    (words,) = re.findall(r'aria-label="([^"]*)"', picture)
    assert words == "Contour error along the path: before 100 um RMS, 100 um at most; after 0.2 um RMS, 0.2 um at most."


def test_legend_fits_into_its_picture() -> None:
    assert compute_legend_layout(["a", "b", "c"], 3.8) == (3, 1)
    assert compute_legend_layout(["uncorrected", "mirror of the paper", "inverse", "inverse, warm"], 3.8)[1] > 1
    assert compute_legend_layout(["a name that is much longer than the picture is wide " * 3], 3.8) == (1, 1)


def test_compared_maps_share_one_scale() -> None:
    before, after = np.linspace(0.0, 100.0, 50), np.linspace(0.0, 0.5, 50)
    assert figures.find_common_scale([before, 0.5 * before]) == (100.0, None)
    largest, least = figures.find_common_scale([before, after])
    assert largest == 100.0
    assert least is not None
    assert 0.0 < least < 0.5


def test_map_shows_start_direction_and_named_positions() -> None:
    angle = np.linspace(0.0, np.pi, 200)
    arc = 50 * np.column_stack([np.cos(angle), np.sin(angle)])
    picture = path_maps.draw_error_map(arc, angle, 4.0, places=[path_maps.MapPosition("1", 0.0, 50.0)])
    assert ">start<" in picture
    assert ">1<" in picture
    found = parse_chart_data(picture)
    left, top, right, bottom = found["box"]
    (low, high), worst = found["x"], found["at"][-1]
    assert (left < right, top < bottom) == (True, True)
    assert low < -50.0 < 50.0 < high
    assert worst == [-50.0, 0.0, 3.14]


def test_units_are_typeset_but_file_names_are_not() -> None:
    told_plain = "24.1 um RMS, 5.39 +- 0.02 N.m.s at 20 degC, 157 x smaller, (1.42 ±0.06)e-6 1/W, 530 mohm -> 1 kg.m2"
    assert (
        typeset_text(told_plain)
        == "24.1 µm RMS, 5.39 ± 0.02 N·m·s at 20 °C, 157 × smaller, (1.42 ±0.06)·10⁻⁶ 1/W, 530 mΩ → 1 kg·m²"
    )
    for name in ("um.ngc", "part_um.ngc", "sum", "X 1.3", "/um/part.ngc", "G1 X60"):
        assert typeset_text(name) == name
    assert typeset_markup('<text class="um">um</text>') == '<text class="um">µm</text>'


@pytest.mark.usefixtures("processes")
def test_missing_browser_refuses_the_pdf_with_a_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(FdhilError, match="apt-get install chromium"):
        write_pdf(Page("t", "s"), tmp_path / "page.pdf")
    browser = tmp_path / "chromium"
    browser.write_text("#!/bin/sh\necho 'no display' >&2\n")
    browser.chmod(0o755)
    with pytest.raises(FdhilError, match=r"printed nothing \(no display\); print the HTML page"):
        write_pdf(Page("t", "s"), tmp_path / "page.pdf")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["chromium"]
