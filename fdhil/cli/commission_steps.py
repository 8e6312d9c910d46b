"""What each step of a commissioning does and moves, in words: said before it, and all together by ``--dry-run``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fdhil.commissioning.progress import Progress
    from fdhil.commissioning.strokes import Room
    from fdhil.config import MachineConfig

STEPS: Mapping[str, str] = {
    "listen": "Listening: the NC must be off. A bus on which nothing is heard is asked whether the drive is there; "
    "nothing else is sent.",
    "compare": "Reading identity, PDO mapping, scale, option codes and following-error window, and comparing them with "
    "the config. Nothing moves.",
    "enable": "Starting SYNC and switching the drive on, held where it stands.",
    "sign test": "Moving the axis by +10 um with the offset 0x60B0: it must be held, added to the demand, and the "
    "position must follow, in this direction and by this much.",
    "feed-forward test": "Ramping the offset to and fro: does its slope reach the speed feed-forward? The correction "
    "depends on the answer.",
    "watchdog test": "Sending our heartbeat, then keeping it back: the drive must stop by itself, as it must when "
    "fdhil dies.",
    "restore": "Taking the offset to zero, switching the drive off and giving back what was changed.",
}
HAL_STEPS: Mapping[str, str] = {
    "listen": "Listening to the bridge: LinuxCNC must be on, homed and at rest.",
    "move": "Offsetting the axis: HAL must apply it within its limits, and command and table must follow.",
    "watchdog test": "Sending nothing more: HAL must bring the offset to zero by itself.",
}
FEEDFORWARD: Mapping[bool | None, str] = {
    True: "the speed feed-forward sees the offset",
    False: "the speed feed-forward does not see the offset",
    None: "whether the speed feed-forward sees the offset could not be told, and arming will be refused",
}
NOTHING = "nothing"


TRIAL: Mapping[str, str] = {
    "timing": "Starting SYNC, the drive switched off: how evenly does it come, and how soon does the drive answer?",
    "jog": "Switching the drive on and moving the axis slowly: its way, and the unit and sign of speed, current and "
    "voltage must be right.",
    "test rapids": "Moving the axis as fast as G0, and listening as the daemon does; while it accelerates the motor "
    "must take power.",
    "restore": "Switching the drive off and giving back what was changed.",
    "identification": "Identifying the drive from them.",
    "acceptance": "Comparing the last two with what the identified model predicts.",
}


def result_text(step: str, found: Mapping[str, Any]) -> str:
    """Return what a step found, in words."""
    match step:
        case "compare":
            return f"{found['points']} points agree with the configuration"
        case "sign test":
            return f"the axis moved by {found['moved_um']:+.1f} um"
        case "feed-forward test":
            return FEEDFORWARD[found["in_feedforward"]]
        case "room":
            return f"it stands at {found['stands']} and may go from {found['from']} to {found['to']}"
        case "identification":
            return ", ".join(f"{name} {_figure(name, value)}" for name, value in found.items())
        case "acceptance":
            return ", ".join(
                f"following error {move['measured_rms_um']:.2f} um RMS, predicted to {move['left_rms_um']:.2f}"
                for move in found["moves"]
            )
    return ", ".join(f"{name} {value}" for name, value in found.items())


def _figure(name: str, value: Mapping[str, Any]) -> str:
    from fdhil.records import INTERVAL_95
    from fdhil.report.parameter_view import DISPLAY, cell

    if value["std"] is None:
        return f"{value['value']:.4g} {value['unit']} (given, not identified)"
    return f"{cell(name, value['value'], INTERVAL_95 * value['std'], ' ')} {DISPLAY[name][0]}"


def tried_by_moving(machine: MachineConfig, axis: str) -> bool:
    """Whether an axis can be tried by moving it: not one of HAL pins, nor one drive of a gantry alone."""
    return machine.axis[axis].drive.source != "hal" and sum(name[0] == axis[0] for name in machine.axis) == 1


def moves_of(machine: MachineConfig, axis: str) -> dict[str, str]:
    """Return what each of the ``STEPS`` moves, of an axis of HAL pins each of the ``HAL_STEPS``."""
    if machine.axis[axis].drive.source == "hal":
        moved = "10 um toward plus, and 50 um where friction holds it"
        return {"listen": NOTHING, "move": moved, "watchdog test": "back to where it was"}
    from fdhil.commissioning.steps import RAMPS, SIGN_TEST_UM, largest_move_um

    largest = largest_move_um(machine, axis)
    return dict.fromkeys(STEPS, NOTHING) | {
        "enable": "nothing but what holding it takes",
        "sign test": f"{SIGN_TEST_UM:g} um toward plus and back, by the offset",
        "feed-forward test": f"{largest:.0f} um toward plus and back, by the offset, {RAMPS // 2} times",
        "watchdog test": "nothing; the drive stops by itself and is switched on again",
    }


def trial_moves(machine: MachineConfig, axis: str, room: Room | None) -> dict[str, str]:
    """Return what each step of the ``TRIAL`` moves, without a room in general; DriveFault where it is too small."""
    from fdhil.commissioning.strokes import plan_jog, plan_rapid, require_single_drive
    from fdhil.commissioning.trial import RAPIDS

    require_single_drive(machine, axis)
    settings = machine.axis[axis]
    if room is None:
        top = settings.shown(settings.rapid_speed_mm_s, "/s", "g")
        return dict.fromkeys(TRIAL, NOTHING) | {
            "jog": "a few millimetres within the room that you give, and back",
            "test rapids": f"within the room that you give at up to {top}, and back, {RAPIDS // 2} times",
        }
    jog, rapid = plan_jog(axis, settings, room), plan_rapid(axis, settings, room)
    steep = settings.shown(rapid.acceleration_mm_s2, "/s2", "g")
    return dict.fromkeys(TRIAL, NOTHING) | {
        "jog": f"{jog}, and back",
        "test rapids": f"{rapid} with {steep}, and back, {RAPIDS // 2} times",
    }


def planned(
    machine: MachineConfig, axis: str, room: Room | None, asks: bool, progress: Progress
) -> list[dict[str, Any]]:
    """Return all steps of an axis, what each does and moves, and when it was done if it was; nothing is sent.

    Without a ``room`` the axis is tried where the operator ``asks`` for it.
    """
    done = progress.done()
    hal = machine.axis[axis].drive.source == "hal"
    steps = [(HAL_STEPS if hal else STEPS, moves_of(machine, axis))]
    if not hal and (room is not None or (asks and tried_by_moving(machine, axis))):
        steps.append((TRIAL, trial_moves(machine, axis, room)))
    return [
        {"step": step, "does": texts[step], "moves": moved, "done_utc": done.get(step)}
        for texts, moves in steps
        for step, moved in moves.items()
    ]
