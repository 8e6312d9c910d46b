"""Co-ordinate systems: G54 to G59.3, G10 L2 and L20, G92, G52, tool length, and the homes of G28 and G30.

Offsets are stored in numbered parameters in machine millimetres, as the language requires: #5221 and on for G54, 20
numbers apart, with the rotation as the tenth; #5211 and on for G92, in force while #5210 is 1; #5161 and #5181 for the
homes.
"""

from __future__ import annotations

from fdhil.program.expressions import is_whole
from fdhil.program.modal_state import AXES, ModalState, rotate_point
from fdhil.program.motion_builder import MotionBuilder
from fdhil.program.parameters import ProgramVariables
from fdhil.program.targets import collect_axis_words, compute_target, convert_to_mm
from fdhil.program.words import Block

G92_IN_FORCE, G92_FIRST = 5210, 5211
HOME_FIRST = {280: 5161, 300: 5181}
_TABLE = (1, 10, 11)
SYSTEMS = {540: 1, 550: 2, 560: 3, 570: 4, 580: 5, 590: 6, 591: 7, 592: 8, 593: 9}
CODE_OF_SYSTEM = {system: code for code, system in SYSTEMS.items()}


def find_first_parameter(system: int) -> int:
    """Return the parameter number of a system's X offset."""
    return 5221 + 20 * (system - 1)


def select_system(modal: ModalState, variables: ProgramVariables, system: int) -> None:
    """Make G54 (1) to G59.3 (9) the active system: the tool stays in place and gets new co-ordinates."""
    if system == modal.system:
        return
    modal.system = system
    variables.store_number(5220, float(system))
    machine = modal.convert_all_to_machine()
    first = find_first_parameter(system)
    modal.g5x = [variables.get_numbered(first + axis) for axis in range(9)]
    modal.rotation_deg = variables.get_numbered(first + 9)
    modal.position = modal.convert_from_machine(machine)


def _apply_system_offsets(modal: ModalState, g5x: list[float], rotation_deg: float) -> None:
    """Apply other offsets to the active system; the reference rotates the co-ordinates without G92's share."""
    position = list(modal.position)
    position[0], position[1] = rotate_point(position[0], position[1], modal.rotation_deg)
    position = [p + old - new for p, old, new in zip(position, modal.g5x, g5x, strict=True)]
    position[0], position[1] = rotate_point(position[0], position[1], -rotation_deg)
    modal.position, modal.g5x, modal.rotation_deg = position, g5x, rotation_deg


def set_system_data(modal: ModalState, variables: ProgramVariables, block: Block) -> None:
    """G10: L2 sets a system's offsets, L20 sets them so that the tool's position has the given words.

    L1, L10 and L11 change the tool table, which moves nothing: fdhil parses them and has no table.
    """
    kind = block.words.get("l")
    if kind is None or round(kind) not in (*_TABLE, 2, 20) or not is_whole(kind):
        raise block.build_error(
            "l" if kind is not None else "G10", "is not supported; fdhil supports G10 L1, L2, L10, L11 and L20"
        )
    if round(kind) in _TABLE:
        if block.words.get("p", 0.0) < 1.0:
            raise block.build_error("G10", "needs the tool number as P, from 1")
        return
    for letter in "ij":
        if letter in block.words:
            raise block.build_error(letter, "belongs to a tool (L1, L10, L11), not to a co-ordinate system")
    number = int(block.words.get("p", -1.0))
    if not 0 <= number <= 9:
        raise block.build_error(
            "p", "is not a co-ordinate system; P must be 1 (G54) to 9 (G59.3), or 0 for the active one"
        )
    system = number or modal.system
    first = find_first_parameter(system)
    g5x = [variables.get_numbered(first + axis) for axis in range(9)]
    rotation_deg = variables.get_numbered(first + 9)
    words = {axis: convert_to_mm(modal, axis, value) for axis, value in collect_axis_words(block).items()}
    if round(kind) == 2:
        if "r" in block.words:
            rotation_deg = block.words["r"]
        for axis, value in words.items():
            g5x[axis] = value
    else:
        if "r" in block.words:
            raise block.build_error("r", "cannot be set with L20; use G10 L2")
        g5x = _compute_offsets(modal, g5x, rotation_deg, words)
    for axis, value in enumerate([*g5x, rotation_deg]):
        variables.store_number(first + axis, value)
    if system == modal.system:
        _apply_system_offsets(modal, g5x, rotation_deg)


