"""fdhil: identify feed drives during rapid moves, predict path errors, and feed corrections back.

The Python interface is imported when it is first used::

    import fdhil

    recording = fdhil.read("scope.csv", columns={"time": "Time", "voltage": "CH1", "current": "CH2", "speed": "n_act"})
    result = fdhil.identify(recording, any_move=True)
    print(result)
"""

import os

TYPE_CHECKING = False  # type checkers know it; importing typing takes longer than all of this
if TYPE_CHECKING:
    from fdhil.api import Machine as Machine
    from fdhil.api import Model as Model
    from fdhil.api import Parameter as Parameter
    from fdhil.api import Recording as Recording
    from fdhil.api import Result as Result
    from fdhil.api import Simulation as Simulation
    from fdhil.api import correct as correct
    from fdhil.api import identify as identify
    from fdhil.api import plan as plan
    from fdhil.api import predict as predict
    from fdhil.api import read as read
    from fdhil.api import simulate as simulate

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


def __getattr__(name: str) -> object:
    """Return a name of the Python interface, importing it on first use."""
    if name not in __all__:
        raise AttributeError(f"module 'fdhil' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module("fdhil.api"), name)


def __dir__() -> list[str]:
    """Return the names of the package and of the Python interface."""
    return sorted({*globals(), *__all__})
