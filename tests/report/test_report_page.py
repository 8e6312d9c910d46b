"""The report: one self-contained page, and figures that match the data."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from fdhil.errors import FdhilError
from fdhil.records import Parameters, Stages, Window, freeze_array
from fdhil.report import Page, Section, Table, figures, render_html, write_page

PARAMETERS = Parameters(R=0.5, L=0.005, K=0.8, Jt=0.075, ft=0.05, Cd=5.0)


def build_window() -> Window:
    """Return a window simulated from its voltage, so that model and measurement agree."""
    from fdhil.model.feed_drive import simulate_plant

    voltage = np.concatenate([np.zeros(50), np.linspace(0, 60, 200), np.full(300, 60.0)])
    current, speed = simulate_plant(PARAMETERS, voltage, 0.001, "interval_mean")
    nothing = freeze_array(np.zeros(voltage.size))
    return Window(
        axis="X", start_tick=0, start_s=0.0, dt_s=0.001, demand_mm=nothing, position_mm=nothing,
        speed_rad_s=freeze_array(speed), current_a=freeze_array(current), voltage_v=freeze_array(voltage),
        voltage_sampling="interval_mean", stages=Stages((50, 250), (250, 550), None), direction=1,
        rapid_speed_rad_s=75.0, pitch_mm=20.0,
    )  # fmt: skip


def extract_curves() -> list[figures.Curve]:
    t = np.linspace(0, 10, 200)
    path = np.column_stack([t, np.minimum(t, 5.0)])
    return [figures.Curve("desired", path), figures.Curve("cut", path + 0.05)]


FIGURES = {
    "signals": lambda: figures.draw_signals(build_window()),
    "torque": lambda: figures.draw_torque(
        [("20 degC", build_window(), PARAMETERS), ("22 degC", build_window(), PARAMETERS)]
    ),
    "model_against_drive": lambda: figures.draw_model_comparison(build_window(), PARAMETERS, 99.5),
    "drift": lambda: figures.draw_drift("ft", "N.m.s", {"X": (np.arange(20.0, 23), np.arange(3.0), np.ones(3))}),
    "path": lambda: figures.draw_path(extract_curves()[0].path_mm, {"A": (5.0, 5.0)}),
    "corner": lambda: figures.draw_path_detail(extract_curves(), (5.0, 5.0), 1.0),
    "contour_errors": lambda: figures.draw_contour_errors(0.001, {"before": np.arange(9.0)}),
    "error_map": lambda: figures.draw_error_map(extract_curves()[0].path_mm, np.linspace(0, 9, 200), 9.0),
}


@pytest.mark.parametrize("name", FIGURES)
def test_figures_are_reproducible_svg(name: str) -> None:
    svg = FIGURES[name]()
    root = ET.fromstring(svg)
    assert root.tag.endswith("svg")
    assert len(svg) > 2000
    assert svg == FIGURES[name]()


def test_model_curve_coincides_with_the_measured_one() -> None:
    rapid = build_window()
    assert np.allclose(figures.simulate_speed(rapid, PARAMETERS), rapid.speed_rad_s, atol=1e-9)


def test_deviation_is_magnified_by_the_factor() -> None:
    reference, actual = np.zeros((2, 2)), np.full((2, 2), 0.1)
    assert np.allclose(figures.magnify_deviation(reference, actual, 10), 1.0)


def test_page_is_self_contained(tmp_path: Path) -> None:
    page = Page(
        "A <machine>",
        "subtitle",
        headline=[("after", "3.5 um")],
        sections=[
            Section("One", "text", [Table(["a", "b"], [["1", "2"]], "caption")], [("figure", FIGURES["corner"]())])
        ],
    )
    write_page(page, tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text("utf-8")
    assert "A &lt;machine&gt;" in text
    assert "3.5 µm" in text
    assert "<td>2</td>" in text
    loaded = re.findall(r"""(?:src|href)=["']([^"'#][^"']*)""", text)
    assert loaded == []
    assert re.findall(r"<script[^>]", text) == []  # none with a URL
    assert "default-src 'none'" in text  # and the browser may load nothing
    assert not list(tmp_path.rglob("*.part"))


def test_long_page_has_a_linked_table_of_contents() -> None:
    chapters = ("", "Section 2 of it", "Section 2 of it", "Section 3 of it")
    text = render_html(
        Page("long", "", sections=[Section(f"part {k}", chapter=name) for k, name in enumerate(chapters)])
    )
    linked = re.findall(r'href="#([\w-]+)"', text)
    assert linked == ["section-1", "section-2-of-it", "section-2", "section-3", "section-3-of-it", "section-4"]
    assert [text.count(f'id="{name}"') for name in linked] == [1] * len(linked)
    assert 'aria-label="Contents"' not in render_html(Page("short", "", sections=[Section("only one")]))


def test_unwritable_page_is_refused_with_a_message(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(FdhilError, match="cannot be written"):
        write_page(Page("t", "s"), tmp_path / "file" / "report.html")
