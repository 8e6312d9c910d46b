"""Other methods on the same recordings: the paper's least squares, output error, state-space subspace methods.

Each takes the columns of a recording (SI) and returns the parameters by symbol. Methods of libraries that are not
installed are left out (``pip install control sippy-unipi tf2ss sympy``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.util import find_spec

import numpy as np
from numba import njit
from scipy.linalg import expm, logm
from scipy.optimize import least_squares
from scipy.signal import butter, filtfilt

from studies.zoo.plant import Array

NAMES = ("R", "L", "K", "Jt", "ft", "Cd")
LOW_PASS_HZ = 40.0
Columns = Mapping[str, Array]
Found = dict[str, float]
SLOW_RAD_S = 1.0  # below it nothing is known of the side of dry friction


def _signals(columns: Columns, period_s: float) -> tuple[Array, Array, Array, Array]:
    """Return voltage, current, speed and the side of dry friction, filtered alike (no phase), (n,) each."""
    corner = min(LOW_PASS_HZ, 0.2 / period_s)
    low_pass = butter(2, corner, fs=1 / period_s)
    speed = filtfilt(*low_pass, columns["speed_rad_per_s"])
    side = np.sign(speed) * (np.abs(speed) > SLOW_RAD_S)
    u, i, s = (
        filtfilt(*low_pass, column) for column in (_at_instants(columns["voltage_V"]), columns["current_A"], side)
    )
    return u, i, speed, s


def paper(columns: Columns, period_s: float) -> Found:
    """Least squares on [5] and [6] of the paper, every signal through one low-pass."""
    u, i, w, side = _signals(columns, period_s)
    electrical = np.column_stack([i, np.gradient(i, period_s), w])
    r, inductance, k = np.linalg.lstsq(electrical, u, rcond=None)[0]
    mechanical = np.column_stack([np.gradient(w, period_s), w, side])
    jt, ft, cd = np.linalg.lstsq(mechanical, k * i, rcond=None)[0]
    return dict(zip(NAMES, map(float, (r, inductance, k, jt, ft, cd)), strict=True))


def _at_instants(means: Array) -> Array:
    """Return the voltage (n,) about the instants of the samples from its means over the intervals after them."""
    return np.asarray((means + np.concatenate([means[:1], means[:-1]])) / 2)


def _raw(columns: Columns) -> tuple[Array, Array, Array, Array]:
    """Return voltage, current, speed and the side of dry friction as recorded, (n,) each."""
    speed = columns["speed_rad_per_s"]
    return (
        _at_instants(columns["voltage_V"]),
        columns["current_A"],
        speed,
        np.sign(speed) * (np.abs(speed) > SLOW_RAD_S),
    )


def _matrices(values: Array) -> tuple[Array, Array]:
    r, inductance, k, jt, ft, cd = values
    a = np.array([[-r / inductance, -k / inductance], [k / jt, -ft / jt]])
    return a, np.array([[1 / inductance, 0.0], [0.0, -cd / jt]])


def _simulated(a: Array, b: Array, inputs: Array, period_s: float) -> Array:
    """Return the response (n, 2) of dx/dt = A x + B u from rest to inputs (n, 2) that are held between samples."""
    return _stepped(expm(np.block([[a, b], [np.zeros((2, 4))]]) * period_s), inputs)


def _stepped_plain(whole: Array, inputs: Array) -> Array:
    out = np.empty_like(inputs)
    i = w = 0.0
    for row in range(len(inputs)):
        out[row, 0], out[row, 1] = i, w
        u, side = inputs[row]
        i, w = (
            whole[0, 0] * i + whole[0, 1] * w + whole[0, 2] * u + whole[0, 3] * side,
            whole[1, 0] * i + whole[1, 1] * w + whole[1, 2] * u + whole[1, 3] * side,
        )
    return out


_stepped: Callable[[Array, Array], Array] = njit(cache=True, nogil=True)(_stepped_plain)


def output_error(columns: Columns, period_s: float) -> Found:
    """Output error by scipy's least squares: current and speed simulated from the voltage."""
    first = paper(columns, period_s)
    start = np.array([max(first[name], 1e-6) for name in NAMES])
    u, i, w, side = _raw(columns)
    inputs, seen = np.column_stack([u, side]), np.column_stack([i, w])
    scale = np.abs(seen).max(axis=0)

    def residual(logs: Array) -> Array:
        with np.errstate(all="ignore"):
            reported = _simulated(*_matrices(start * np.exp(np.clip(logs, -3, 3))), inputs, period_s)
        return np.nan_to_num(((reported - seen) / scale).ravel(), nan=1e3, posinf=1e3, neginf=-1e3)

    found = least_squares(residual, np.zeros(6), method="trf", loss="soft_l1", f_scale=0.02, max_nfev=12)
    return dict(zip(NAMES, map(float, start * np.exp(np.clip(found.x, -3, 3))), strict=True))


def _physical(a: Array, b: Array, c: Array, period_s: float) -> Found:
    """Return the parameters of a discrete model of order two whose outputs are current and speed."""
    a, b = c @ a @ np.linalg.inv(c), c @ b
    whole = logm(np.block([[a, b], [np.zeros((2, 2)), np.eye(2)]])).real / period_s
    a, b = whole[:2, :2], whole[:2, 2:]
    inductance = 1 / b[0, 0]
    k = -a[0, 1] * inductance
    jt = k / a[1, 0]
    return dict(
        zip(NAMES, map(float, (-a[0, 0] * inductance, inductance, k, jt, -a[1, 1] * jt, -b[1, 1] * jt)), strict=True)
    )


def sippy(columns: Columns, period_s: float) -> Found:
    """N4SID of SIPPY with voltage and the side of dry friction as inputs."""
    from sippy_unipi import system_identification

    u, i, w, side = _raw(columns)
    model = system_identification(
        np.vstack([i, w]), np.vstack([u, side]), "N4SID", SS_fixed_order=2, SS_f=20, tsample=period_s
    )
    return _physical(np.asarray(model.A), np.asarray(model.B), np.asarray(model.C), period_s)


def python_control(columns: Columns, period_s: float) -> Found:
    """Markov parameters and the eigensystem realisation of python-control."""
    import control

    u, i, w, side = _raw(columns)
    response = control.TimeResponseData(
        np.arange(u.size) * period_s, np.vstack([i, w]), None, np.vstack([u, side]), issiso=False
    )
    markov = np.asarray(control.markov(response, 60, dt=True, transpose=False))
    model, _ = control.eigensys_realization(markov, r=2, dt=period_s)
    return _physical(np.asarray(model.A), np.asarray(model.B), np.asarray(model.C), period_s)


METHODS: Mapping[str, tuple[str, Callable[[Columns, float], Found]]] = {
    "paper's least squares": ("numpy", paper),
    "scipy output error": ("scipy", output_error),
    "SIPPY N4SID": ("sippy_unipi", sippy),
    "python-control ERA": ("control", python_control),
}


def installed() -> dict[str, Callable[[Columns, float], Found]]:
    """Return the methods whose library is installed."""
    return {name: method for name, (library, method) in METHODS.items() if find_spec(library) is not None}