def _compute_offsets(modal: ModalState, g5x: list[float], rotation_deg: float, words: dict[int, float]) -> list[float]:
    """Return the offsets that give the present point the co-ordinates ``words``; other axes keep theirs."""
    machine = modal.convert_all_to_machine()
    here = [m - o for m, o in zip(machine, g5x, strict=True)]
    here[0], here[1] = rotate_point(here[0], here[1], -rotation_deg)
    wanted = [words[axis] + modal.g92[axis] if axis in words else here[axis] for axis in range(9)]
    wanted[0], wanted[1] = rotate_point(wanted[0], wanted[1], rotation_deg)
    return [m - w for m, w in zip(machine, wanted, strict=True)]


def set_g92(modal: ModalState, variables: ProgramVariables, block: Block) -> None:
    """G92: the present point gets the given co-ordinates; G52: the words are the offset itself."""
    words = collect_axis_words(block)
    local = block.g["one-shot"] == 520
    if not words:
        raise block.build_error("G52" if local else "G92", "needs axis words")
    new = list(modal.g92)
    for axis, value in words.items():
        value = convert_to_mm(modal, axis, value)
        new[axis] = value if local else modal.position[axis] + modal.g92[axis] - value
    _put_g92(modal, new)
    for axis, value in enumerate(new):
        variables.store_number(G92_FIRST + axis, value)
    variables.store_number(G92_IN_FORCE, 1.0)


def drop_g92(modal: ModalState, variables: ProgramVariables, code: int) -> None:
    """G92.1 clears the offset, G92.2 suspends it, G92.3 restores it from its parameters."""
    if code == 923:
        _put_g92(modal, [variables.get_numbered(G92_FIRST + axis) for axis in range(9)])
        variables.store_number(G92_IN_FORCE, 1.0)
        return
    _put_g92(modal, [0.0] * 9)
    variables.store_number(G92_IN_FORCE, 0.0)
    if code == 921:
        for axis in range(9):
            variables.store_number(G92_FIRST + axis, 0.0)


def _put_g92(modal: ModalState, g92: list[float]) -> None:
    modal.position = [p + old - new for p, old, new in zip(modal.position, modal.g92, g92, strict=True)]
    modal.g92 = g92


def set_tool_length(modal: ModalState, block: Block) -> None:
    """G43.1 sets the tool's offsets; G43, G43.2 and G49 leave none, since fdhil has no tool table."""
    code = block.g["tool length"]
    if code == 432:
        if "h" not in block.words and not collect_axis_words(block):
            raise block.build_error("G43.2", "needs the tool number as H, or axis words")
        return
    words = {axis: convert_to_mm(modal, axis, value) for axis, value in collect_axis_words(block).items()}
    tool = [words.get(axis, modal.tool[axis]) if code == 431 else 0.0 for axis in range(9)]
    shift = [old - new for old, new in zip(modal.tool, tool, strict=True)]
    shift[0], shift[1] = rotate_point(shift[0], shift[1], -modal.rotation_deg)
    modal.position = [p + s for p, s in zip(modal.position, shift, strict=True)]
    modal.tool = tool


def go_home(machine: MotionBuilder, variables: ProgramVariables, block: Block) -> None:
    """G28, G30: move via the given words, then to the home of the named axes (of all if none is named)."""
    modal = machine.modal
    words = collect_axis_words(block)
    machine.move_rapid_to(block, compute_target(modal, block))
    first = HOME_FIRST[block.g["one-shot"]]
    home = [variables.get_numbered(first + axis) - modal.tool[axis] for axis in range(len(AXES))]
    there = modal.convert_from_machine(home)
    machine.move_rapid_to(block, [there[a] if not words or a in words else modal.position[a] for a in range(len(AXES))])


def store_home(modal: ModalState, variables: ProgramVariables, code: int) -> None:
    """G28.1, G30.1: store the present machine position as home."""
    for axis, value in enumerate(modal.convert_all_to_machine()):
        variables.store_number(HOME_FIRST[code - 1] + axis, value + modal.tool[axis])
