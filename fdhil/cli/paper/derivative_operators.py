"""Derivative operators: the paper's own, [4], and three rivals, which the paper does not name."""

import math
from collections.abc import Mapping

from fdhil.identification import ZERO_FORCING_1, DerivativeStencil

OPERATORS: Mapping[str, DerivativeStencil] = {
    operator.name: operator
    for operator in (
        ZERO_FORCING_1,
        DerivativeStencil(
            "zero_forcing_3_tap", (-1, 0, 1), ((math.sqrt(2) - 1) / 2, -math.sqrt(2), (1 + math.sqrt(2)) / 2)
        ),
        DerivativeStencil("central", (-1, 0, 1), (-0.5, 0.0, 0.5)),
        DerivativeStencil("backward", (-1, 0), (-1.0, 1.0)),
    )
}
