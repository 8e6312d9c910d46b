"""fdhil: identify feed drives during rapid moves, predict path errors, and feed corrections back.

The Python interface is loaded when it is first used::

    import fdhil

    recording = fdhil.read("scope.csv", columns={"time": "Time", "voltage": "CH1", "current": "CH2", "speed": "n_act"})
    result = fdhil.identify(recording, any_move=True)
    print(result)
"""

import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fdhil.api import (
        Machine,
        Model,
        Parameter,
        Recording,
        Result,
        Simulation,
        correct,
        identify,
        plan,
        predict,
        read,
        simulate,
    )

__all__ = [
    "Machine",
    "Model",
    "Parameter",
    "Recording",
    "Result",
    "Simulation",
    "correct",
    "identify",
    "plan",
    "predict",
    "read",
    "simulate",
]

# The matrices of a window are small: threads of the numeric libraries only spin, and this PC has an NC next to it.
# The libraries read these when NumPy is imported first.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")


def __getattr__(name: str) -> Any:
    """Return a name of the Python interface, which is imported now."""
    if name not in __all__:
        raise AttributeError(f"module 'fdhil' has no attribute {name!r}")
    from fdhil import api

    return getattr(api, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
