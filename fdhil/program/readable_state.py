"""The machine's state as a program reads it (#5420, #<_feed> and others), and its saving by M70 to M73."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from fdhil.program.coordinate_systems import CODE_OF_SYSTEM, G92_IN_FORCE, drop_g92, select_system
from fdhil.program.modal_state import AXES, PLANE_CODES, ModalState
from fdhil.program.parameters import ProgramVariables

Reading = Callable[[], float]
# saved by M70: the modes, without position and active motion
_KEPT = (
    "scale", "plane", "absolute", "arc_absolute", "diameter", "feed_mode", "feed_word", "feed_mm_min", "spindle_rpm",
    "spindle_turns", "surface_speed", "flood", "mist", "feed_override", "speed_override", "adaptive_feed", "feed_hold",
    "retract_to_r", "path_control", "path_tolerance_mm", "joining_mm", "system",
)  # fmt: skip


def build_numbered_readings(modal: ModalState) -> Mapping[int, Reading]:
    """Return the numbered parameters of the machine's state: #5420 to #5428, the controlled point."""
    fixed = {5400 + index: (lambda: 0.0) for index in range(14)}
    return {**fixed, **{5420 + index: _build_position_reading(modal, index) for index in range(9)}}


def build_named_readings(
    modal: ModalState, line: Callable[[], int], depth: Callable[[], int], value: Callable[[], float | None]
) -> Mapping[str, Reading]:
    """Return the named parameters of the machine's state; a flag is 1 or 0."""
    readings: dict[str, Reading] = {
        "_metric": lambda: modal.scale == 1.0,
        "_imperial": lambda: modal.scale != 1.0,
        "_absolute": lambda: modal.absolute,
        "_incremental": lambda: not modal.absolute,
        "_inverse_time": lambda: modal.feed_mode == 930,
        "_units_per_minute": lambda: modal.feed_mode == 940,
        "_units_per_rev": lambda: modal.feed_mode == 950,
        "_retract_r_plane": lambda: modal.retract_to_r,
        "_retract_old_z": lambda: not modal.retract_to_r,
        "_spindle_rpm_mode": lambda: not modal.surface_speed,
        "_spindle_css_mode": lambda: modal.surface_speed,
        "_ijk_absolute_mode": lambda: modal.arc_absolute,
        "_lathe_diameter_mode": lambda: modal.diameter,
        "_lathe_radius_mode": lambda: not modal.diameter,
        "_spindle_on": lambda: modal.spindle_turns != 0,
        "_spindle_cw": lambda: modal.spindle_turns > 0,
        "_tool_offset": lambda: any(modal.tool),
        "_value_returned": lambda: value() is not None,
        "_line": line,
        "_call_level": depth,
        "_motion_mode": lambda: modal.motion,
        "_plane": lambda: PLANE_CODES[modal.plane],
        "_ccomp": lambda: modal.compensation,
        "_coord_system": lambda: CODE_OF_SYSTEM[modal.system],
        "_feed": lambda: modal.feed_word,
        "_rpm": lambda: modal.spindle_rpm,
        "_value": lambda: value() or 0.0,
        "_vmajor": lambda: 2.9,
        "_current_pocket": lambda: 1.0,
        "_selected_pocket": lambda: -1.0,
    }
    for name in ("_vminor", "_task", "_remap_level", "_current_tool", "_selected_tool"):
        readings[name] = lambda: 0.0
    for switch in ("flood", "mist", "feed_override", "speed_override", "adaptive_feed", "feed_hold"):
        readings[f"_{switch}"] = partial(getattr, modal, switch)
    for index, letter in enumerate(AXES):
        readings[f"_{letter}"] = _build_position_reading(modal, index)
        readings[f"_abs_{letter}"] = _build_machine_reading(modal, index)
    return readings


def _build_position_reading(modal: ModalState, index: int) -> Reading:
    return lambda: modal.position[index] / modal.get_unit(index)


def _build_machine_reading(modal: ModalState, index: int) -> Reading:
    return lambda: (modal.convert_all_to_machine()[index] + modal.tool[index]) / modal.get_unit(index)


@dataclass(frozen=True)
class _SavedValues:
    values: Mapping[str, Any]
    g92_in_force: bool
    restore_on_return: bool


class SavedModes:
    """Modes saved by M70 per call level; M71 discards them, M72 restores them, M73 does so at the call's end."""

    def __init__(self, modal: ModalState, variables: ProgramVariables) -> None:
        self._modal = modal
        self._variables = variables
        self._kept: dict[int, _SavedValues] = {}

    def execute_code(self, code: int, level: int) -> bool:
        """Execute one of the four codes; False if M72 has nothing to restore."""
        if code in (70, 73):
            values = {name: getattr(self._modal, name) for name in _KEPT}
            self._kept[level] = _SavedValues(values, self._variables.get_numbered(G92_IN_FORCE) == 1.0, code == 73)
        elif code == 71:
            self._kept.pop(level, None)
        elif level not in self._kept:
            return False
        else:
            self._restore_modes(self._kept[level])
        return True

    def copy_state(self) -> object:
        """Return a copy of the saved modes."""
        return dict(self._kept)

    def end_call(self, level: int) -> None:
        """Restore the modes saved by M73 at the end of a call of this level."""
        kept = self._kept.pop(level, None)
        if kept is not None and kept.restore_on_return:
            self._restore_modes(kept)

    def _restore_modes(self, kept: _SavedValues) -> None:
        for name, value in kept.values.items():
            if name == "system":
                select_system(self._modal, self._variables, value)
            else:
                setattr(self._modal, name, value)
        drop_g92(self._modal, self._variables, 923 if kept.g92_in_force else 922)
