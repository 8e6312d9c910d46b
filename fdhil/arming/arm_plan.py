"""Prepares a checked program for the guard: its first rows, its predicted gain, and the facts that the daemon attests.

Pure except for reading the program and the commissioning records; a refusal is a value (:class:`Refused`).
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fdhil.arming.checked_program import FIRST_S, CheckedProgram, RowStream, TablePiece
from fdhil.arming.first_block import FirstBlock
from fdhil.arming.model_tracker import SKILL_MOVES, AxisModelState
from fdhil.arming.program_check import plan_reference_blocks
from fdhil.arming.standstill_monitor import StandstillState
from fdhil.commissioning import (
    INVALID_COB_ID,
    CommissioningRecord,
    extract_cob_id,
    format_rpdo_key,
    is_record_valid,
    load_record,
)
from fdhil.config import MachineConfig
from fdhil.correction import check_held_out_error, check_writing_enabled, derive_feedforward_law
from fdhil.drivers import load_profile
from fdhil.identification import get_regulator_values
from fdhil.model import add_resonance
from fdhil.prediction import (
    CorrectionGain,
    add_held_out_um,
    combine_held_out_um,
    find_largest_error_um,
    find_worst_rms_um,
    load_validated_models,
)
from fdhil.program import compute_program_digest
from fdhil.records import Parameters, Reason, Skill

MODEL_AGE_S = 8 * 3600.0  # a shift: older parameters describe another state of the machine
MODEL_KELVIN = 3.0
SKILL_SHARE = 0.5  # of the predicted gain, within which the last moves must be predicted (FAULTS E19)
AHEAD_S = 60.0  # of a program that must have passed before it is armed while its check runs
UNGUARDED_UM = 20.0  # the largest offset that may remain in a drive whose watchdog on the guard is not proven


@dataclass(frozen=True, slots=True)
class ArmRequest:
    """A program that may be corrected, and its models; ``ahead``: its rows are checked ahead of the motion.

    ``config`` is the machine's, with the identified regulators.
    """

    program: Path
    program_digest: str
    models: Mapping[str, Parameters]
    config: MachineConfig
    method: str | None = None
    ahead: bool = False


@dataclass(frozen=True, slots=True)
class ArmPlan:
    """A correction ready for the guard: its first rows, the stream of rows that passed or will pass, and the facts.

    ``armed_gain_um`` is the gain predicted for the rows that were checked at arming, ``half_um`` half the 95 % interval
    of
    the residual error, and ``left_um`` the RMS error in held-out moves (None: unknown). ``first`` recomputes the first
    rows for the axes' actual standstill.
    """

    program: str
    stream: RowStream
    first_piece: TablePiece
    facts: dict[str, bool]
    armed_gain_um: float
    half_um: float | None = None
    held_out_um: float | None = None
    first_block: FirstBlock | None = None

    @property
    def row_count(self) -> int | None:
        """The program's row count; None until it is known."""
        return self.stream.checked.row_count if self.stream.checked.is_complete else None

    @property
    def predicted_gain(self) -> CorrectionGain:
        """The predicted gain of the rows checked so far, with the error of held-out moves."""
        errors = self.stream.checked.errors
        after_um = add_held_out_um(errors["after"]["rms_um"], self.held_out_um)
        return CorrectionGain(errors["before"]["rms_um"], after_um, self.half_um)

    def collect_facts(self, config: MachineConfig, known: Mapping[str, AxisModelState]) -> dict[str, bool]:
        """Return the facts that may be withdrawn while it runs; the gain is the whole program's once it is known."""
        checked = self.stream.checked
        return collect_model_facts(
            self.stream.axes, config, known, checked.gain_um if checked.is_complete else self.armed_gain_um
        )

    def report_progress(self) -> dict[str, Any]:
        return {"check": self.stream.report_progress()}

    def summarise(self) -> dict[str, Any]:
        """Return the operator's summary; errors and rows are those checked so far."""
        checked, predicted = self.stream.checked, self.predicted_gain
        return {
            "program": self.program,
            "program_digest": self.stream.program_digest,
            "method": checked.method,
            "rows": checked.row_count,
            "streamed": not self.first_piece.final,
            "before": dict(checked.errors["before"]),
            "after": {**checked.errors["after"], "rms_um": predicted.after_um, "uncertainty_um": self.half_um},
            "promise": f"contour error {predicted.before_um:.1f} um RMS is predicted to become {predicted}",
            **self.report_progress(),
            "warnings": [str(reason) for reason in checked.warnings],
            "facts": dict(self.facts),
        }


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why nothing is armed, the most important reason first."""

    reasons: tuple[Reason, ...]


def prepare_request(
    program: Path, method: str | None, config: MachineConfig, known: Mapping[str, AxisModelState]
) -> ArmRequest | Refusal:
    """Collect the newest validated parameters for a program, and determine whether it is checked ahead of the motion.

    Raises ProgramError, RecordingError or ConfigError if the program cannot be used.
    """
    found = collect_models(tuple(config.axis), config, known)
    if isinstance(found, Refusal):
        return found
    models = {axis: add_resonance(model, config.axis[axis]) for axis, model in found[0].items()}
    digest = compute_program_digest(program)
    ahead = method in (None, "inverse") and _is_longer_than_ring(program, config, digest)
    if ahead and (
        off := check_writing_enabled(list(config.axis), config)
        or check_held_out_error(compute_largest_um(known, models))
    ):
        return Refusal(off)
    return ArmRequest(program, digest, models, found[1], method, ahead)


def compute_largest_um(known: Mapping[str, AxisModelState], axes: Iterable[str]) -> float | None:
    """Return the largest error (um) of several axes together in the last moves; None if an axis has none."""
    return combine_held_out_um(find_largest_error_um({axis: known[axis].skills for axis in axes}), tuple(axes))


def collect_models(
    axes: Sequence[str], config: MachineConfig, known: Mapping[str, AxisModelState]
) -> tuple[dict[str, Parameters], MachineConfig] | Refusal:
    """Return the newest validated models of several axes, and the configuration with the loops that belong to them.

    Raises ConfigError if their loops are unknown for this configuration.
    """
    sets = {}
    for name in axes:
        axis = known[name]
        if axis.published is None:
            return _refuse_unvalidated(name)
        sets[name] = axis.published
        if axis.loops is not None:  # found by this daemon, with this configuration
            sets[name] = replace(axis.published, loops=get_regulator_values(axis.loops), config_digest=config.digest)
    return load_validated_models(sets, config, "the identified loops")


def _refuse_unvalidated(axis: str) -> Refusal:
    text = f"axis {axis} has no validated parameters yet"
    return Refusal((Reason("ModelNotValidated", text, "run a few rapids of this axis"),))


def _is_longer_than_ring(program: Path, config: MachineConfig, sha256: str) -> bool:
    rows = 0
    for block in plan_reference_blocks(program, config, sha256):
        rows += block.time_s.size
        if rows * config.machine.sync_period_s > FIRST_S:
            return True
    return False


def may_arm_ahead(checked: CheckedProgram, config: MachineConfig, known: Mapping[str, AxisModelState]) -> bool:
    """Return whether a program may be armed while its check runs: far enough ahead, and no fact can still fail.

    The largest offset and the gain, which the rest of the check could change, must already suffice. Raises StoreError
    for a damaged commissioning record.
    """
    if checked.row_count * config.machine.sync_period_s < AHEAD_S:
        return False
    axes = checked.axes
    certain = collect_model_facts(axes, config, known, checked.gain_um) | _collect_commissioning_facts(
        axes, checked.largest_um, config
    )
    return certain == collect_model_facts(axes, config, known, math.inf) | _collect_commissioning_facts(
        axes, 0.0, config
    )


def prepare_program(
    request: ArmRequest,
    checked: CheckedProgram,
    config: MachineConfig,
    known: Mapping[str, AxisModelState],
    rest: Mapping[str, StandstillState] | None = None,
) -> ArmPlan:
    """Prepare a checked program with the rows that it is armed with; the first begin where the axes ``rest``.

    Raises StoreError if the rows cannot be read.
    """
    stream, gain_um = RowStream(checked, request.program_digest, config.machine.sync_period_s), checked.gain_um
    facts = collect_model_facts(stream.axes, config, known, gain_um)
    facts |= _collect_commissioning_facts(stream.axes, checked.largest_um, config)
    left_um = combine_held_out_um(find_worst_rms_um({axis: found.skills for axis, found in known.items()}), stream.axes)
    half_um = left_um if checked.half_um is None else checked.half_um
    begin, first = stream.take_rows(FIRST_S), None
    if checked.method == "inverse":
        first = FirstBlock(begin, request.program, request.models, request.config, request.program_digest)
        if (rows := first.predict_rows(rest or {})) is not None:
            first.apply_rows(rows)
        begin = first.begin
    return ArmPlan(str(request.program), stream, begin, facts, gain_um, half_um, left_um, first)


@dataclass(frozen=True, slots=True)
class FeedforwardPlan:
    """The on-line feed-forward ready for the guard: the law of each axis, and the facts."""

    laws: Mapping[str, Mapping[str, Any]]
    facts: dict[str, bool]

    def collect_facts(self, config: MachineConfig, known: Mapping[str, AxisModelState]) -> dict[str, bool]:
        return collect_feedforward_facts(tuple(self.laws), config, known)

    def report_progress(self) -> dict[str, Any]:
        return {}

    def summarise(self) -> dict[str, Any]:
        return {"program": None, "method": "flatness", "axes": list(self.laws), "facts": dict(self.facts)}


def prepare_feedforward(config: MachineConfig, known: Mapping[str, AxisModelState]) -> FeedforwardPlan | Refusal:
    """Derive the on-line law of every axis from its newest validated parameters. StoreError for a damaged record."""
    axes = [name for name, axis in config.axis.items() if axis.correction is not None]
    for name in axes:
        if config.axis[name].feedforward is None:
            text = f"axis {name} has no section [axis.{name}.feedforward]: its speed and torque offsets are off"
            return Refusal(
                (Reason("FeedforwardOff", text, "add the section with its limits, then run fdhil commission"),)
            )
    found = collect_models(axes, config, known)
    if isinstance(found, Refusal):
        return found
    models, own = found
    laws = {name: derive_feedforward_law(models[name], own.axis[name], own.machine.sync_period_s) for name in axes}
    records = _read_records(axes, config)
    facts = collect_feedforward_facts(axes, config, known) | {
        "commissioned": all(is_record_valid(record, config, axis) for axis, record in records.items()),
        "feedforward_commissioned": all(
            _has_feedforward_rpdo(record, config, name) for name, record in records.items()
        ),
        "model_validated": True,
        "watchdog_proven": _is_watchdog_proven(records),
    }
    return FeedforwardPlan(laws, facts)


def collect_feedforward_facts(
    axes: Sequence[str], config: MachineConfig, known: Mapping[str, AxisModelState]
) -> dict[str, bool]:
    """Return the facts about the models that may be withdrawn while the feed-forward runs."""
    return {"model_fresh": all(_is_fresh(known[axis], config) for axis in axes)}


def _has_feedforward_rpdo(record: CommissioningRecord | None, config: MachineConfig, axis: str) -> bool:
    profile = load_profile(config.axis[axis].drive)
    found = profile.find_rpdo(profile.speed_offset)
    if record is None or found is None:
        return False
    cob_id = record.options.get(format_rpdo_key(found[0].number), INVALID_COB_ID)
    return not cob_id & INVALID_COB_ID and extract_cob_id(cob_id) == found[0].cob_base + config.get_node_id(axis)


def collect_model_facts(
    axes: Sequence[str], config: MachineConfig, known: Mapping[str, AxisModelState], gain_um: float
) -> dict[str, bool]:
    """Return the facts about the models that may be withdrawn while a correction runs."""
    return {
        "model_validated": all(known[axis].published is not None for axis in axes),
        "model_fresh": all(_is_fresh(known[axis], config) for axis in axes),
        "skill_enough": all(_is_predicted_well(known[axis].skills, gain_um) for axis in axes),
        "gain_positive": gain_um > 0.0,
    }


def _is_fresh(axis: AxisModelState, config: MachineConfig) -> bool:
    """The model belongs to the machine as it is: same configuration and load, recent, at a similar temperature."""
    published = axis.published
    if published is None or published.config_digest != config.digest or axis.load_changed:
        return False
    if not 0.0 <= axis.age_s <= MODEL_AGE_S:
        return False
    if published.temperature_c is None or axis.temperature_c is None:
        return True
    return abs(axis.temperature_c - published.temperature_c) <= MODEL_KELVIN


def _is_predicted_well(skills: Sequence[Skill], gain_um: float) -> bool:
    """The last recorded moves were predicted within half of the predicted gain; without moves nothing is known."""
    last = list(skills)[-SKILL_MOVES:]
    return bool(last) and all(skill.rms_um <= SKILL_SHARE * gain_um for skill in last)


def _collect_commissioning_facts(axes: Sequence[str], largest_um: float, config: MachineConfig) -> dict[str, bool]:
    records = _read_records(axes, config)
    return {
        "commissioned": all(is_record_valid(record, config, axis) for axis, record in records.items()),
        # the plans assume that the drive's feed-forward includes the offset; others would get worse
        "offset_in_feedforward_known": all(r is not None and r.offset_in_feedforward is True for r in records.values()),
        "watchdog_proven": largest_um <= UNGUARDED_UM or _is_watchdog_proven(records),
    }


Records = Mapping[str, CommissioningRecord | None]


def _read_records(axes: Sequence[str], config: MachineConfig) -> Records:
    """Read the axes' records; if the daemon may not read the key, the guard verifies the seal."""
    store = config.store
    return {axis: load_record(store.directory, axis, store.commissioning_key, may_lack_key=True) for axis in axes}


def _is_watchdog_proven(records: Records) -> bool:
    return all(r is not None and r.watchdog == "proven" for r in records.values())
