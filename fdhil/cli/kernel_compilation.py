"""``python -m fdhil.cli.kernel_compilation``: compile all kernels once, which takes half a minute.

``make setup`` runs it. numba caches the kernels next to the code, or in ``NUMBA_CACHE_DIR``.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from fdhil import config as machine_config
from fdhil import tables
from fdhil.cli.demo.machines import REAL, load_machine_document
from fdhil.config import MachineConfig
from fdhil.daemon import compile_kernels, simulate_nominal_rapid
from fdhil.pipeline import analyse_window
from fdhil.records import SlowVoltage, Window, freeze_array
from fdhil.sim import SimulatedMachine

SLOW_ROWS = 5


def compile_all() -> None:
    """Run synthetic rapids through all computations: estimators, checks, corrections, the simulated drive."""
    config = machine_config.parse_config(load_machine_document())
    for method in (None, *tables.ESTIMATORS):
        compile_kernels(config, method)
    for window in _make_unusual_windows(config):
        analyse_window(window, config.identification)
    for machine in (config, machine_config.parse_config(load_machine_document(REAL))):
        SimulatedMachine(machine).power_on()


def _make_unusual_windows(config: MachineConfig) -> Iterator[Window]:
    # a stuck sensor, an instantaneous voltage and a slow voltage take other code paths than an ordinary rapid
    axis = config.axis["X"]
    sound = simulate_nominal_rapid("X", axis, config.machine.sync_period_s)
    speed = np.round(sound.speed_rad_s, 2)
    speed[200:230] = speed[200]
    yield replace(sound, speed_rad_s=freeze_array(speed))
    yield replace(sound, voltage_sampling="instant")
    assert sound.voltage_v is not None
    rows = sound.n // SLOW_ROWS * SLOW_ROWS
    means = sound.voltage_v[:rows].reshape(-1, SLOW_ROWS).mean(axis=1)
    slow = SlowVoltage(0.0, SLOW_ROWS * sound.dt_s, 0.2 * sound.dt_s, freeze_array(means))
    yield replace(sound, voltage_v=None, slow_voltage=slow)


if __name__ == "__main__":
    compile_all()
