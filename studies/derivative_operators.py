"""Lists the derivative operators that the comparison tries: the paper's [4], its rivals, and Savitzky and Golay's."""

from __future__ import annotations

import math
from collections.abc import Mapping

from fdhil.identification.derivatives import ZERO_FORCING_1, Operator


def _savitzky_golay(half: int) -> Operator:
    """Return the slope of a parabola fitted to 2 half + 1 samples."""
    offsets = tuple(range(-half, half + 1))
    norm = sum(j * j for j in offsets)
    return Operator(f"savitzky_golay_{2 * half + 1}", offsets, tuple(j / norm for j in offsets))


OPERATORS: Mapping[str, Operator] = {
    op.name: op
    for op in (
        ZERO_FORCING_1,
        Operator("zero_forcing_3_tap", (-1, 0, 1), ((math.sqrt(2) - 1) / 2, -math.sqrt(2), (1 + math.sqrt(2)) / 2)),
        Operator("central", (-1, 0, 1), (-0.5, 0.0, 0.5)),
        Operator("backward", (-1, 0), (-1.0, 1.0)),
        _savitzky_golay(3),
        _savitzky_golay(7),
    )
}
