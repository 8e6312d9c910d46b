"""Arrays and physical parameters, with their names and units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

PARAMETERS = ("R", "L", "K", "Jt", "ft", "Cd")
RATIOS = ("Jt/K", "ft/K", "Cd/K")  # what current and speed alone tell
INTERVAL_95 = 1.959963984540054
"""Half the width of a 95 % interval, in standard deviations of a normal distribution."""
UNITS: Mapping[str, str] = {
    "R": "ohm",
    "L": "H",
    "K": "N.m/A",
    "Jt": "kg.m2",
    "ft": "N.m.s",
    "Cd": "N.m",
    "Jt/K": "A.s2/rad",
    "ft/K": "A.s/rad",
    "Cd/K": "A",
}


def frozen(values: npt.ArrayLike) -> Float:
    """Return ``values`` as a read-only float64 array (a copy, so that no caller can reach into a record)."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def read_only(values: Float) -> Float:
    """Return a read-only view, not a copy: a kernel that only reads is compiled for this one kind of array."""
    view = values.view()
    view.setflags(write=False)
    return view


def frozen_ints(values: npt.ArrayLike) -> Int:
    """Return ``values`` as a read-only int64 array."""
    array = np.array(values, dtype=np.int64)
    array.setflags(write=False)
    return array


def rms(values: Float) -> float:
    """Return the root mean square of (n,)."""
    return float((values @ values / values.size) ** 0.5)


@dataclass(frozen=True, slots=True)
class Parameters:
    """The six physical parameters of equations [1] and [2]: ohm, H, N.m/A, kg.m2, N.m.s, N.m."""

    R: float
    L: float
    K: float
    Jt: float
    ft: float
    Cd: float

    def as_dict(self) -> dict[str, float]:
        """Return the parameters by symbol, in the order of ``PARAMETERS``."""
        return {name: float(getattr(self, name)) for name in PARAMETERS}
