"""What every listed drive profile must define, so that such a drive can be read, identified and corrected."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest

from fdhil import tables
from fdhil.config import Drive
from fdhil.drivers.cia402.drive_profile import DriveProfile
from fdhil.drivers.cia402.drive_profile_file import load_profile
from fdhil.drivers.cia402.pdo_decoder import PdoDecoder
from tests.drivers.cia402.eds_text import SERVO, write_eds_file
from tests.drivers.frame_builder import build_machine_config

MAX_BITS = 64


@pytest.fixture(params=list(tables.DRIVE_PROFILES))
def profile(request: pytest.FixtureRequest, tmp_path: Path) -> DriveProfile:
    """A listed profile; the one that takes its PDOs from an EDS gets one."""
    name = str(request.param)
    return load_profile(Drive(profile=name, eds=write_eds_file(tmp_path, SERVO) if name == "cia402" else None))


def test_profile_is_listed_under_its_name(profile: DriveProfile) -> None:
    assert profile.name in tables.DRIVE_PROFILES


def test_required_signals_are_in_a_tpdo(profile: DriveProfile) -> None:
    for key in (profile.position, profile.speed, profile.current, profile.statusword):
        found = profile.find_tpdo(key)
        assert found is not None
        assert found[0].valid
        assert found[0].every_sync == 1
    assert profile.missing_signals == ()
    if profile.voltage is not None:
        assert profile.find_tpdo(profile.voltage) is not None
        assert (profile.voltage_v_per_count > 0) != (profile.duty_per_count > 0)
    assert PdoDecoder("X", build_machine_config(), profile).profile is profile


def test_offset_can_be_sent_and_read_back(profile: DriveProfile) -> None:
    """The NC's target and the offset never share an RPDO: each sender would overwrite the other's value."""
    target, offset = profile.find_rpdo(profile.target), profile.find_rpdo(profile.offset)
    assert target is not None
    assert profile.can_take_offset == (offset is not None)
    if offset is None:  # a correction leaves through the NC
        return
    assert target[0].cob_base != offset[0].cob_base
    assert (offset[1].bits, offset[1].signed) == (32, True)
    read_back = profile.find_tpdo(profile.offset)
    assert read_back is not None
    assert read_back[1].bits == 32


def test_no_pdo_is_longer_than_a_frame_or_overlaps(profile: DriveProfile) -> None:
    pdos = [*profile.rpdos, *profile.tpdos]
    assert len({(spec.name[0], spec.cob_base) for spec in pdos}) == len(pdos)
    for spec in pdos:
        assert spec.length * 8 <= MAX_BITS
        assert spec.cob_base % 0x80 == 0
        for before, after in pairwise(spec.entries):
            assert before.bit_offset + before.bits <= after.bit_offset


def test_signed_signals_have_signed_entries(profile: DriveProfile) -> None:
    """Read as unsigned, a current of -1 count would be 65.5 times the rated one; an unsigned duty is marked as such."""
    set_points = (profile.target, profile.offset, profile.speed_offset, profile.torque_offset)
    signals = [profile.position, profile.position_demand, profile.speed, profile.current]
    signals += [] if profile.voltage is None or profile.voltage_magnitude else [profile.voltage]
    places = [profile.find_rpdo(key) for key in set_points] + [profile.find_tpdo(key) for key in signals]
    assert [entry for _, entry in filter(None, places) if not entry.signed] == []


def test_every_signal_has_its_scale(profile: DriveProfile) -> None:
    axis = build_machine_config().axis["X"]
    assert profile.compute_speed_scale(axis) > 0
    assert profile.compute_current_scale(axis) > 0


def test_drive_can_be_set_to_stop_without_heartbeat(profile: DriveProfile) -> None:
    assert profile.strict_abort_options
    assert set(profile.strict_abort_options) <= {1, 2, 3}
