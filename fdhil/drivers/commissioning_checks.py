"""Commissioning, first half: what is read from the drive and compared with the configuration. Nothing moves.

Every function raises one sentence with cause and advice: ProtocolError or DriveFault for what is wrong, SdoAbort and
DeviceTimeout for what is not answered.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass

from fdhil.cia402 import Mode, Object
from fdhil.config import CorrectionLimits
from fdhil.drivers.canopen_sdo import NO_OBJECT, NO_SUB_INDEX
from fdhil.drivers.commissioning_master import Master
from fdhil.drivers.profile import PdoSpec
from fdhil.errors import ConnectError, DriveFault, ProtocolError, SdoAbort

LISTEN_S = 2.0
INVALID_COB_ID = 1 << 31
NO_WINDOW = 0xFFFFFFFF


@dataclass(frozen=True, slots=True)
class Identity:
    """Object 0x1018."""

    vendor_id: int
    product_code: int
    revision: int
    serial: int


def read_optional(master: Master, index: int, sub: int = 0, *, signed: bool = False) -> int | None:
    """Read an integer object, None when the drive does not have it."""
    try:
        return master.sdo.read_int(index, sub, signed=signed)
    except SdoAbort as abort:
        if abort.code in (NO_OBJECT, NO_SUB_INDEX):
            return None
        raise


def listen(master: Master) -> None:
    """Listen without sending: on a silent bus nothing is sent, and beside an NC we are not the master."""
    end = master.now() + LISTEN_S
    while master.now() < end and master.heard.sync == 0:
        master.check()
        master.pause(0.01)
    bus = f"bus {master.bus.name}"
    if master.heard.sync or master.heard.foreign_rpdo:
        raise ProtocolError(bus, "an NC is sending SYNC or set-points; switch it off while an axis is commissioned")
    if master.heard.frames == 0:
        raise ConnectError(bus, "there is no drive on the bus; check the drives' supply, wiring and bit rate")


def read_identity(master: Master) -> Identity:
    """Read 0x1018 and compare it with the profile, where that names a vendor or product."""
    identity = Identity(*(read_optional(master, Object.IDENTITY, sub) or 0 for sub in (1, 2, 3, 4)))
    profile = master.profile
    wrong_vendor = profile.vendor_id is not None and identity.vendor_id != profile.vendor_id
    wrong_product = profile.product_code is not None and identity.product_code != profile.product_code
    if wrong_vendor or wrong_product:
        raise DriveFault(
            master.device,
            f"it is vendor {identity.vendor_id:08X}, product {identity.product_code:08X}, which profile {profile.name} "
            "is not made for; choose another profile",
        )
    return identity


def check_mapping(master: Master) -> str:
    """Compare all PDOs with the profile and return the mapping's fingerprint (SHA-256, 16 hexadecimal digits)."""
    found: list[tuple[int, ...]] = []
    for first_parameter, first_mapping, specs in (
        (Object.RPDO_PARAMETER, Object.RPDO_MAPPING, master.profile.rpdos),
        (Object.TPDO_PARAMETER, Object.TPDO_MAPPING, master.profile.tpdos),
    ):
        for spec in specs:
            number = spec.number - 1
            found += [_check_pdo(master, spec, first_parameter + number, first_mapping + number)]
    return hashlib.sha256(repr(found).encode()).hexdigest()[:16]


def _check_pdo(master: Master, spec: PdoSpec, parameter: int, mapping: int) -> tuple[int, ...]:
    read = master.sdo.read_int
    cob_id, kind = read(parameter, 1), read(parameter, 2)
    mapped = tuple(read(mapping, sub) for sub in range(1, read(mapping, 0) + 1))
    expected = tuple(entry.mapping for entry in spec.entries)
    advice = f"write 0x{parameter:04X} and 0x{mapping:04X} with the drive's tool, or choose another profile"
    if mapped != expected:
        shown = ", ".join(f"{value:08X}" for value in mapped) or "nothing"
        wanted = ", ".join(f"{value:08X}" for value in expected)
        raise ProtocolError(master.device, f"{spec.name} maps {shown} where the profile has {wanted}; {advice}")
    valid = not cob_id & INVALID_COB_ID
    if valid != spec.valid or cob_id & 0x7FF != spec.cob_base + master.node_id:
        wanted = f"{spec.cob_base + master.node_id:03X}" + ("" if spec.valid else ", not valid")
        raise ProtocolError(master.device, f"{spec.name} has the COB-ID {cob_id:08X}, not {wanted}; {advice}")
    if spec.valid and kind != spec.every_sync:
        raise ProtocolError(
            master.device, f"{spec.name} has transmission type {kind} where the profile has {spec.every_sync}; {advice}"
        )
    return parameter, cob_id, kind, *mapped


