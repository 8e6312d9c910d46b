"""Rapids of realistic machines (:mod:`studies.real_plant`), ready to be identified."""

from __future__ import annotations

from fdhil.identification.rapid_windows import find_windows
from fdhil.records import Window
from studies import real_plant
from studies.bench import make_shuttle_demand
from studies.real_plant import Loops, Mechanics, Sensors

RAPID_M_S = 0.5


def simulate_rapids(
    mechanics: Mechanics | None = None,
    sensors: Sensors | None = None,
    loops: Loops | None = None,
    *,
    moves: int = 1,
    seed: int = 1,
    dt_s: float = 1e-3,
) -> list[Window]:
    """Return the rapids of a shuttle of the bench's machine with some real effects."""
    own = mechanics or Mechanics()
    run = real_plant.simulate_axis(own, make_shuttle_demand(moves=moves), loops, dt_s)
    return find_windows(real_plant.make_recording(run, own, sensors or Sensors(), RAPID_M_S, seed))
