"""Set the modes of a block: feed, spindle, units, plane, distances, cutter compensation; and the dwell."""

from __future__ import annotations

from fdhil.program import arcs, roughing, splines
from fdhil.program.cutter_compensation import CutterCompensation
from fdhil.program.expressions import is_whole
from fdhil.program.modal_state import MM_PER_INCH, NO_MOTION, PLANE_CODES, ModalState
from fdhil.program.motion_builder import MotionBuilder
from fdhil.program.words import Block, format_g_word


def set_feed(modal: ModalState, block: Block) -> None:
    if "feed mode" in block.g:
        if block.g["feed mode"] != 930 or modal.feed_mode == 950:  # G93 keeps the feed, for splines
            modal.feed_mm_min = 0.0
        modal.feed_mode = block.g["feed mode"]
        modal.feed_word = 0.0
    if "f" in block.words:
        feed = block.words["f"]
        if feed < 0.0:
            raise block.build_error("f", "is a negative feed rate")
        modal.feed_word = feed
        if modal.feed_mode != 930:
            modal.feed_mm_min = feed * modal.scale


def set_spindle(modal: ModalState, block: Block) -> None:
    if "s" in block.words:
        if block.words["s"] < 0.0:
            raise block.build_error("s", "is a negative spindle speed; M4 turns it backwards")
        modal.spindle_rpm = block.words["s"]
    if "spindle mode" in block.g:
        modal.surface_speed = block.g["spindle mode"] == 960
    if block.g.get("spindle mode") == 960 and "s" not in block.words:
        raise block.build_error("G96", "constant surface speed needs the speed as S")
    if "spindle" in block.m:
        modal.spindle_turns = {3: 1, 4: -1}.get(block.m["spindle"], 0)


_NO_DWELL = -1.0
_OVERRIDES = {50: "feed_override", 51: "speed_override", 52: "adaptive_feed", 53: "feed_hold"}


def set_switches(modal: ModalState, block: Block) -> None:
    """Switch coolant (M7 to M9) and the operator's overrides (M48 to M53): parsed, without effect on motions."""
    coolant, override = block.m.get("coolant"), block.m.get("overrides")
    if coolant is not None:
        modal.mist = coolant == 7 or (modal.mist and coolant != 9)
        modal.flood = coolant == 8 or (modal.flood and coolant != 9)
    if override in (48, 49):
        modal.feed_override = modal.speed_override = override == 48
    elif override is not None:
        setattr(modal, _OVERRIDES[override], block.words.get("p", 1.0) != 0.0)


def order_dwell(machine: MotionBuilder, block: Block) -> None:
    """G4: as LinuxCNC, treat a missing P as P-1, and end any other negative dwell at once."""
    seconds = block.words.get("p", _NO_DWELL)
    if seconds == _NO_DWELL:
        raise block.build_error("G4", "a dwell needs its seconds as P, not negative")
    machine.add_dwell(block, max(0.0, seconds))


def set_units(modal: ModalState, block: Block) -> None:
    if "lathe diameter" in block.g:
        modal.diameter = block.g["lathe diameter"] == 70
    if "plane" in block.g:
        modal.plane = PLANE_CODES.index(block.g["plane"])
    if "units" in block.g:
        before, modal.scale = modal.scale, MM_PER_INCH if block.g["units"] == 200 else 1.0
        # the reference keeps the numbers of a tool's offsets, so their meaning changes with the units
        modal.tool = [t * modal.scale / before if axis not in (3, 4, 5) else t for axis, t in enumerate(modal.tool)]


def set_distance(modal: ModalState, block: Block) -> None:
    g = block.g
    if "path control" in g:
        modal.path_control = g["path control"]
        modal.path_tolerance_mm = block.words.get("p", 0.0) * modal.scale
        modal.joining_mm = block.words.get("q", block.words.get("p", 0.0)) * modal.scale
    if "distance" in g:
        modal.absolute = g["distance"] == 900
    if "arc distance" in g:
        modal.arc_absolute = g["arc distance"] == 901
    if "return" in g:
        modal.retract_to_r = g["return"] == 990


_GROUPS_REFUSED = ("co-ordinate system", "tool length", "machine co-ordinates", "path control")
_ORIGINS = (280, 281, 300, 301, 520, 920, 923)


def check_compensated(modal: ModalState, block: Block) -> None:
    """Raise ProgramError for codes that are not allowed with cutter compensation on."""
    g, m = block.g, block.m
    refused = [format_g_word(g[group]) for group in _GROUPS_REFUSED if group in g]
    if g.get("plane", PLANE_CODES[modal.plane]) != PLANE_CODES[modal.plane]:
        refused.append(format_g_word(g["plane"]))
    if g.get("one-shot") in _ORIGINS:
        refused.append(format_g_word(g["one-shot"]))
    sets_system = g.get("one-shot") == 100 and block.words.get("l") in (2.0, 20.0)
    if sets_system and int(block.words.get("p", 0.0)) in (0, modal.system):
        refused.append("G10")
    refused += [f"M{m[group]}" for group in ("signals", "overrides") if group in m]
    if m.get("tool") == 6:
        refused.append("M6")
    motion = g.get("motion", modal.motion)
    if motion not in (0, 10, *arcs.CODES, splines.NURBS_BEGIN, roughing.FINISH, NO_MOTION):
        refused.append(format_g_word(motion))
    if refused:
        raise block.build_error(refused[0], "cannot be used with cutter compensation on; end it by G40 first")


def switch_compensation(machine: MotionBuilder, block: Block, tool: bool) -> None:
    """G40 switches cutter compensation off, G41 (left) and G42 (right) on; the .1 forms have the diameter as D.

    ``tool``: a tool was changed in, whose radius is unknown, since fdhil has no tool table.
    """
    modal, code = machine.modal, block.g["cutter compensation"]
    modal.compensation = code
    if code == 400:
        machine.end_compensation()
        return
    if machine.compensation is not None:
        raise block.build_error(format_g_word(code), "compensation is already on; end it by G40 first")
    diameter = block.words.get("d")
    if modal.plane >= 2:
        what = f"does not work in the {modal.plane_name} plane; use G17 or G18"
        raise block.build_error(format_g_word(code), what)
    if code % 10 == 0:
        if diameter or tool:
            what = "fdhil has no tool table, so the radius is unknown; use G41.1 or G42.1 with the diameter as D"
            raise block.build_error(format_g_word(code), what)
        diameter = 0.0
    if diameter is None:
        raise block.build_error(format_g_word(code), "needs the tool's diameter as D")
    radius = diameter / 2.0 * modal.scale
    side = (1 if code in (410, 411) else -1) * (1 if radius >= 0.0 else -1)
    machine.compensation = CutterCompensation(abs(radius), side, _read_tool_orientation(modal, block))


def _read_tool_orientation(modal: ModalState, block: Block) -> int:
    """Return L of G41.1 and G42.1: the position of a turning tool's tip relative to the centre of its nose."""
    value = block.words.get("l", 0.0)
    if value < 0.0 or not is_whole(value) or (value and modal.plane != 1):
        raise block.build_error("l", "is not a valid tool orientation; L must be 0 to 9, in the XZ plane (G18)")
    return round(value)
