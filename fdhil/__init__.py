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
    from fdhil.api.drive_model import Model as Model
    from fdhil.api.drive_model import Simulation as Simulation
    from fdhil.api.drive_model import simulate as simulate
    from fdhil.api.identification_result import Parameter as Parameter
    from fdhil.api.identification_result import Result as Result
    from fdhil.api.identification_result import identify as identify
    from fdhil.api.machine_interface import Machine as Machine
    from fdhil.api.machine_interface import correct as correct
    from fdhil.api.machine_interface import plan as plan
    from fdhil.api.machine_interface import predict as predict
    from fdhil.api.recording_interface import Recording as Recording
    from fdhil.api.recording_interface import read as read

_MODULES = {
    "Machine": "machine",
    "Model": "model",
    "Parameter": "result",
    "Recording": "recordings",
    "Result": "result",
    "Simulation": "model",
    "correct": "machine",
    "identify": "result",
    "plan": "machine",
    "predict": "machine",
    "read": "recordings",
    "simulate": "model",
}
__all__ = [*_MODULES]

# The matrices of a window are small: threads of the numeric libraries only spin, and this PC has an NC next to it.
# The libraries read these when NumPy is imported first.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")


def __getattr__(name: str) -> object:
    """Return a name of the Python interface, importing it on first use."""
    if name not in _MODULES:
        raise AttributeError(f"module 'fdhil' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"fdhil.api.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    """Return the names of the package and of the Python interface."""
    return sorted({*globals(), *__all__})
