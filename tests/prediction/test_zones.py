"""Zones named by their cause, each on a path and with drives that leave that error and no other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np

from fdhil import config as configuration
from fdhil.config import MachineConfig
from fdhil.prediction import predict
from fdhil.prediction.models import nominal_models
from fdhil.records import Float, Parameters, Zone
from tests.bench import bench_config, bench_document
from tests.paths import smooth, trajectory

CONFIG = bench_config()
NOMINAL = nominal_models(CONFIG)
SMOOTH = {axis: replace(model, Cd=0.0) for axis, model in NOMINAL.items()}  # nothing sticks
DT_S, SPEED_MM_S = 0.001, 100.0


def zones(path: Float, models: Mapping[str, Parameters], config: MachineConfig = CONFIG) -> tuple[Zone, ...]:
    """Zones of the path (n, d) as the bench's NC orders it, held for 0.4 s at its end."""
    held = np.concatenate([path, np.repeat(path[-1:], 400, axis=0)])
    return predict(trajectory(smooth(held, (0.060, 0.030), DT_S), "XYZ"[: path.shape[1]]), models, config).zones


def line(*points: tuple[float, ...]) -> Float:
    """The path through points at constant speed."""
    pieces = []
    for begin, end in pairwise(points):
        rows = round(float(np.linalg.norm(np.subtract(end, begin))) / (SPEED_MM_S * DT_S))
        pieces.append(np.array(begin) + np.arange(rows)[:, None] / rows * np.subtract(end, begin))
    return np.concatenate([*pieces, [points[-1]]])


def circle(radius_mm: float = 20.0) -> Float:
    """Two turns, begun along Y."""
    angle = np.arange(0.0, 4 * np.pi, SPEED_MM_S * DT_S / radius_mm)
    return radius_mm * np.column_stack([np.cos(angle) - 1.0, np.sin(angle)])


def lagging(y_gain: float) -> MachineConfig:
    """Drives that lag, Y by another time than X."""
    document = bench_document()
    for axis in document["axis"].values():
        axis["regulators"]["speed_feedforward"] = 0.9
    document["axis"]["Y"]["regulators"]["position_gain_per_s"] = y_gain
    return configuration.parse(document)


def at(zone: Zone) -> Float:
    """Its place."""
    return np.array([float(word) for word in zone.where.split()[1::2]])


def test_corner() -> None:
    """A turn by 90 degrees, at its place; nothing else is named but start and stop."""
    found = zones(line((0.0, 0.0), (60.0, 0.0), (60.0, 60.0)), SMOOTH)
    (corner,) = [zone for zone in found if zone.cause == "corner"]
    assert np.linalg.norm(at(corner) - (60.0, 0.0)) < 3.0
    assert {zone.cause for zone in found} <= {"corner", "start", "stop"}


def test_reversal() -> None:
    """On a circle the axes turn around at four places, where dry friction sticks; without it nothing is there."""
    found = zones(circle(), NOMINAL)
    places = [at(zone) for zone in found if zone.cause == "reversal"]
    assert len(places) >= 6
    for place in places:
        assert min(np.linalg.norm(place - quadrant) for quadrant in ((0, 0), (-20, 20), (-40, 0), (-20, -20))) < 1.0
    small = max((zone.max_um for zone in zones(circle(), SMOOTH) if zone.cause == "reversal"), default=0.0)
    assert small < 0.5 * max(zone.max_um for zone in found if zone.cause == "reversal")


def test_reversal_of_one_axis_alone() -> None:
    """Back along the same line is no corner."""
    found = zones(line((0.0,), (50.0,), (5.0,)), {"X": NOMINAL["X"]}, bench_config("X"))
    assert found
    assert {zone.cause for zone in found} == {"reversal"}
    back = zones(line((0.0, 0.0), (40.0, 30.0), (8.0, 6.0)), NOMINAL)
    assert "corner" not in {zone.cause for zone in back}
    assert "reversal" in {zone.cause for zone in back}


def test_circular_lag() -> None:
    """Axes that lag by different times make an ellipse of the circle: it is told all around."""
    found = zones(circle(), SMOOTH, lagging(40.0))
    seconds = {cause: sum(z.end_s - z.start_s for z in found if z.cause == cause) for cause in {z.cause for z in found}}
    assert seconds["circular lag"] > 0.2
    assert set(seconds) <= {"circular lag", "reversal", "start", "stop"}


def test_straight() -> None:
    """The same drives on a slanted line leave a constant error, from its start to its stop."""
    found = zones(line((0.0, 0.0), (80.0, 60.0)), SMOOTH, lagging(40.0))
    longest = max(found, key=lambda zone: zone.end_s - zone.start_s)
    assert longest.cause == "straight"
    assert min(found, key=lambda zone: zone.start_s).cause == "start"
    assert {zone.cause for zone in found} <= {"start", "straight", "stop"}


def test_start_and_stop() -> None:
    """Unequal inertia on a slanted line: errors where it speeds up and where it brakes."""
    models = {**SMOOTH, "Y": replace(SMOOTH["Y"], Jt=0.1)}
    found = zones(line((0.0, 0.0), (80.0, 60.0)), models)
    assert {zone.cause for zone in found} == {"start", "stop"}
    assert all(np.linalg.norm(at(z) - (0.0, 0.0)) < 20 for z in found if z.cause == "start")
    assert all(np.linalg.norm(at(z) - (80.0, 60.0)) < 20 for z in found if z.cause == "stop")


def test_saturation() -> None:
    """A tenth of the current: what the limit does is named before what the path does."""
    document = bench_document()
    for axis in document["axis"].values():
        axis["regulators"]["current_limit_a"] = 20.0
    found = zones(line((0.0, 0.0), (60.0, 0.0), (60.0, 60.0)), NOMINAL, configuration.parse(document))
    largest = max(found, key=lambda zone: zone.max_um)
    assert largest.cause == "saturation"
    assert largest.max_um > 2 * max(z.max_um for z in zones(line((0.0, 0.0), (60.0, 0.0), (60.0, 60.0)), NOMINAL))
