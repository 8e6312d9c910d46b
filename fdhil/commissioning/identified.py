"""Identifies an axis from test rapids as the daemon would, and compares the last of them with the model. Pure."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from fdhil.config import Identification, MachineConfig
from fdhil.errors import DriveFault
from fdhil.identification.delay import delay_score
from fdhil.identification.estimators.maximum_likelihood import fit_windows
from fdhil.pipeline import AxisPipeline, Known, Record
from fdhil.records import PARAMETERS, Outcome, ParameterSet, Skill, WindowOutcome, unit_of

ACCEPTANCE_MOVES = 2
LEFT_SHARE = 0.25  # of the measured following error, which the prediction may be off
LEFT_INCREMENTS = 2.0  # and what a position cannot tell


def identify(config: MachineConfig, axis: str, records: Sequence[Record], known: Known | None = None) -> list[Outcome]:
    """Return what the daemon's own pipeline makes of these records."""
    pipeline = AxisPipeline(axis, config, known=known)
    return [outcome for record in records for outcome in pipeline.feed(record)]


@dataclass(frozen=True, slots=True)
class Rapids:
    """What came of the test rapids: the windows, the set that was published from them, and the last moves' skills."""

    axis: str
    windows: tuple[WindowOutcome, ...]
    published: ParameterSet
    skills: tuple[Skill, ...]

    @property
    def parameters(self) -> dict[str, Any]:
        """Value, standard deviation (None: the data sheet's, it was not identified) and unit of each parameter."""
        values, deviations = self.published.parameters.as_dict(), self.published.covariance.diagonal().tolist()
        return {
            name: {"value": values[name], "std": math.sqrt(variance) if variance > 0.0 else None, "unit": unit_of(name)}
            for name, variance in zip(PARAMETERS, deviations, strict=False)
        }


def judge(axis: str, outcomes: Sequence[Outcome]) -> Rapids:
    """Return what the rapids identified; DriveFault with the reason where they are not believed."""
    windows = tuple(o for o in outcomes if isinstance(o, WindowOutcome))
    published = [o for o in outcomes if isinstance(o, ParameterSet)]
    device = f"drive {axis}"
    if not windows:
        text = "none of the test rapids was seen as one"
        raise DriveFault(device, f"{text}; check that its TPDOs come, and rapid_speed_mm_s and max_acceleration_mm_s2")
    if not published:
        reasons = [reason for window in windows for reason in window.verdict.reasons]
        told = f" ({reasons[0]}); {reasons[0].advice}" if reasons else "; look at its windows with fdhil history"
        raise DriveFault(device, f"the test rapids are not believed{told}")
    return Rapids(axis, windows, published[-1], tuple(o for o in outcomes if isinstance(o, Skill))[-ACCEPTANCE_MOVES:])


def voltage_late(config: MachineConfig, rapids: Rapids) -> dict[str, Any]:
    """Return by how much the voltage is late against the current (early: negative), ms, and the standard deviation.

    One of more than a sample has refused the windows already (SampleTiming); {} without a voltage.
    """
    told = [found for window in rapids.windows if (found := _late_s(window, config.identification)) is not None]
    if not told:
        return {}
    late_s, std_s = (sum(column) / len(told) for column in zip(*told, strict=True))
    return {"voltage_late_ms": round(late_s * 1e3, 4), "std_ms": round(std_s * 1e3 / math.sqrt(len(told)), 4)}


def _late_s(outcome: WindowOutcome, settings: Identification) -> tuple[float, float] | None:
    estimate = outcome.estimate
    if estimate is not None and estimate.delay_s is not None and estimate.delay_std_s is not None:
        return estimate.delay_s, estimate.delay_std_s
    if not outcome.verdict.accepted or outcome.window.voltage_v is None:
        return None
    fit = fit_windows([outcome.window], settings)
    return None if fit is None else delay_score(fit)


def accept(config: MachineConfig, rapids: Rapids) -> dict[str, Any]:
    """Return how well the last moves were predicted; DriveFault where a prediction is off too much."""
    settings = config.axis[rapids.axis]
    found = [
        {"left_rms_um": round(s.rms_um, 3), "measured_rms_um": round(s.measured_rms_um, 3), "delay_ms": s.delay_ms}
        for s in rapids.skills
    ]
    least_um = LEFT_INCREMENTS / settings.scaling.increments_per_mm * 1e3
    for skill in rapids.skills:
        if not skill.rms_um <= max(LEFT_SHARE * skill.measured_rms_um, least_um):
            text = (
                f"its following error is predicted to {skill.rms_um:.2g} um where {skill.measured_rms_um:.2g} um were "
                f"measured ({skill.delay_ms:+.2g} ms late)"
            )
            advice = "enter the drive's own gains in [axis.*.regulators], and its setpoint_delay_cycles; fdhil check"
            raise DriveFault(f"drive {rapids.axis}", f"{text}; {advice}")
    return {"moves": found}
