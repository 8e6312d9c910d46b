"""Differentiates by stencils: Dx(t) = 1/h sum_j b_j x(t + j h). Operator [4] of [DES] is zero forcing #1."""

import math
from dataclasses import dataclass

import numpy as np

from fdhil.records import Float

_ROOT = math.sqrt(73.0)


@dataclass(frozen=True, slots=True)
class DerivativeStencil:
    """A derivative stencil: ascending ``offsets`` in samples, and ``weights`` before division by the period."""

    name: str
    offsets: tuple[int, ...]
    weights: tuple[float, ...]

    @property
    def before(self) -> int:
        """Samples needed before the current one."""
        return max(0, -self.offsets[0])

    @property
    def after(self) -> int:
        """Samples needed after the current one."""
        return max(0, self.offsets[-1])


# [DES] eq. 4 after [SOD 97]; exact: moments 0, 1, 0 and no |tau|^3 term, the root (7 - sqrt 73) / 12
ZERO_FORCING_1 = DerivativeStencil(
    "zero_forcing_1",
    (-2, -1, 0, 1),
    ((_ROOT - 5) / 12, (3 - _ROOT) / 4, (_ROOT - 5) / 4, (11 - _ROOT) / 12),
)


def differentiate_signal(values: Float, dt_s: float, operator: DerivativeStencil = ZERO_FORCING_1) -> Float:
    """Return the derivative (n,) of ``values`` (n,) per second; NaN where the stencil leaves the array or meets NaN."""
    n = values.size
    result = np.full(n, np.nan)
    first, last = operator.before, n - operator.after
    if last <= first:
        return result
    result[first:last] = sum(
        b * values[first + j : last + j] for j, b in zip(operator.offsets, operator.weights, strict=True)
    )
    return result / dt_s
