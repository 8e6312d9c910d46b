"""The highest feed of each stretch of a program at which the drives keep it within a tolerance."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fdhil.config import MachineConfig
from fdhil.prediction.predict import predict
from fdhil.program import Arc, Feed, Motion
from fdhil.program import plan as plan_program
from fdhil.records import Float, Parameters, Trajectory

SHARES = (1.0, 0.85, 0.7, 0.55, 0.4, 0.3, 0.2, 0.12, 0.06)  # of the programmed feed, tried in this order


@dataclass(frozen=True, slots=True)
class Advice:
    """One source line that leaves the tolerance: its error as programmed, and the feed at which it would not.

    ``share`` of the programmed feed, None where no feed that was tried keeps it. ``line`` 0: the whole demand.
    """

    line: int
    error_um: float
    where: str
    share: float | None


def at_share(motions: Sequence[Motion], share: float) -> list[Motion]:
    """Return the motions with every programmed feed times ``share``; rapids and dwells stay."""
    return [replace(m, feed=m.feed * share) if isinstance(m, Feed | Arc) else m for m in motions]


def program_at(motions: Sequence[Motion], config: MachineConfig) -> Callable[[float], Trajectory]:
    """Return what plans a program at a share of its feed."""
    return lambda share: plan_program(at_share(motions, share), config)


def demand_at(reference: Trajectory) -> Callable[[float], Trajectory]:
    """Return what scales a recorded demand: with fixed smoothing, a share of the feed scales speed and acceleration.

    The shape shrinks with it; the errors are those of the slower path for corners, and too small for long arcs.
    """

    def scaled(share: float) -> Trajectory:
        position = {axis: path[0] + share * (path - path[0]) for axis, path in reference.position_mm.items()}
        return replace(reference, position_mm=position)

    return scaled


def advise(
    at: Callable[[float], Trajectory], models: Mapping[str, Parameters], config: MachineConfig, tolerance_um: float
) -> tuple[Advice, ...]:
    """Return one advice per source line whose contour error exceeds ``tolerance_um`` as programmed, in program order.

    Every share of the feed is planned and predicted as a whole, so that a line is judged with its neighbours slowed
    alike; between two shares the feed is interpolated.
    """
    errors: dict[int, list[float]] = {}
    places: dict[int, str] = {}
    over: set[int] = set()
    tried: list[float] = []
    for share in SHARES:
        reference = at(share)
        contour = predict(reference, models, config).contour_um
        for line, (error, row) in _worst(reference, contour).items():
            errors.setdefault(line, []).append(error)
            if share == SHARES[0]:
                places[line] = " ".join(f"{axis} {reference.position_mm[axis][row]:.1f}" for axis in reference.axes)
                if error > tolerance_um:
                    over.add(line)
        tried.append(share)
        if all(errors[line][-1] <= tolerance_um for line in over):
            break
    return tuple(
        Advice(line, errors[line][0], places[line], _highest(tried, errors[line], tolerance_um))
        for line in sorted(over)
    )


def _worst(reference: Trajectory, contour_um: Float) -> dict[int, tuple[float, int]]:
    """Return the largest error and its row for each source line of a feed move."""
    rows = np.flatnonzero(~reference.rapid)
    if rows.size == 0:
        return {}
    order = rows[np.argsort(contour_um[rows])]
    # the last one of a line in the order of the errors is its largest
    return {int(reference.line[row]): (float(contour_um[row]), int(row)) for row in order.tolist()}


def _highest(shares: Sequence[float], errors_um: Sequence[float], tolerance_um: float) -> float | None:
    """Return the highest share at which, and below which, the error stays within the tolerance."""
    pairs = list(zip(shares, errors_um, strict=False))
    for (share, error), (lower, below) in zip(reversed(pairs[:-1]), reversed(pairs[1:]), strict=True):
        if below > tolerance_um:
            return None
        if error > tolerance_um:
            return lower + (share - lower) * (tolerance_um - below) / (error - below)
    return None if not pairs or pairs[-1][1] > tolerance_um else pairs[0][0]
