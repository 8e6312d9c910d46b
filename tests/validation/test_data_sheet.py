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
from fdhil.pipeline import analyse_window
from fdhil.records import PARAMETERS, Estimate, Parameters, Result, freeze_array
from fdhil.store.recording_csv import parse_recording
from fdhil.validation.data_sheet import TOLERANCE, detect_gain_error, detect_scale_convention
from studies import bench
from tests.bench import bench_toml
from tests.identification.bench_recordings import simulate_bench_shuttle

NOMINAL = Parameters(0.5, 0.005, 0.8, 0.075, 0.05, 5.0)
COLUMN = {"voltage": 1, "current": 2, "speed": 3}


def make_estimate(**factors: float) -> Estimate:
    """Return the data sheet's values as an estimate, each times its factor, known to 0.1 %."""
    values = np.array([getattr(NOMINAL, name) * factors.get(name, 1.0) for name in PARAMETERS])
    return Estimate("any", PARAMETERS, freeze_array(values), freeze_array(np.diag((1e-3 * values) ** 2)), {}, Result.OK)


def scale_signal(text: str, signal: str, gain: float) -> str:
    lines = []
    for line in text.splitlines():
        cells = line.split(",")
        if cells[0][:1].isdigit():
            cells[COLUMN[signal]] = repr(float(cells[COLUMN[signal]]) * gain)
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n"


@pytest.fixture(scope="module")
def shuttle_recording() -> str:
    return bench.format_as_csv(simulate_bench_shuttle(moves=2), 0.003)


def test_identified_parameters_scale_with_signal_gain(shuttle_recording: str) -> None:
    from fdhil.validation.estimate_agreement import GAINS

    def fit_values(text: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        found = analyse_window(find_windows(parse_recording(text))[0], Identification()).estimate
        assert found is not None
        return np.log([found.get_value(name) for name in PARAMETERS])

    true = fit_values(shuttle_recording)
    for signal in ("voltage", "current"):
        assert (fit_values(scale_signal(shuttle_recording, signal, 1.2)) - true) / np.log(1.2) == pytest.approx(
            GAINS[signal], abs=0.05
        )


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("signal", ["voltage", "current"])
def test_identify_refuses_scaled_column_with_data_sheet(signal: str, shuttle_recording: str, tmp_path: Path) -> None:
    (tmp_path / "m.toml").write_text(bench_toml())
    files = {"as it was.csv": shuttle_recording, "times 1.2.csv": scale_signal(shuttle_recording, signal, 1.2)}
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


def test_scaled_speed_contradicts_position_without_data_sheet(shuttle_recording: str) -> None:
    reasons = analyse_window(
        find_windows(parse_recording(scale_signal(shuttle_recording, "speed", 1.2)))[0], Identification()
    ).verdict.reasons
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
def test_gain_error_names_signal_and_gain(factors: dict[str, float], signal: str, gain: str) -> None:
    reason = detect_gain_error(make_estimate(**factors), NOMINAL)
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
def test_difference_no_gain_explains_is_not_reported(factors: dict[str, float]) -> None:
    assert detect_gain_error(make_estimate(**factors), NOMINAL) is None


WITHIN = st.floats(1 / (1 + TOLERANCE), 1 + TOLERANCE)


@given(WITHIN, WITHIN, WITHIN, WITHIN, st.floats(0.2, 5.0), st.floats(0.2, 5.0), st.floats(1.0, 1.5))
def test_drive_within_tolerance_is_accepted_cold_or_warm(
    R: float, L: float, K: float, Jt: float, ft: float, Cd: float, warm: float
) -> None:
    assert detect_gain_error(make_estimate(R=R * warm, L=L, K=K, Jt=Jt, ft=ft, Cd=Cd), NOMINAL) is None


def test_coarse_or_incomplete_estimate_yields_no_gain_error() -> None:
    found = make_estimate(R=1.2, L=1.2, K=1.2, Jt=1.2)
    coarse = replace(found, covariance=freeze_array(np.diag((0.3 * found.values) ** 2)))
    assert detect_gain_error(coarse, NOMINAL) is None
    values = found.values.copy()
    values[:3] = np.nan
    assert detect_gain_error(replace(found, values=freeze_array(values)), NOMINAL) is None


@pytest.mark.parametrize("share", [2 / 3, 1.5, 1 / 3])
def test_three_phase_scale_convention_is_named(share: float) -> None:
    found = detect_scale_convention(make_estimate(R=1.1, L=0.9, K=share, Jt=1.05 * share, ft=share, Cd=share), NOMINAL)
    assert found is not None
    assert f"{share:.3g} times what they are" in found.text


@pytest.mark.parametrize("factors", [{}, {"K": 0.667}, {"K": 0.667, "Jt": 0.667, "R": 0.667}, {"K": 0.8, "Jt": 0.8}])
def test_other_differences_yield_no_scale_convention(factors: dict[str, float]) -> None:
    assert detect_scale_convention(make_estimate(**factors), NOMINAL) is None
