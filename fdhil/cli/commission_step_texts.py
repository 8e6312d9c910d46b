"""Texts of the commissioning steps: effect, motion and result of each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fdhil.commissioning import StepProgress, TravelRoom
    from fdhil.config import MachineConfig

STEPS: Mapping[str, str] = {
    "listen": "Listening: the NC must be off. On a silent bus the drive is queried; nothing else is sent.",
    "compare": "Reading identity, PDO mapping, scale, option codes and following-error window, and comparing them with "
    "the configuration.",
    "enable": "Starting SYNC and switching the drive on at its present position.",
    "sign test": "Moving the axis by +10 um with the offset 0x60B0: the drive must accept it and add it to the demand, "
    "and the position must follow in direction and size.",
    "feed-forward test": "Ramping the offset back and forward to determine whether its slope reaches the speed "
    "feed-forward; the correction depends on it.",
    "watchdog test": "Sending our heartbeat, then withholding it: the drive must stop by itself, as if fdhil failed.",
    "restore": "Ramping the offset to zero, switching the drive off and restoring what was changed.",
}
HAL_STEPS: Mapping[str, str] = {
    "listen": "Listening to the bridge: LinuxCNC must be on, homed and at standstill.",
    "move": "Offsetting the axis: HAL must apply it within its limits, and command and table must follow.",
    "watchdog test": "Withholding all commands: HAL must ramp the offset to zero by itself.",
}
FEEDFORWARD: Mapping[bool | None, str] = {
    True: "the speed feed-forward includes the offset",
    False: "the speed feed-forward does not include the offset",
    None: "whether the speed feed-forward includes the offset is undetermined, and arming will be refused",
}
NOTHING = "nothing"


TRIAL: Mapping[str, str] = {
    "timing": "Starting SYNC with the drive off, to measure the jitter of SYNC and the answer time of the drive.",
    "jog": "Switching the drive on and moving the axis slowly: distance, and unit and sign of speed, current and "
    "voltage must be right.",
    "test rapids": "Moving the axis at rapid speed and recording as the daemon does; the motor must draw power during "
    "acceleration.",
    "restore": "Switching the drive off and restoring what was changed.",
    "identification": "Identifying the drive from these rapids.",
    "acceptance": "Comparing the last two rapids with the prediction of the identified model.",
}


def format_result(step: str, found: Mapping[str, Any]) -> str:
    """Return the result of a step as text."""
    match step:
        case "compare":
            return f"{found['points']} points agree with the configuration"
        case "sign test":
            return f"the axis moved by {found['moved_um']:+.1f} um"
        case "feed-forward test":
            return FEEDFORWARD[found["in_feedforward"]]
        case "room":
            return f"position {found['stands']}, allowed travel from {found['from']} to {found['to']}"
        case "identification":
            return ", ".join(f"{name} {_format_parameter(name, value)}" for name, value in found.items())
        case "acceptance":
            return ", ".join(
                f"following error {move['measured_rms_um']:.2f} um RMS, predicted to {move['left_rms_um']:.2f}"
                for move in found["moves"]
            )
    return ", ".join(f"{name} {value}" for name, value in found.items())


def _format_parameter(name: str, value: Mapping[str, Any]) -> str:
    from fdhil.records import INTERVAL_95
    from fdhil.report import DISPLAY_UNITS, format_cell

    if value["std"] is None:
        return f"{value['value']:.4g} {value['unit']} (given, not identified)"
    return f"{format_cell(name, value['value'], INTERVAL_95 * value['std'], ' ')} {DISPLAY_UNITS[name][0]}"


def can_run_trial(machine: MachineConfig, axis: str) -> bool:
    """Return whether a trial can move an axis: not an axis of HAL pins, and not a single drive of a gantry."""
    return machine.axis[axis].drive.source != "hal" and sum(name[0] == axis[0] for name in machine.axis) == 1


def describe_motions(machine: MachineConfig, axis: str) -> dict[str, str]:
    """Return the motion of each of the ``STEPS``, or of the ``HAL_STEPS`` for an axis of HAL pins."""
    if machine.axis[axis].drive.source == "hal":
        moved = "10 um toward plus, or 50 um if friction holds it"
        return {"listen": NOTHING, "move": moved, "watchdog test": "back to where it was"}
    from fdhil.commissioning import SIGN_TEST_UM, TRIAL_RAMPS, compute_largest_move_um

    largest = compute_largest_move_um(machine, axis)
    return dict.fromkeys(STEPS, NOTHING) | {
        "enable": "nothing, except to hold the position",
        "sign test": f"{SIGN_TEST_UM:g} um toward plus and back, by the offset",
        "feed-forward test": f"{largest:.0f} um toward plus and back, by the offset, {TRIAL_RAMPS // 2} times",
        "watchdog test": "nothing; the drive stops by itself and is switched on again",
    }


def describe_trial_motions(machine: MachineConfig, axis: str, room: TravelRoom | None) -> dict[str, str]:
    """Return the motion of each step of the ``TRIAL``. Raises DriveFault if the room is too small."""
    from fdhil.commissioning import TRIAL_RAPIDS, plan_jog, plan_rapid, require_single_drive

    require_single_drive(machine, axis)
    settings = machine.axis[axis]
    if room is None:
        top = settings.format_in_unit(settings.rapid_speed_mm_s, "/s", "g")
        return dict.fromkeys(TRIAL, NOTHING) | {
            "jog": "a few millimetres within the room that you allow, and back",
            "test rapids": f"within the room that you allow at up to {top}, and back, {TRIAL_RAPIDS // 2} times",
        }
    jog, rapid = plan_jog(axis, settings, room), plan_rapid(axis, settings, room)
    steep = settings.format_in_unit(rapid.acceleration_mm_s2, "/s2", "g")
    return dict.fromkeys(TRIAL, NOTHING) | {
        "jog": f"{jog}, and back",
        "test rapids": f"{rapid} with {steep}, and back, {TRIAL_RAPIDS // 2} times",
    }


def list_planned_steps(
    machine: MachineConfig, axis: str, room: TravelRoom | None, asks: bool, progress: StepProgress
) -> list[dict[str, Any]]:
    """Return all steps of an axis with effect, motion and, if completed, time. Sends nothing.

    Without a ``room`` the trial is included if ``asks``, because the operator will be asked for it.
    """
    done = progress.list_step_times()
    hal = machine.axis[axis].drive.source == "hal"
    steps = [(HAL_STEPS if hal else STEPS, describe_motions(machine, axis))]
    if not hal and (room is not None or (asks and can_run_trial(machine, axis))):
        steps.append((TRIAL, describe_trial_motions(machine, axis, room)))
    return [
        {"step": step, "does": texts[step], "moves": moved, "done_utc": done.get(step)}
        for texts, moves in steps
        for step, moved in moves.items()
    ]
