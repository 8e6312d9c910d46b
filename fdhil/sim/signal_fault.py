"""Adds white noise to a signal, and falsifies it as ordered by a fault script."""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

_NOISE_BLOCK = 1024


@dataclass(slots=True)
class SignalFault:
    """Errors of one reported signal, in its own unit; applied in this order.

    ``delay_cycles``: delay. ``gain``, ``offset``: scaling. ``clip``: saturation at +-clip. ``resolution``:
    quantisation. ``garbage``: random values of up to +-``garbage``. ``stuck``: the last value for ever.
    """

    delay_cycles: int = 0
    gain: float = 1.0
    offset: float = 0.0
    clip: float | None = None
    resolution: float = 0.0
    garbage: float = 0.0
    stuck: bool = False
    _late: deque[float] = field(default_factory=deque, repr=False, compare=False)
    _held: float | None = field(default=None, repr=False, compare=False)

    def apply_errors(self, value: float, rng: np.random.Generator) -> float:
        """Return the reported value for ``value``."""
        if self.delay_cycles:
            self._late.append(value)
            value = self._late[0]
            while len(self._late) > self.delay_cycles:
                self._late.popleft()
        else:
            self._late.clear()
        value = value * self.gain + self.offset
        if self.clip is not None:
            value = min(max(value, -self.clip), self.clip)
        if self.resolution:
            value = round(value / self.resolution) * self.resolution
        if self.garbage:
            value = float(rng.uniform(-self.garbage, self.garbage))
        if not self.stuck:
            self._held = None
        elif self._held is None:
            self._held = value
        return value if self._held is None else self._held


class WhiteNoise:
    """White noise, drawn in blocks."""

    def __init__(self, std: float, rng: np.random.Generator) -> None:
        self._std, self._rng = std, rng
        self._drawn: list[float] = []

    def draw(self) -> float:
        """Return the next value."""
        if not self._drawn:
            self._drawn = (self._rng.standard_normal(_NOISE_BLOCK) * self._std).tolist()
        return self._drawn.pop()
