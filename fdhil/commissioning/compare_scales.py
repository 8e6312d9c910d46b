"""Compare a drive's units with the configuration: increments, current, torque, speed and the DC link."""

from collections.abc import Callable, Iterator
from functools import partial

from fdhil.cia402 import Object
from fdhil.commissioning.finding import Finding, read_optional, report_missing_object
from fdhil.commissioning.master import Master
from fdhil.drivers import decode_speed_unit

DC_LINK_TOLERANCE = 0.05
Read = Callable[[int, int], int | None]
"""Reads an unsigned object by index and sub-index; None if the drive does not report it."""


def compare_increments(master: Master) -> Iterator[Finding]:
    """Compare the position increments per motor revolution (0x6091 and 0x6092, else 0x608F) with the configuration."""
    expected = master.config.axis[master.axis].drive.increments_per_rev
    wanted = f"{expected} per revolution"
    reported = read_increments_per_rev(partial(read_optional, master))
    if reported is None:
        yield report_missing_object("scale", wanted, "0x6092", "0x608F")
        return
    per_rev, source = reported
    found = f"{per_rev:g} per revolution"
    same = abs(per_rev - expected) <= 1e-6 * expected
    cause = (
        f"it has {per_rev:g} position increments per motor revolution ({source}), but the configuration has {expected}"
    )
    yield Finding("scale", wanted, found, same, cause, "correct the drive's factors or drive.increments_per_rev")


def read_increments_per_rev(read: Read) -> tuple[float, str] | None:
    """Return a drive's position increments per motor revolution and the objects they come from; None if unavailable."""
    feed, gear = _read_ratio(read, Object.FEED_CONSTANT), _read_ratio(read, Object.GEAR_RATIO)
    if feed is not None:
        return feed / (gear or 1.0), "0x6092 and 0x6091"
    encoder = _read_ratio(read, Object.POSITION_ENCODER_RESOLUTION)
    return None if encoder is None else (encoder, "0x608F")


def _read_ratio(read: Read, index: int) -> float | None:
    upper, lower = read(index, 1), read(index, 2)
    return None if upper is None or not lower else upper / lower


def compare_rating(master: Master) -> Iterator[Finding]:
    """Compare the unit of the current, 0x6075 or 0x6076 (both in thousandths), with the configuration."""
    drive, unit = master.config.axis[master.axis].drive, master.profile.current_unit
    if unit == "permille_of_rated":
        place, what, symbol, key = Object.RATED_CURRENT, "rated current", "A", "rated_current_a"
    elif unit == "permille_of_rated_torque":
        place, what, symbol, key = Object.RATED_TORQUE, "rated torque", "N.m", "rated_torque_nm"
    else:
        return
    expected = drive.rated_current_a if place == Object.RATED_CURRENT else drive.rated_torque_nm
    reported, wanted = read_optional(master, place), f"{expected:g} {symbol}"
    if reported is None:
        yield report_missing_object(what, wanted, f"0x{place:04X}")
        return
    found = f"{reported / 1e3:g} {symbol}"
    same = abs(reported / 1e3 - expected) <= 0.01 * expected
    cause = f"its {what} is {found} (0x{place:04X}), but the configuration has {wanted}"
    yield Finding(what, wanted, found, same, cause, f"correct drive.{key}")


def compare_speed_unit(master: Master) -> Iterator[Finding]:
    """Compare the speed unit in 0x60A9, if the drive has it, with the configuration."""
    word = read_optional(master, Object.VELOCITY_UNIT)
    if word is None:
        return
    wanted = master.config.axis[master.axis].drive.speed_unit or master.profile.speed_unit
    found = decode_speed_unit(word)
    shown = f"0x60A9 = {word:08X}{f', {found}' if found else ''}"
    cause = f"its speed unit ({shown}) is not {wanted}"
    advice = f"set drive.speed_unit = '{found}'" if found else "set 0x60A9 to 00B44700 (rpm) or FDB44700 (millirpm)"
    yield Finding("speed unit", wanted, shown, found == wanted, cause, f"{advice}, or 0x60A9 with the drive's tool")


def compare_dc_link(master: Master) -> Iterator[Finding]:
    """Compare the DC-link voltage that scales a duty with the drive's measurement, if only SDO reports it."""
    profile, drive = master.profile, master.config.axis[master.axis].drive
    if not profile.duty_per_count or profile.dc_link is None or len(profile.voltage_objects) != 1:
        return
    counts = read_optional(master, *profile.dc_link)
    if counts is None:
        return
    link_v = counts * profile.dc_link_v_per_count
    found, wanted = f"{link_v:.1f} V", "not set" if drive.dc_link_v is None else f"{drive.dc_link_v:g} V"
    same = drive.dc_link_v is not None and abs(link_v - drive.dc_link_v) <= DC_LINK_TOLERANCE * drive.dc_link_v
    cause = f"its DC link has {found}, but the configuration has {wanted}"
    yield Finding("DC link", wanted, found, same, cause, f"set drive.dc_link_v = {link_v:.1f}")


def compare_scales(master: Master) -> Iterator[Finding]:
    """Yield the findings of all scales."""
    yield from compare_increments(master)
    yield from compare_rating(master)
    yield from compare_speed_unit(master)
    yield from compare_dc_link(master)
