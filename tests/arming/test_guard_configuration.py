"""The guard's settings from configuration, profiles and commissioning records."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from fdhil import config as machine_config
from fdhil.arming.guard_configuration import compute_heartbeat_timeout_s, compute_offset_limits, make_guard_settings
from fdhil.commissioning.commissioning_record import CommissioningRecord, compute_axis_digest, save_record
from fdhil.commissioning.void_mark import mark_record_void
from fdhil.config import CorrectionLimits, Drive, TableEncoder
from fdhil.drivers.cia402.drive_profile import DriveProfile
from fdhil.drivers.cia402.drive_profile_file import load_profile
from fdhil.errors import ConfigError
from fdhil.guard.guard_settings import decode_settings, encode_settings
from fdhil.guard.offset_limits import OffsetLimits
from tests.guard.drive_peer import write_config


def test_limits_are_whole_increments_rounded_down(tmp_path: Path) -> None:
    config = machine_config.load_config(write_config(tmp_path, 1))
    axis = config.axis["X"].model_copy(update={"correction": CorrectionLimits()})
    assert compute_offset_limits(axis, 0.002) == OffsetLimits(163, 13, 3, 9830, 500)
    slow = config.axis["X"].model_copy(update={"rapid_speed_mm_s": 100.0, "max_acceleration_mm_s2": 1000.0})
    # 10 mm/s and 500 mm/s2 are the axis' shares; braked at one increment per SYNC^2, zero is near enough from less
    assert compute_offset_limits(slow, 0.001) == OffsetLimits(819, 20, 1, 9830, 1000)


RECORD = CommissioningRecord(
    "X", 1, 2, 3, 4, "c0ffee", "f1f2", {"1017": 100}, 1e4, True, 9.8, True, "proven", "2026-01-01T00:00:00+00:00"
)


def test_heartbeat_timeout_follows_commissioning_record(tmp_path: Path) -> None:
    counted = machine_config.load_config(write_config(tmp_path, 1))
    assert counted.guard.clock == "sync"
    config = counted.model_copy(update={"guard": counted.guard.model_copy(update={"clock": "monotonic"})})
    assert compute_heartbeat_timeout_s(config, "X") == 0
    path = save_record(RECORD, config.store.directory)
    assert compute_heartbeat_timeout_s(config, "X") == 0.2
    assert [axis.heartbeat_timeout_s for axis in make_guard_settings(config, "can0", tmp_path, "").axes] == [0.2, 0]
    assert compute_heartbeat_timeout_s(counted, "X") == 0  # heartbeats come by the wall clock
    save_record(replace(RECORD, options={"6007": 1}), config.store.directory)
    assert compute_heartbeat_timeout_s(config, "X") == 0  # the drive has none
    path.write_text("changed by hand")
    assert compute_heartbeat_timeout_s(config, "X") == 0  # and nothing is armed with such a record


def test_software_limits_are_those_of_commissioning(tmp_path: Path) -> None:
    config = machine_config.load_config(write_config(tmp_path, 1))
    assert [axis.travel for axis in make_guard_settings(config, "can0", tmp_path, "").axes] == [None, None]
    save_record(replace(RECORD, options={"607D01": -1000, "607D02": 820_000}), config.store.directory)
    made = make_guard_settings(config, "can0", tmp_path, "")
    assert [axis.travel for axis in made.axes] == [(-1000, 820_000), None]
    assert decode_settings(encode_settings(made)) == made


def test_settings_contain_record_and_its_validity(tmp_path: Path) -> None:
    config = machine_config.load_config(write_config(tmp_path, 1))
    store, signed = config.store.directory, replace(RECORD, config_digest=compute_axis_digest(config, "X"))

    def known() -> list[tuple[str, bool]]:
        return [(axis.record, axis.record_void) for axis in make_guard_settings(config, "can0", tmp_path, "").axes]

    save_record(RECORD, store)
    assert known() == [("", False), ("", False)]  # it was made with another configuration
    save_record(replace(signed, readback_ok=False), store)
    assert known() == [("", False), ("", False)]
    save_record(signed, store)
    assert known() == [(signed.fingerprint, False), ("", False)]
    mark_record_void(store, "X", "booted")
    assert known() == [(signed.fingerprint, True), ("", False)]
    made = make_guard_settings(config, "can0", tmp_path, "")
    assert decode_settings(encode_settings(made)) == made


def test_guard_identifiers_are_not_used_by_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An offset that another drive takes for its set-point would move an axis that is not corrected."""
    config = machine_config.load_config(write_config(tmp_path, 1))
    drives = {"X": config.axis["X"], "Y": config.axis["Y"].model_copy(update={"correction": None})}
    (sent,) = (
        axis.offset.cob_id
        for axis in make_guard_settings(config.model_copy(update={"axis": drives}), "can0", tmp_path, "").axes
    )

    encoder = TableEncoder(source="canopen", cob_id=sent)
    with_encoder = drives | {"Y": drives["Y"].model_copy(update={"table": encoder})}
    with pytest.raises(
        ConfigError, match=rf"axis.Y.table.cob_id: COB-ID {sent:03X}, with which the guard sends offsets"
    ):
        make_guard_settings(config.model_copy(update={"axis": with_encoder}), "can0", tmp_path, "")

    def other(drive: Drive) -> DriveProfile:
        profile = load_profile(drive)
        if drive != drives["Y"].drive:
            return profile
        first, *more = profile.rpdos
        return replace(profile, rpdos=(replace(first, cob_base=sent - 2), *more))

    elsewhere = drives["Y"].drive.model_copy(update={"node_id": 2})
    drives["Y"] = drives["Y"].model_copy(update={"drive": elsewhere})
    monkeypatch.setattr("fdhil.arming.guard_configuration.load_profile", other)
    monkeypatch.setattr("fdhil.commissioning.cob_id_conflicts.load_profile", other)
    with pytest.raises(ConfigError, match=r"axis.Y.drive.profile: COB-ID"):
        make_guard_settings(config.model_copy(update={"axis": drives}), "can0", tmp_path, "")
