"""Simulates the drive's sensors: white noise, and the faults of a test or fault script."""

from dataclasses import dataclass, field

import numpy as np

from fdhil.config import Noise
from fdhil.sim.signal_fault import SignalFault

SIGNALS = ("position", "speed", "current", "voltage")
_BLOCK = 1024


@dataclass(slots=True)
class DriveFaults:
    """The mutable fault state of one drive; the defaults have no effect.

    ``signals`` maps position, speed, current or voltage to a :class:`SignalFault`. ``drop_tpdo`` maps a TPDO number to
    the number of frames still to be dropped (-1: all). ``ignore_offset``: writes to 0x60B0 are lost. ``offset_scale``:
    factor on the offset. ``refuse_csp``: 0x6061 shows profile position and set-points are not followed.
    ``no_heartbeat_consumer``: 0x1016 has no effect. ``load_torque_nm``: Tl, in the drive's direction.
    """

    signals: dict[str, SignalFault] = field(default_factory=dict)
    drop_tpdo: dict[int, int] = field(default_factory=dict)
    ignore_offset: bool = False
    offset_scale: float = 1.0
    not_csp: bool = False
    no_heartbeat_consumer: bool = False
    load_torque_nm: float = 0.0

    def get_signal_fault(self, name: str) -> SignalFault:
        """Return the fault of a signal, created on first use; KeyError for a name not in SIGNALS."""
        if name not in SIGNALS:
            raise KeyError(name)
        return self.signals.setdefault(name, SignalFault())


class DriveSensors:
    """Adds white noise to voltage, current and speed, drawn from ``rng`` in blocks: one row per sample, used or not."""

    def __init__(self, noise: Noise, faults: DriveFaults, rng: np.random.Generator) -> None:
        self._std = np.array([noise.voltage_v, noise.current_a, noise.speed_rad_s])
        self._faults = faults
        self._rng = rng
        self._rows: list[list[float]] = []

    def read_signals(
        self, position: float, speed: float, current: float, voltage: float
    ) -> tuple[float, float, float, float]:
        """Return the reported values: increments, rad/s, A, V."""
        if not self._rows:
            self._rows = (self._rng.standard_normal((_BLOCK, 3)) * self._std).tolist()
        noise = self._rows.pop()
        speed, current, voltage = speed + noise[2], current + noise[1], voltage + noise[0]
        faults = self._faults.signals
        if not faults:
            return position, speed, current, voltage
        true = (position, speed, current, voltage)
        reported = [
            faults[name].apply_errors(value, self._rng) if name in faults else value
            for name, value in zip(SIGNALS, true, strict=True)
        ]
        return reported[0], reported[1], reported[2], reported[3]
