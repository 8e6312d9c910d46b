"""What can be wrong with a simulated sensor, whichever wire it is on."""

from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random

from fdhil.sim.signal_fault import SignalFault

Answered = tuple[Callable[[int, bytes], bytes], int, bytes]


@dataclass(slots=True)
class SensorFaults:
    """Errors of a sensor: ``silent`` answers nothing, ``slow_s`` answers late, ``exception`` answers every
    request with this code, ``signal`` spoils the samples (V), ``answers`` which percentage of its answers is spoilt
    how. ``before`` is the answer before: how it was framed, its unit, function and data."""

    silent: bool = False
    slow_s: float = 0.0
    exception: int = 0
    signal: SignalFault = field(default_factory=SignalFault)
    answers: dict[str, float] = field(default_factory=dict)
    draw: Random = field(default_factory=lambda: Random(1), compare=False, repr=False)
    before: Answered | None = field(default=None, compare=False, repr=False)
