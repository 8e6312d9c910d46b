"""Write the HAL file that adds offsets between LinuxCNC's motion controller and the drives, and loads the bridges.

    streamer -> limit3 -> offset, between joint.N.motor-pos-cmd and the pins it commanded; the joint's feedback less it
    heartbeat of the bridge -> oneshot, motion.motion-enabled, streamer not empty -> lut5 -> limit3.enable

Only HAL's own components run in the servo thread. ``limit3`` bounds size, speed and acceleration of every offset, and
ramps it to zero when the bridge is silent, the streamer is empty or the machine is off. Pure.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap

from fdhil.bridges import hal_bus, linuxcnc
from fdhil.commissioning.init.linuxcnc_text import HalNetlist
from fdhil.config import MachineConfig, OffsetBounds
from fdhil.errors import ConfigError, ConfigFault

WATCHDOG_S = 0.05  # beyond the lead
ALL_THREE = 0x8  # lut5: in-0 and in-1 and not in-2
MARGIN = 1.1  # of limit3 over the guard's limits: it does not act while the guard works
OWN = ("streamer", "limit3", "offset", "oneshot", "lut5")


@dataclass(frozen=True, slots=True)
class OffsetInsertion:
    """Where an axis' offset is inserted: the signals of command and feedback, and the pins that the command drives."""

    axis: str
    joint: int
    command: str
    feedback: str
    driven: tuple[str, ...]


def find_insertions(hal: HalNetlist, joints: Mapping[str, int], axes: Sequence[str]) -> list[OffsetInsertion]:
    """Return where the offsets of ``axes`` are inserted; ConfigError naming the pin if HAL has no such place."""
    found, faults = [], []
    for axis in axes:
        pins = tuple(f"joint.{joints[axis]}.motor-pos-{end}" for end in ("cmd", "fb"))
        command, feedback = (next((s for s, on in hal.nets.items() if pin in on), "") for pin in pins)
        driven = tuple(pin for pin in hal.find_linked_pins(pins[0]) if pin != pins[1])
        where = f"axis.{axis}.correction"
        if not command or not feedback:
            missing = pins[0] if not command else pins[1]
            faults.append(
                ConfigFault(where, f"{missing} is not connected in the HAL files", "connect it, or remove this section")
            )
        elif command == feedback or not driven:
            faults.append(ConfigFault(where, f"{pins[0]} commands no drive or pid component", "remove this section"))
        else:
            found.append(OffsetInsertion(axis, joints[axis], command, feedback, driven))
    if faults:
        raise ConfigError("HAL", faults)
    return found


def format_correction_hal(
    config: MachineConfig, file: str, joints: int, splices: Sequence[OffsetInsertion], hal: HalNetlist
) -> str:
    """Return the HAL file of a machine with so many joints whose configuration is in ``file``.

    Without ``splices`` it only loads the bridges.
    """
    return "\n".join([*_format_lines(config, file, joints, splices, hal), ""])


def _format_lines(
    config: MachineConfig, file: str, joints: int, splices: Sequence[OffsetInsertion], hal: HalNetlist
) -> Iterator[str]:
    yield from _wrap_comment(
        "Written by fdhil init. Load it last: HALFILE = this file, after the others in [HAL] of the INI. Without it "
        "LinuxCNC runs as before."
    )
    if splices:
        yield from _format_components(config, splices, hal)
        bus = config.bus[config.axis[splices[0].axis].drive.bus]
        yield from _format_wiring(splices, WATCHDOG_S + bus.offset_lead_cycles * config.machine.sync_period_s)
        yield from _format_function_order(splices, hal)
    yield from _wrap_comment(
        "The bridges of the drives (pins of [axis.X.drive.hal]) and of the NC: one sampler each, last in the thread."
    )
    linked = {pin for pins in hal.nets.values() for pin in pins}
    types = "f" * joints + "ssff" + "b" * len(linked & set(linuxcnc.HOLDS))
    port = config.nc_source.linuxcnc.port
    for name, module, options in (
        (hal_bus.NAME, hal_bus, f"{file} --also {types}"),
        (linuxcnc.NAME, linuxcnc, f"--port {port} --channel 1"),
    ):
        yield f"loadusr -Wn {name} /usr/bin/python3 {Path(str(module.__file__)).resolve()} {options}"


