"""The simulated drive's regulators are those of the default structure."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil import config
from fdhil.errors import ConfigError
from fdhil.sim.drive.servo_drive import SimulatedDrive
from tests.bench import bench_document


def test_unsupported_regulators_are_refused() -> None:
    """They would silently be simulated as p_pi_pi."""
    document = bench_document("X")
    document["axis"]["X"]["regulators"] |= {"structure": "pid", "speed_ki": 0.0, "torque_feedforward": 1.0}
    with pytest.raises(ConfigError) as caught:
        SimulatedDrive("X", config.parse_config(document), np.random.default_rng(0))
    assert [fault.path for fault in caught.value.faults] == [
        "axis.X.regulators.structure",
        "axis.X.regulators.torque_feedforward",
    ]
