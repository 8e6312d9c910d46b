"""Array types and the physical parameters, with their names and units."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

PARAMETERS = ("R", "L", "K", "Jt", "ft", "Cd")
RATIOS = ("Jt/K", "ft/K", "Cd/K")  # identifiable from current and speed alone
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
    "friction_at_rapid": "N.m",  # Cd + ft w at the rapid speed
}

# optional terms; the number in a ripple's name is its periods per motor revolution
_TERMS: Mapping[str, str] = {
    r"load": "N.m",
    r"coulomb_(positive|negative)": "N.m",
    r"viscous_(positive|negative)": "N.m.s",
    r"stribeck": "N.m",
    r"stribeck_speed": "rad/s",
    r"presliding_um": "um",
    r"ripple_(screw|motor)_[1-9][0-9]?": "N.m",
    r"ripple_(screw|motor)_[1-9][0-9]?_phase": "rad",
    r"dead_time": "V",
    r"bus_sag": "1/W",
    r"speed_delay": "s",
    r"resonance": "Hz",
    r"resonance_(damping|share)": "1",
}


def get_unit(name: str) -> str | None:
    """Return the unit of a parameter, a ratio or a term; None for an unknown name."""
    if name in UNITS:
        return UNITS[name]
    return next((unit for pattern, unit in _TERMS.items() if re.fullmatch(pattern, name)), None)


def freeze_array(values: npt.ArrayLike) -> Float:
    """Return ``values`` as a read-only float64 array: a copy, so that no caller can change a record."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def make_read_only_view(values: Float) -> Float:
    """Return a read-only view without copying: kernels are compiled for this one array type."""
    view = values.view()
    view.setflags(write=False)
    return view


def freeze_integers(values: npt.ArrayLike) -> Int:
    """Return ``values`` as a read-only int64 array."""
    array = np.array(values, dtype=np.int64)
    array.setflags(write=False)
    return array


def compute_rms(values: Float) -> float:
    """Return the root mean square of (n,)."""
    return float((values @ values / values.size) ** 0.5)


@dataclass(frozen=True, slots=True)
class Parameters:
    """The six parameters of equations [1] and [2] (ohm, H, N.m/A, kg.m2, N.m.s, N.m), and ``terms``.

    The torque against the positive direction of a shaft with speed w, at the angle a = 2 pi x / pitch of its position
    x, is that of [2] with the added terms, side = sign(w):

        load + side (C + stribeck exp(-(w / stribeck_speed)^2)) + f w + sum of ripple_k sin(k a + ripple_k_phase)

    C is ``coulomb_positive`` or ``coulomb_negative`` where these exist, else Cd; f likewise ``viscous_...`` or ft. The
    shaft sticks while |K i - load - ripples| <= C + stribeck. ``terms`` are pairs of name and value.
    ``build_dead_time_regressor`` is
    the voltage that the inverter loses, against the current's direction. ``resonance`` is that of motor and table
    against each other, the motor free, from motor torque to motor speed; the table has ``resonance_share`` of Jt
    (default: half), and the friction acts on the table.
    """

    R: float
    L: float
    K: float
    Jt: float
    ft: float
    Cd: float
    terms: tuple[tuple[str, float], ...] = ()

    @classmethod
    def from_mapping(cls, values: Mapping[str, float]) -> Self:
        """Build parameters from values by name, the six and any terms; KeyError when one of the six is missing."""
        R, L, K, Jt, ft, Cd = (float(values[name]) for name in PARAMETERS)
        return cls(R, L, K, Jt, ft, Cd, tuple((n, float(v)) for n, v in values.items() if n not in PARAMETERS))

    def replace_values(self, **values: float) -> Self:
        """Return the parameters with some values, including terms, replaced or added."""
        return type(self).from_mapping({**self.as_dict(), **dict(self.terms), **values})

    def as_dict(self) -> dict[str, float]:
        """Return the six by symbol, in the order of ``PARAMETERS``."""
        return {name: float(getattr(self, name)) for name in PARAMETERS}

    def get_term(self, name: str, default: float = 0.0) -> float:
        """Return the value of a term, ``default`` where there is none."""
        return dict(self.terms).get(name, default)