def _format_components(config: MachineConfig, splices: Sequence[OffsetInsertion], hal: HalNetlist) -> Iterator[str]:
    yield from _wrap_comment("These limits bound every offset that fdhil sends; fdhil cannot change them.")
    for name in (name for name in OWN if name in hal.loaded):
        yield from _wrap_comment(
            f"Your HAL files already load {name}, and HAL loads a component only once: add the names below to "
            "that line with names=, and delete the line here."
        )
    yield f"loadrt streamer depth=1000 cfg=s{'f' * len(splices)}"
    for component, prefix in (("limit3", "limit"), ("offset", "offset")):
        yield f"loadrt {component} names={','.join(f'fdhil-{prefix}-{s.axis.lower()}' for s in splices)}"
    yield "loadrt oneshot names=fdhil-watchdog"
    yield "loadrt lut5 names=fdhil-gate"
    period_s = config.machine.sync_period_s
    for splice in splices:
        axis, name = config.axis[splice.axis], f"fdhil-limit-{splice.axis.lower()}"
        pins = axis.drive.hal
        assert pins is not None  # offsets are inserted on HAL axes only
        unit, per_mm = pins.position_mm_per_unit, axis.scaling.increments_per_mm
        offset, rate, acceleration, *_ = OffsetBounds.derive(axis, period_s).whole_increments
        yield from _wrap_comment(
            f"{splice.axis}: the limits of [axis.{splice.axis}.correction] and {MARGIN:g} times its rates"
        )
        limit = offset / per_mm / unit
        speed = MARGIN * (rate + 1) / per_mm / period_s / unit
        most = MARGIN * (acceleration + 2) / per_mm / period_s**2 / unit
        for key, value in (("min", -limit), ("max", limit), ("maxv", speed), ("maxa", most)):
            yield f"setp {name}.{key} {value:.9g}"


def _format_wiring(splices: Sequence[OffsetInsertion], watchdog_s: float) -> Iterator[str]:
    yield from _wrap_comment(
        "Offsets pass while the bridge's heartbeat arrives, the machine is on, and the streamer has data."
    )
    for key, value in (("width", watchdog_s), ("retriggerable", 1), ("rising", 1), ("falling", 1)):
        yield f"setp fdhil-watchdog.{key} {value:g}"
    yield f"setp fdhil-gate.function {ALL_THREE:#x}"
    yield "net fdhil-alive fdhil-watchdog.out => fdhil-gate.in-0"
    yield "net fdhil-machine-on motion.motion-enabled => fdhil-gate.in-1"
    yield "net fdhil-empty streamer.0.empty => fdhil-gate.in-2"
    yield "net fdhil-row streamer.0.pin.0"
    enabled = " ".join(f"fdhil-limit-{s.axis.lower()}.enable" for s in splices)
    yield f"net fdhil-on fdhil-gate.out => {enabled}"
    for place, splice in enumerate(splices, 1):
        x = splice.axis.lower()
        yield from _wrap_comment(
            f"{splice.axis}: the drive gets the command plus the offset; the joint's feedback excludes it."
        )
        yield f"net fdhil-table-{x} streamer.0.pin.{place} => fdhil-limit-{x}.in"
        yield f"net fdhil-applied-{x} fdhil-limit-{x}.out => fdhil-offset-{x}.offset"
        yield f"net {splice.command} => fdhil-offset-{x}.in"
        for pin in splice.driven:
            yield f"unlinkp {pin}"
        yield f"net fdhil-command-{x} fdhil-offset-{x}.out => {' '.join(splice.driven)}"
        yield f"unlinkp joint.{splice.joint}.motor-pos-fb"
        yield f"net {splice.feedback} => fdhil-offset-{x}.fb-in"
        yield f"net fdhil-feedback-{x} fdhil-offset-{x}.fb-out => joint.{splice.joint}.motor-pos-fb"


def _format_function_order(splices: Sequence[OffsetInsertion], hal: HalNetlist) -> Iterator[str]:
    """Put the feedback before the motion controller, and the offset right after it."""
    thread, functions = next(((t, f) for t, f in hal.threads.items() if "motion-controller" in f), ("servo-thread", []))
    before = [f"fdhil-offset-{s.axis.lower()}.update-feedback" for s in splices]
    after = ["streamer.0", "fdhil-watchdog", "fdhil-gate"]
    after += [f"fdhil-limit-{s.axis.lower()}" for s in splices]
    after += [f"fdhil-offset-{s.axis.lower()}.update-output" for s in splices]
    if not functions:
        yield from _wrap_comment(
            "The order of your thread is unknown: put these right after motion-controller by hand."
        )
        yield from (f"addf {function} {thread}" for function in (*before, *after))
        return
    controller = functions.index("motion-controller")
    first = min(controller, functions.index("motion-command-handler") if "motion-command-handler" in functions else 99)
    yield from _wrap_comment(
        f"In {thread}: feedback before function {first + 1}, offsets right after motion-controller."
    )
    for place, function in enumerate(before):
        yield f"addf {function} {thread} {first + 1 + place}"
    for place, function in enumerate(after):
        yield f"addf {function} {thread} {controller + 2 + len(before) + place}"


def _wrap_comment(words: str) -> list[str]:
    return wrap(words, 110, initial_indent="# ", subsequent_indent="# ")