def check_mode(master: Master) -> None:
    """The drive must offer cyclic synchronous position and interpolate at the machine's SYNC period."""
    modes = read_optional(master, Object.SUPPORTED_MODES)
    if modes is not None and not modes >> (Mode.CYCLIC_SYNC_POSITION - 1) & 1:
        raise DriveFault(master.device, "it has no cyclic synchronous position mode (0x6502); it cannot be corrected")
    value = read_optional(master, Object.INTERPOLATION_PERIOD, 1)
    exponent = read_optional(master, Object.INTERPOLATION_PERIOD, 2, signed=True)
    if value is None or exponent is None:
        return
    period_s = value * 10.0**exponent
    if abs(period_s - master.period_s) > 1e-6:
        raise DriveFault(
            master.device,
            f"it interpolates over {period_s * 1e3:g} ms (0x60C2) while SYNC comes every {master.period_s * 1e3:g} ms; "
            "set 0x60C2 or machine.sync_period_s",
        )


def check_scale(master: Master) -> None:
    """Position increments per motor revolution from 0x6091 and 0x6092 (else 0x608F) must be the configured ones."""
    expected = master.config.axis[master.axis].drive.increments_per_rev
    feed = _ratio(master, Object.FEED_CONSTANT)
    gear = _ratio(master, Object.GEAR_RATIO)
    encoder = _ratio(master, Object.POSITION_ENCODER_RESOLUTION)
    if feed is not None:
        per_rev, source = feed / (gear or 1.0), "0x6092 and 0x6091"
    elif encoder is not None:
        per_rev, source = encoder, "0x608F"
    else:
        return
    if abs(per_rev - expected) > 1e-6 * expected:
        raise DriveFault(
            master.device,
            f"its position counts {per_rev:g} per motor revolution ({source}) where the config has {expected}; "
            "correct the drive's factors or drive.increments_per_rev",
        )


def _ratio(master: Master, index: int) -> float | None:
    upper, lower = read_optional(master, index, 1), read_optional(master, index, 2)
    return None if upper is None or not lower else upper / lower


def check_rating(master: Master) -> None:
    """0x6075 is what 0x6078 counts in: it must be the configured rated current."""
    if master.profile.current_unit != "permille_of_rated":
        return
    milliamps = read_optional(master, Object.RATED_CURRENT)
    expected = master.config.axis[master.axis].drive.rated_current_a
    if milliamps is not None and abs(milliamps / 1e3 - expected) > 0.01 * expected:
        raise DriveFault(
            master.device,
            f"its rated current is {milliamps / 1e3:g} A (0x6075) where the config has {expected:g} A; "
            "correct drive.rated_current_a",
        )


def read_options(master: Master) -> dict[str, int]:
    """Read the option codes and the following-error window; an object that is not there is left out."""
    wanted = (
        (Object.ABORT_CONNECTION_OPTION, True),
        (Object.QUICK_STOP_OPTION, True),
        (Object.FAULT_REACTION_OPTION, True),
        (Object.FOLLOWING_ERROR_WINDOW, False),
        (Object.QUICK_STOP_DECELERATION, False),
    )
    values = {f"{index:04X}": read_optional(master, index, signed=signed) for index, signed in wanted}
    return {key: value for key, value in values.items() if value is not None}


def check_options(master: Master, options: Mapping[str, int]) -> float:
    """The drive must stop when communication is lost and when it leaves its path; returns the window in um."""
    strict = master.profile.strict_abort_options
    if options.get("6007") not in strict:
        shown = options.get("6007", "missing")
        raise DriveFault(
            master.device,
            f"0x6007 is {shown}: it goes on when communication is lost; set it to {' or '.join(map(str, strict))}",
        )
    if options.get("605E", 2) == 0 or options.get("605A", 2) == 0:
        raise DriveFault(master.device, "0x605E or 0x605A is 0: it coasts instead of stopping by a ramp; set both to 2")
    window = options.get("6065", NO_WINDOW)
    if window in (0, NO_WINDOW):
        raise DriveFault(master.device, "0x6065 is off: it never notices a following error; set a window")
    settings = master.config.axis[master.axis]
    window_um = window / settings.scaling.increments_per_mm * 1e3
    largest = (settings.correction or CorrectionLimits()).max_offset_um
    if largest > window_um / 4:
        raise DriveFault(
            master.device,
            f"its following-error window is {window_um:g} um (0x6065), too small for offsets of {largest:g} um; "
            "set at least four times the largest offset",
        )
    return window_um
