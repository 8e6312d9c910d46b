"""Identifies a drive's loops from its rapids: gains, feed-forward, filters, computing delay, structure.

The four gains of a cascade are fitted first; further keys are added one at a time, and other structures tried, while
each explains a tenth of the tolerance or of the residual. With full feed-forward and no filter, exchanging
position_gain_per_s and speed_ki / speed_kp changes nothing: the one nearer to the start is reported.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydantic import ValidationError

from fdhil.config import Axis, Identification, Regulators
from fdhil.identification.demand_lead import align_demand_to_drive
from fdhil.identification.drive_loops import loop_fit
from fdhil.identification.drive_loops.loop_fit import DELAY, KEYS, LoopFit, LoopProblem
from fdhil.identification.drive_loops.loop_replay import Rapid, adjust_loop_periods, extract_rapid, replace_regulators
from fdhil.identification.drive_loops.loop_start import CASCADE, create_placeholder_axis, search_start_grid
from fdhil.records import INTERVAL_95, LoopEstimate, Parameters, Reason, Verdict, Window, compute_rms, freeze_array

WORTH, WORTH_LEFT = 0.1, 0.1  # of the tolerance, or of the residual: least effect of another key
LEAST_UM = 0.02
WELL, NOTHING_UM = 0.25, 0.1  # of the tolerance, and in um: a smaller residual is complete
MOST_WINDOWS, MOST_TRIED = 4, 4
DIFFER = "LoopsDiffer"
LOOSE = 0.25  # relative standard deviation of an undetermined gain
PID = ("position_gain_per_s", "speed_feedforward", "speed_kp", "position_ki_per_s2")
SINGLE = ("speed_filter_s", "setpoint_filter_s", DELAY, "torque_feedforward", "position_ki_per_s2")
SINGLE_KEYS = tuple((name,) for name in SINGLE)
FILTERS = (("speed_filter_s", "setpoint_filter_s"),)  # they mask each other: neither alone explains much


@dataclass(frozen=True, slots=True)
class GainDifference:
    """One key of the regulators as configured and as identified."""

    key: str
    configured: float
    found: float
    std: float

    @property
    def is_significant(self) -> bool:
        """Whether the configured value lies outside the 95 % interval of the identified one."""
        return abs(self.found - self.configured) > INTERVAL_95 * self.std


def identify_loops(
    windows: Sequence[Window],
    mechanics: Sequence[Parameters],
    axis: Axis | None,
    settings: Identification,
    sync_period_s: float | None = None,
    *,
    growing: bool = True,
) -> LoopEstimate | None:
    """Return the loops of the drive that fitted the rapids; None where no window has demand, position and current.

    ``mechanics`` are the parameters identified from each window, ``axis`` is the machine's section; without it the
    search starts from the demand alone. Set-points come every ``sync_period_s`` (default: every sample). Without
    ``growing`` only the configured keys are fitted, which is fast.
    """
    if axis is not None and axis.regulators.structure == "linuxcnc_pid":
        return None  # its gains are those of the HAL files, and no other structure is equivalent
    on_time = [align_demand_to_drive(window, axis, sync_period_s)[0] for window in windows[-MOST_WINDOWS:]]
    pairs = list(zip(on_time, mechanics[-MOST_WINDOWS:], strict=True))
    usable = [(rapid, own) for w, own in pairs if (rapid := extract_rapid(w, own, sync_period_s)) is not None]
    if not usable:
        return None
    rapids = tuple(rapid for rapid, _ in usable)
    following = compute_rms(np.concatenate([one.lag_mm[one.known] for one in rapids])) * 1e3
    tolerance = settings.compute_tolerance_um(following)
    problem = _build_problem(rapids, axis, windows[0])
    modelled = tuple(replace(rapid, plant=own, load_nm=np.zeros_like(rapid.load_nm)) for rapid, own in usable)
    kinds = [replace(problem, rapids=r) for r in (rapids, modelled)]
    if growing:
        found = _round_delay(_fit_with_or_without_load(problem, modelled, tolerance, axis is not None))
    else:
        fits = [loop_fit.fit_loops(kind) for kind in kinds]
        found = _round_delay(min(fits, key=lambda fitted: fitted.unexplained_um))
    residuals_mm = (
        loop_fit.compute_rms(kind, loop_fit.compute_loop_residuals(kind, kind.read_coordinates())[0])[0]
        for kind in kinds
    )
    configured = None if axis is None else float(min(residuals_mm)) * 1e3
    verdict = _assess_loops(found, tolerance, following, configured)
    return _build_loop_estimate(windows[0].axis, found, verdict, configured)


def _fit_with_or_without_load(
    problem: LoopProblem, modelled: tuple[Rapid, ...], tolerance_um: float, configured: bool
) -> LoopFit:
    """Return the best fit with or without unexplained torque as a load; searched again where the other is better.

    A complete model fits better without the noise in that torque. The search uses one rapid of either direction, the
    final fit uses all.
    """
    few = _select_both_directions(problem.rapids)
    kinds = [problem.rapids, modelled]
    begun = [loop_fit.fit_loops(replace(problem, rapids=tuple(rapids[j] for j in few))) for rapids in kinds]
    if begun[1].deviance < begun[0].deviance:
        kinds, begun = kinds[::-1], begun[::-1]
    found = _select_structure(begun[0], tolerance_um, configured)
    ends = [loop_fit.fit_loops(replace(found.problem, rapids=rapids), found.coordinates) for rapids in kinds]
    if ends[0].deviance <= ends[1].deviance:
        return ends[0]
    other = loop_fit.fit_loops(replace(begun[1].problem, axis=ends[1].build_axis(), names=ends[1].problem.names))
    again = _select_structure(other, tolerance_um, configured)
    return loop_fit.fit_loops(replace(again.problem, rapids=kinds[1]), again.coordinates)


def _select_both_directions(rapids: Sequence[Rapid]) -> list[int]:
    ways = [float(np.sign(rapid.demand_mm[-1] - rapid.demand_mm[0])) for rapid in rapids]
    return [j for side in (-1.0, 1.0) for j in [k for k, way in enumerate(ways) if way == side][-1:]] or [0]


def _build_problem(rapids: tuple[Rapid, ...], axis: Axis | None, window: Window) -> LoopProblem:
    if axis is None:
        return search_start_grid(LoopProblem(rapids, create_placeholder_axis(window, rapids[-1]), CASCADE))
    axis = replace_regulators(axis, **adjust_loop_periods(axis.regulators, rapids[0].dt_s))
    return LoopProblem(rapids, axis, _list_keys(axis.regulators))


def _list_keys(regulators: Regulators) -> tuple[str, ...]:
    base: tuple[str, ...] = PID if regulators.structure == "pid" else CASCADE
    if base == CASCADE and regulators.speed_ki == 0.0:
        base = CASCADE[:3]
    return (*base, *(n for n in SINGLE if n not in base and getattr(regulators, n) > 0))


def _select_structure(begun: LoopFit, tolerance_um: float, configured: bool) -> LoopFit:
    best = _add_keys(begun, tolerance_um)
    if configured and best.unexplained_um > tolerance_um:  # the configuration may be a bad start
        best = min(
            best,
            _add_keys(loop_fit.fit_loops(search_start_grid(begun.problem)), tolerance_um),
            key=lambda f: f.unexplained_um,
        )
    if best.problem.names == CASCADE and subtract_rounding_um(best) < compute_sufficient_residual_um(tolerance_um):
        return best
    other = _convert_structure(best)
    if other is not None:
        rival = _add_keys(loop_fit.fit_loops(other), tolerance_um)
        if best.unexplained_um - rival.unexplained_um > compute_required_gain_um(best, tolerance_um):
            return rival
    return best


def _add_keys(fitted: LoopFit, tolerance_um: float) -> LoopFit:
    begun = fitted.problem.names
    while subtract_rounding_um(fitted) > compute_sufficient_residual_um(tolerance_um):
        options = [option for option in (*SINGLE_KEYS, *FILTERS) if not {*option} & {*fitted.problem.names}]
        starts = loop_fit.rank_extensions(fitted, options)[:MOST_TRIED] if options else []
        fits = (loop_fit.fit_loops(start.problem, start.coordinates) for start in starts)
        grown = min(fits, key=lambda f: f.deviance, default=fitted)
        if not fitted.unexplained_um - grown.unexplained_um > compute_required_gain_um(fitted, tolerance_um):
            break
        fitted = grown
    return _remove_redundant_keys(fitted, [name for name in fitted.problem.names if name not in begun], tolerance_um)


def _remove_redundant_keys(fitted: LoopFit, added: Sequence[str], tolerance_um: float) -> LoopFit:
    for name in added if len(added) > 1 else ():
        problem, place = fitted.problem, fitted.problem.names.index(name)
        names = tuple(other for other in problem.names if other != name)
        fewer = replace(problem, axis=replace_regulators(problem.axis, **{name: 0}), names=names)
        without = loop_fit.fit_loops(fewer, np.delete(fitted.coordinates, place))
        if without.unexplained_um - fitted.unexplained_um <= compute_required_gain_um(without, tolerance_um):
            fitted = without
    return fitted


def subtract_rounding_um(fitted: LoopFit) -> float:
    """Return the residual of the position beyond the rounding of its recording."""
    rounding = max(rapid.resolution_mm for rapid in fitted.problem.rapids) * 1e3
    return math.sqrt(max(fitted.unexplained_um**2 - rounding**2 / 12, 0.0))


def compute_sufficient_residual_um(tolerance_um: float) -> float:
    """Return the residual below which the model is complete."""
    return min(NOTHING_UM, WELL * tolerance_um)


def compute_required_gain_um(fitted: LoopFit, tolerance_um: float) -> float:
    """Return by how much another key, or another structure, must lower the residual of this fit."""
    return max(LEAST_UM, min(WORTH * tolerance_um, WORTH_LEFT * fitted.unexplained_um))


def _convert_structure(fitted: LoopFit) -> LoopProblem | None:
    """Return the other structure, started at its nearest equivalent: a cascade is a PID except for a filter."""
    problem = fitted.problem
    found = fitted.build_axis()
    g = found.regulators
    keep = tuple(n for n in problem.names if n in SINGLE and n not in ("speed_filter_s", "position_ki_per_s2"))
    if g.structure == "pid":
        half = g.position_gain_per_s / 2
        rest = max(half * half - g.position_ki_per_s2, 0.0)
        outer = half - math.sqrt(rest)
        axis = replace_regulators(
            found,
            structure="p_pi_pi",
            position_gain_per_s=outer,
            speed_ki=g.speed_kp * (half + math.sqrt(rest)),
            position_ki_per_s2=0.0,
        )
        return replace(problem, axis=axis, names=(*CASCADE, *keep))
    slow = g.speed_ki / g.speed_kp
    axis = replace_regulators(
        found,
        structure="pid",
        position_gain_per_s=g.position_gain_per_s + slow,
        position_ki_per_s2=g.position_gain_per_s * slow + g.position_ki_per_s2,
        speed_ki=0.0,
        speed_filter_s=0.0,
    )
    return replace(problem, axis=axis, names=(*PID, *keep))


def _round_delay(fitted: LoopFit) -> LoopFit:
    problem = fitted.problem
    if DELAY not in problem.names:
        return fitted
    place = problem.names.index(DELAY)
    cycles = round(fitted.coordinates[place])
    axis = replace_regulators(problem.axis, **{DELAY: cycles})
    fewer = replace(problem, axis=axis, names=tuple(n for n in problem.names if n != DELAY))
    again = loop_fit.fit_loops(fewer, np.delete(fitted.coordinates, place))
    return replace(again, problem=replace(problem, axis=axis), coordinates=np.insert(again.coordinates, place, cycles))


def _build_loop_estimate(name: str, fitted: LoopFit, verdict: Verdict, configured_um: float | None) -> LoopEstimate:
    names = fitted.problem.names
    values = fitted.values
    slope = [KEYS[n].scale or v for n, v in values.items()]
    covariance = loop_fit.estimate_covariance(fitted) * np.outer(slope, slope)
    structure = fitted.problem.axis.regulators.structure
    if structure != "pid":
        structure = "double_pi" if values.get("position_ki_per_s2", 0.0) > 0.0 else "p_pi_pi"
    return LoopEstimate(
        name, structure, names, freeze_array([*values.values()]), freeze_array(covariance), verdict, configured_um
    )


def _assess_loops(fitted: LoopFit, tolerance_um: float, following_um: float, configured_um: float | None) -> Verdict:
    residual_um = fitted.unexplained_um
    reasons, warnings = [], []
    if not residual_um <= tolerance_um:
        text = f"the best loops leave {residual_um:.3g} um of a following error of {following_um:.3g} um unexplained"
        advice = (
            "the drive has an unknown structure or filter; check its regulators, or raise identification.tolerance_um"
        )
        reasons.append(Reason("LoopsUnexplained", f"{text}, more than {tolerance_um:.3g} um", advice))
    elif configured_um is not None and configured_um - residual_um > WORTH * tolerance_um:
        text = f"the configured regulators leave {configured_um:.3g} um of a following error of {following_um:.3g} um"
        advice = "write the identified values to [axis.X.regulators]"
        warnings.append(Reason(DIFFER, f"{text}, the identified ones {residual_um:.3g} um", advice))
    doubts = np.sqrt(np.diag(loop_fit.estimate_covariance(fitted)))
    for n, doubt in zip(fitted.problem.names, doubts, strict=True):
        if KEYS[n].scale == 0.0 and doubt > LOOSE:
            text = f"the standard deviation of {n} is {100 * doubt:.0f} %, limit {100 * LOOSE:.0f} %"
            warnings.append(Reason("LoopsUndetermined", text, "record rapids with a higher acceleration"))
    return Verdict(not reasons, None, tuple(reasons), residual_um, tuple(warnings))


def is_better_than_configured(loops: LoopEstimate) -> bool:
    """Return whether the loops are accepted and fit better than the configured ones, so that they are used instead.

    Values that no configuration may have are rejected: they come from a demand that the drive did not follow.
    """
    differ = any(warning.code == DIFFER for warning in loops.verdict.warnings)
    return loops.verdict.accepted and differ and _is_configurable(loops)


def _is_configurable(loops: LoopEstimate) -> bool:
    others = dict.fromkeys(name for name, field in Regulators.model_fields.items() if field.is_required())
    try:
        Regulators.model_validate({**dict.fromkeys(others, 1.0), **get_regulator_values(loops)})
    except ValidationError:
        return False
    return True


def apply_loops(axis: Axis, loops: LoopEstimate) -> Axis:
    """Return the axis with the identified regulators."""
    values = {**axis.regulators.model_dump(), **get_regulator_values(loops)}
    return axis.model_copy(update={"regulators": Regulators.model_validate(values)})


def get_regulator_values(loops: LoopEstimate) -> dict[str, Any]:
    """Return the identified keys of ``[axis.X.regulators]``; keys that the structure lacks are 0."""
    lacks = {"pid": ("speed_ki", "speed_filter_s"), "p_pi_pi": ("position_ki_per_s2",)}.get(loops.structure, ())
    found = dict(zip(loops.names, loops.values.tolist(), strict=True))
    return {"structure": loops.structure, **found, **dict.fromkeys(lacks, 0.0)}


def find_changed_regulators(configured: Axis, used: Axis) -> dict[str, Any]:
    """Return the keys of ``[axis.X.regulators]`` whose used value differs from the configured one."""
    before = configured.regulators.model_dump()
    return {key: value for key, value in used.regulators.model_dump().items() if value != before[key]}


def compare_with_configuration(axis: Axis, loops: LoopEstimate) -> list[GainDifference]:
    """Return each identified key with its configured value."""
    spread = np.sqrt(np.diag(loops.covariance))
    return [
        GainDifference(name, float(getattr(axis.regulators, name)), float(value), float(std))
        for name, value, std in zip(loops.names, loops.values, spread, strict=True)
    ]
