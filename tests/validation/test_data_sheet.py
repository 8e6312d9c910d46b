"""A gain that is wrong throughout shows in no recording, only against the data sheet."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from fdhil.cli.main import cli
from fdhil.config import Identification
from fdhil.identification.rapid_windows import find_windows
from fdhil.pipeline import analyse
from fdhil.records import PARAMETERS, Estimate, Parameters, Result, freeze_array
from fdhil.store.recording_csv import parse_recording
from fdhil.validation.data_sheet import TOLERANCE, gain_error, scale_convention
from studies import bench
from tests.bench import bench_toml
from tests.identification.bench_recordings import simulate_bench_shuttle

NOMINAL = Parameters(0.5, 0.005, 0.8, 0.075, 0.05, 5.0)
COLUMN = {"voltage": 1, "current": 2, "speed": 3}


def estimate(**factors: float) -> Estimate:
    """Return the data sheet's values as an estimate, each times its factor, known to 0.1 %."""
    values = np.array([getattr(NOMINAL, name) * factors.get(name, 1.0) for name in PARAMETERS])
    return Estimate("any", PARAMETERS, freeze_array(values), freeze_array(np.diag((1e-3 * values) ** 2)), {}, Result.OK)


def scaled(text: str, signal: str, gain: float) -> str:
    lines = []
    for line in text.splitlines():
        cells = line.split(",")
        if cells[0][:1].isdigit():
            cells[COLUMN[signal]] = repr(float(cells[COLUMN[signal]]) * gain)
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n"


@pytest.fixture(scope="module")
def shuttle() -> str:
    return bench.as_csv(simulate_bench_shuttle(moves=2), 0.003)


def test_the_scales_of_the_model_are_what_an_identification_finds(shuttle: str) -> None:
    from fdhil.validation.agreement import GAINS

    def fitted(text: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        found = analyse(find_windows(parse_recording(text))[0], Identification()).estimate
        assert found is not None
        return np.log([found.get_value(name) for name in PARAMETERS])

    true = fitted(shuttle)
    for signal in ("voltage", "current"):
        assert (fitted(scaled(shuttle, signal, 1.2)) - true) / np.log(1.2) == pytest.approx(GAINS[signal], abs=0.05)


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("signal", ["voltage", "current"])
def test_identify_refuses_a_column_times_1_2_where_the_data_sheet_is_known(
    signal: str, shuttle: str, tmp_path: Path
) -> None:
    (tmp_path / "m.toml").write_text(bench_toml())
    files = {"as it was.csv": shuttle, "times 1.2.csv": scaled(shuttle, signal, 1.2)}
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    given_config = ["--config", str(tmp_path / "m.toml")]
    names = [str(tmp_path / name) for name in files]
    result = CliRunner().invoke(cli, ["identify", *names, *given_config, "--json"], standalone_mode=False)
    assert result.return_value == 1
    good, bad = (told["pooled"] for told in json.loads(result.stdout)["files"])
    assert good["validated"] is True
    assert bad["validated"] is False
    (reason,) = bad["reasons"]
    assert reason.startswith(f"CalibrationSuspect: the {signal} is read 1.20 times as large as it is")
    # without the data sheet nothing can be seen, and nothing is said
    blind = CliRunner().invoke(cli, ["identify", names[1], "--json"], standalone_mode=False)
    assert blind.return_value == 0


def test_a_speed_times_1_2_contradicts_the_position_and_needs_no_data_sheet(shuttle: str) -> None:
    reasons = analyse(find_windows(parse_recording(scaled(shuttle, "speed", 1.2)))[0], Identification()).verdict.reasons
    assert any(reason.code == "CalibrationSuspect" for reason in reasons)


@pytest.mark.parametrize(
    ("factors", "signal", "gain"),
    [
        ({"R": 1.2, "L": 1.2, "K": 1.2, "Jt": 1.2}, "voltage", "1.20"),
        ({"R": 1 / 1.2, "L": 1 / 1.2, "Jt": 1.2}, "current", "1.20"),
        ({"R": 2**0.5, "L": 2**0.5, "Jt": 2**-0.5}, "current", "0.71"),  # amplitudes for effective values
        ({"K": 1 / 1.2, "Jt": 1 / 1.44}, "speed", "1.20"),
        ({"R": 1.3, "L": 1.1, "K": 1.25, "Jt": 1.15}, "voltage", "1.2"),
    ],
)
def test_the_signal_and_its_gain_are_named(factors: dict[str, float], signal: str, gain: str) -> None:
    reason = gain_error(estimate(**factors), NOMINAL)
    assert reason is not None
    assert f"the {signal} is read {gain}" in reason.text


@pytest.mark.parametrize(
    "factors",
    [
        {"R": 1.4},  # a warm winding
        {"Jt": 1.5},  # another load
        {"L": 0.7},  # a saturated core
        {"K": 0.8},  # weak magnets
        {"R": 1.39, "Jt": 1.5},  # warm and loaded
        {"R": 0.67, "L": 0.62, "K": 0.7, "Jt": 0.275},  # another machine
        {"ft": 3.0, "Cd": 0.2},
    ],
)
def test_what_no_gain_explains_is_not_called_one(factors: dict[str, float]) -> None:
    assert gain_error(estimate(**factors), NOMINAL) is None


WITHIN = st.floats(1 / (1 + TOLERANCE), 1 + TOLERANCE)


@given(WITHIN, WITHIN, WITHIN, WITHIN, st.floats(0.2, 5.0), st.floats(0.2, 5.0), st.floats(1.0, 1.5))
def test_a_drive_within_the_tolerance_is_never_refused_cold_or_warm(
    R: float, L: float, K: float, Jt: float, ft: float, Cd: float, warm: float
) -> None:
    assert gain_error(estimate(R=R * warm, L=L, K=K, Jt=Jt, ft=ft, Cd=Cd), NOMINAL) is None


def test_a_coarse_estimate_or_one_without_r_and_l_says_nothing() -> None:
    found = estimate(R=1.2, L=1.2, K=1.2, Jt=1.2)
    coarse = replace(found, covariance=freeze_array(np.diag((0.3 * found.values) ** 2)))
    assert gain_error(coarse, NOMINAL) is None
    values = found.values.copy()
    values[:3] = np.nan
    assert gain_error(replace(found, values=freeze_array(values)), NOMINAL) is None


@pytest.mark.parametrize("share", [2 / 3, 1.5, 1 / 3])
def test_scale_of_three_phase_values_is_named(share: float) -> None:
    found = scale_convention(estimate(R=1.1, L=0.9, K=share, Jt=1.05 * share, ft=share, Cd=share), NOMINAL)
    assert found is not None
    assert f"{share:.3g} times what they are" in found.text


@pytest.mark.parametrize("factors", [{}, {"K": 0.667}, {"K": 0.667, "Jt": 0.667, "R": 0.667}, {"K": 0.8, "Jt": 0.8}])
def test_other_differences_from_the_data_sheet_are_no_scale(factors: dict[str, float]) -> None:
    assert scale_convention(estimate(**factors), NOMINAL) is None
