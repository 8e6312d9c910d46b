"""Defines the faults of a simulated sensor, on any connection."""

from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random

from fdhil.sim.signal_fault import SignalFault

Answered = tuple[Callable[[int, bytes], bytes], int, bytes]


@dataclass(slots=True)
class SensorFaults:
    """Errors of a sensor.

    ``silent``: no answers. ``slow_s``: late answers. ``exception``: this code in every answer. ``signal``: errors of
    the samples (V). ``answers``: the percentage of answers with each kind of fault. ``before``: the previous answer,
    with its framing, unit, function and data.
    """

    silent: bool = False
    slow_s: float = 0.0
    exception: int = 0
    signal: SignalFault = field(default_factory=SignalFault)
    answers: dict[str, float] = field(default_factory=dict)
    draw: Random = field(default_factory=lambda: Random(1), compare=False, repr=False)
    before: Answered | None = field(default=None, compare=False, repr=False)
