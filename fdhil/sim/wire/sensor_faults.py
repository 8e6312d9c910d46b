"""What can be wrong with a simulated sensor, whichever wire it is on."""

from __future__ import annotations

from dataclasses import dataclass, field

from fdhil.sim.signal_fault import SignalFault


@dataclass(slots=True)
class SensorFaults:
    """Errors of a sensor: ``silent`` answers nothing, ``slow_s`` answers late, ``exception`` answers every
    request with this code, ``signal`` spoils the samples (V)."""

    silent: bool = False
    slow_s: float = 0.0
    exception: int = 0
    signal: SignalFault = field(default_factory=SignalFault)
