"""Programs on which only ``rs274`` differs: executed by a complete LinuxCNC, a machine in mm."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fdhil.errors import ProgramError
from fdhil.program import Arc, Dwell, Feed, interpret
from fdhil.records import Float
from tests.linuxcnc.linuxcnc_process import DemandRecorder
from tests.program.rs274_reference import find_difference, read_cases, run_reference

pytestmark = pytest.mark.debian

MARKED = [(text, why) for text, why in read_cases() if why]
NEAR_MM = 0.01  # LinuxCNC approximates a spline by arcs, some micrometres away from it


def record_demand(text: str, axes: str = "XYZ") -> Float:
    """Return the demand of a separate LinuxCNC, since these programs write its parameters."""
    with DemandRecorder(axes=axes) as nc:
        return nc.record_demand(text)


def list_ends(text: str) -> Float:
    """Ends of fdhil's motions, the machine's zero first; curves are chords."""
    motions = [motion for motion in interpret(text.splitlines()) if not isinstance(motion, Dwell)]
    assert not any(isinstance(motion, Arc) for motion in motions)
    return np.array([(0.0, 0.0, 0.0), *(motion.end for motion in motions)])


def measure_path_distance_mm(places: Float, path: Float) -> float:
    """Largest distance of points from a path through corners."""
    parts = [np.linspace(a, b, 2 + int(np.linalg.norm(b - a) / 0.005)) for a, b in pairwise(path)]
    return float(np.max(cKDTree(np.concatenate(parts)).query(places)[0]))


@pytest.mark.parametrize(("text", "why"), [m for m in MARKED if m[1].startswith("machine:")])
def test_machine_matches_fdhil_where_rs274_deviates(text: str, why: str) -> None:
    """G61, so that the path is the programmed one; faster, since none of these programs is about the feed."""
    corners = list_ends(text)
    axes = "XYZUVW" if "U1" in text else "XYZ"
    moved = record_demand("G61\n" + text.replace("F100", "F1000"), axes=axes)
    assert measure_path_distance_mm(corners, moved) <= NEAR_MM
    assert measure_path_distance_mm(moved, corners) <= NEAR_MM
    assert moved[-1] == pytest.approx(corners[-1], abs=1e-3)


@pytest.mark.parametrize(("text", "why"), [m for m in MARKED if "their feed" in m[1]])
def test_machine_runs_spline_at_previous_feed(text: str, why: str) -> None:
    text = text.replace("F100", "F1000")
    message = {motion.feed for motion in interpret(text.splitlines()) if isinstance(motion, Feed)}
    steps = np.linalg.norm(np.diff(record_demand("G61\n" + text), axis=0), axis=1) * 60_000.0
    assert list(message) == pytest.approx([float(np.median(steps[len(steps) // 2 :]))], rel=0.01)


@pytest.mark.parametrize(("text", "why"), [m for m in MARKED if m[1].startswith("written out")])
def test_written_out_moves_match_reference(text: str, why: str, tmp_path: Path) -> None:
    """G70: each pass from X20 Z2 without compensation, which the move to the contour enters."""
    head, contour, offset = "F100 G18", "G0 X2 Z0|G1 X4 Z-2|Z-10|X8", text.split("\n")[7]
    start, passes = "G40 G0 X20 Z2", 1 + ("P2" in text)
    assert [head, contour] == [text.split("\n")[0], "|".join(text.split("\n")[2:6])]
    path = tmp_path / "program.ngc"
    path.write_text("|".join([head, start, *([start, offset, contour] * passes), "G40|G0 X50|M2"]).replace("|", "\n"))
    assert not find_difference(list(interpret(text.splitlines())), run_reference(path).motions)


@pytest.mark.parametrize(("text", "why"), [m for m in MARKED if m[1].startswith("machine refuses")])
def test_machine_refuses_the_same_programs(text: str, why: str) -> None:
    with pytest.raises(ProgramError):
        list(interpret(text.splitlines()))
    with pytest.raises(AssertionError, match=r"LinuxCNC says: [^n]|nothing moved"):
        record_demand(text)


@pytest.mark.parametrize(("text", "why"), [m for m in MARKED if m[1].startswith("machine goes astray")])
def test_machine_ends_at_other_point_than_programmed(text: str, why: str) -> None:
    """A NURBS to X3 Y3 in the XZ plane."""
    with pytest.raises(ProgramError, match="XY plane"):
        list(interpret(text.splitlines()))
    assert np.linalg.norm(record_demand(text)[-1] - [3.0, 3.0, 0.0]) > 1.0
