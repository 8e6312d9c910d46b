"""Identify an axis from test rapids as the daemon would, and compare the last ones with the model's prediction."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from fdhil.config import Identification, MachineConfig
from fdhil.errors import DriveFault
from fdhil.identification import fit_windows, score_delay
from fdhil.pipeline import AxisPipeline, PipelineState, Record
from fdhil.records import PARAMETERS, Outcome, ParameterSet, Skill, WindowOutcome, get_unit

ACCEPTANCE_MOVES = 2
LEFT_SHARE = 0.25  # largest prediction error, as a share of the measured following error
LEFT_INCREMENTS = 2.0  # resolution of the position


def identify_from_records(
    config: MachineConfig, axis: str, records: Sequence[Record], known: PipelineState | None = None
) -> list[Outcome]:
    """Return the outcomes of the daemon's own pipeline for these records."""
    pipeline = AxisPipeline(axis, config, known=known)
    return [outcome for record in records for outcome in pipeline.process_record(record)]


@dataclass(frozen=True, slots=True)
class RapidResults:
    """Results of the test rapids: windows, the published parameter set, and the skill of the last moves."""

    axis: str
    windows: tuple[WindowOutcome, ...]
    published: ParameterSet
    skills: tuple[Skill, ...]

    @property
    def parameters(self) -> dict[str, Any]:
        """Value, standard deviation (None: from the data sheet, not identified) and unit of each parameter."""
        values, deviations = self.published.parameters.as_dict(), self.published.covariance.diagonal().tolist()
        return {
            name: {
                "value": values[name],
                "std": math.sqrt(variance) if variance > 0.0 else None,
                "unit": get_unit(name),
            }
            for name, variance in zip(PARAMETERS, deviations, strict=False)
        }


def assess_rapids(axis: str, outcomes: Sequence[Outcome]) -> RapidResults:
    """Return what the rapids identified; DriveFault with the reason if they were not accepted."""
    windows = tuple(o for o in outcomes if isinstance(o, WindowOutcome))
    published = [o for o in outcomes if isinstance(o, ParameterSet)]
    device = f"drive {axis}"
    if not windows:
        text = "none of the test rapids was recognised"
        raise DriveFault(
            device, f"{text}; check that its TPDOs are received, then rapid_speed_mm_s and max_acceleration_mm_s2"
        )
    if not published:
        reasons = [reason for window in windows for reason in window.verdict.reasons]
        shown = f" ({reasons[0]}); {reasons[0].advice}" if reasons else "; list its windows with fdhil history"
        raise DriveFault(device, f"the test rapids were not accepted{shown}")
    return RapidResults(
        axis, windows, published[-1], tuple(o for o in outcomes if isinstance(o, Skill))[-ACCEPTANCE_MOVES:]
    )


def estimate_voltage_delay(config: MachineConfig, rapids: RapidResults) -> dict[str, Any]:
    """Return the delay of the voltage against the current (early: negative) in ms, and its standard deviation.

    A delay of more than one sample has already rejected the windows (SampleTiming); {} without a voltage.
    """
    delays = [
        found for window in rapids.windows if (found := _estimate_delay_s(window, config.identification)) is not None
    ]
    if not delays:
        return {}
    late_s, std_s = (sum(column) / len(delays) for column in zip(*delays, strict=True))
    return {"voltage_late_ms": round(late_s * 1e3, 4), "std_ms": round(std_s * 1e3 / math.sqrt(len(delays)), 4)}


def _estimate_delay_s(outcome: WindowOutcome, settings: Identification) -> tuple[float, float] | None:
    estimate = outcome.estimate
    if estimate is not None and estimate.delay_s is not None and estimate.delay_std_s is not None:
        return estimate.delay_s, estimate.delay_std_s
    if not outcome.verdict.accepted or outcome.window.voltage_v is None:
        return None
    fit = fit_windows([outcome.window], settings)
    return None if fit is None else score_delay(fit)


def accept_prediction(config: MachineConfig, rapids: RapidResults) -> dict[str, Any]:
    """Return how well the last moves were predicted; DriveFault if a prediction error is too large."""
    settings = config.axis[rapids.axis]
    found = [
        {"left_rms_um": round(s.rms_um, 3), "measured_rms_um": round(s.measured_rms_um, 3), "delay_ms": s.delay_ms}
        for s in rapids.skills
    ]
    least_um = LEFT_INCREMENTS / settings.scaling.increments_per_mm * 1e3
    for skill in rapids.skills:
        if not skill.rms_um <= max(LEFT_SHARE * skill.measured_rms_um, least_um):
            text = (
                f"its predicted following error is off by {skill.rms_um:.2g} um, of {skill.measured_rms_um:.2g} um "
                f"measured ({skill.delay_ms:+.2g} ms late)"
            )
            advice = (
                "enter the drive's gains in [axis.*.regulators] and its setpoint_delay_cycles, then run fdhil check"
            )
            raise DriveFault(f"drive {rapids.axis}", f"{text}; {advice}")
    return {"moves": found}
