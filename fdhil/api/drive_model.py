"""The physical model of a drive, and its simulation from a voltage."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fdhil.errors import ConfigError, ConfigFault, FdhilError
from fdhil.model import simulate_plant
from fdhil.records import PARAMETERS, Float, Parameters, VoltageSampling


@dataclass(frozen=True)
class Model(Parameters):
    """R (ohm), L (H), K (N.m/A), Jt (kg.m2), ft (N.m.s) and Cd (N.m) of a drive, and additional ``terms``.

    ``u - K w = L di/dt + R i`` and ``K i - Tl = Jt dw/dt + ft w + Cd sign(w)`` ([DES] eq. 1 and 2).

    >>> import fdhil
    >>> fdhil.Model(R=0.5, L=0.005, K=0.8, Jt=0.075, ft=0.05, Cd=5.0)
    Model(R=0.5, L=0.005, K=0.8, Jt=0.075, ft=0.05, Cd=5.0, terms=())
    """

    def to_control(self) -> Any:
        """Return the linear part as a ``control.StateSpace``: input voltage (V), outputs and states current, speed.

        Dry friction and the terms are not linear and left out. FdhilError without python-control.
        """
        try:
            import control
        except ImportError:
            raise FdhilError("to_control needs python-control: pip install control") from None
        a = [[-self.R / self.L, -self.K / self.L], [self.K / self.Jt, -self.ft / self.Jt]]
        names = {"inputs": ["voltage"], "outputs": ["current", "speed"], "states": ["current", "speed"]}
        return control.ss(a, [[1.0 / self.L], [0.0]], np.eye(2), np.zeros((2, 1)), **names)


@dataclass(frozen=True, eq=False)
class Simulation:
    """A simulated drive: ``time`` (s), ``voltage`` (V), ``current`` (A) and ``speed`` (rad/s), arrays (n,)."""

    time: Float
    voltage: Float
    current: Float
    speed: Float


def simulate(
    model: Parameters,
    voltage: npt.ArrayLike,
    dt: float,
    *,
    voltage_sampling: VoltageSampling = "interval_mean",
    current: float = 0.0,
    speed: float = 0.0,
) -> Simulation:
    """Simulate a drive from the voltage (n,), V, at steps of ``dt`` s, its initial current (A) and speed (rad/s).

    The step is exact while the drive moves or sticks ([DES] eq. 1 and 2). ConfigError for an impossible model.

    >>> import numpy as np, fdhil
    >>> model = fdhil.Model(R=1.0, L=0.002, K=0.2, Jt=1e-3, ft=1e-3, Cd=0.05)
    >>> made = fdhil.simulate(model, np.full(2000, 12.0), 1e-3)
    >>> float(made.speed[-1].round(2)), float(made.current[-1].round(3))
    (57.32, 0.537)
    """
    faults = [
        ConfigFault(name, f"is {value:g}", "it must be a finite number above 0")
        for name, value in model.as_dict().items()
        if not np.isfinite(value) or (value <= 0.0 if name in PARAMETERS[:4] else value < 0.0)
    ]
    values = np.asarray(voltage, dtype=np.float64)
    if values.ndim != 1 or not np.isfinite(values).all():
        faults.append(ConfigFault("voltage", f"has shape {values.shape}", "give n finite numbers"))
    if not 0.0 < dt < 1.0:
        faults.append(ConfigFault("dt", f"is {dt:g}", "give the step in s"))
    if faults:
        raise ConfigError("simulate", faults)
    i, w = simulate_plant(model, values, dt, voltage_sampling, current, speed)
    return Simulation(np.arange(values.size, dtype=np.float64) * dt, values, i, w)
