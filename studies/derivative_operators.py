"""Lists the derivative operators that the comparison tries: the paper's [4], its rivals, and Savitzky and Golay's."""

from __future__ import annotations

from collections.abc import Mapping

from fdhil.cli.paper import derivative_operators
from fdhil.identification.derivatives import DerivativeStencil


def _savitzky_golay(half: int) -> DerivativeStencil:
    """Return the slope of a parabola fitted to 2 half + 1 samples."""
    offsets = tuple(range(-half, half + 1))
    norm = sum(j * j for j in offsets)
    return DerivativeStencil(f"savitzky_golay_{2 * half + 1}", offsets, tuple(j / norm for j in offsets))


OPERATORS: Mapping[str, DerivativeStencil] = {
    **derivative_operators.OPERATORS,
    **{operator.name: operator for operator in (_savitzky_golay(3), _savitzky_golay(7))},
}
