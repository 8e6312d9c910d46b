"""TPDOs that are never received: reported by name, and not counted as lost frames."""

from __future__ import annotations

import pytest

from fdhil.drivers.can.frame_ring import pack_frames
from fdhil.drivers.cia402.bus_decoder import BusDecoder
from fdhil.records import AxisSamples, Notice
from tests.drivers.frame_builder import FrameBuilder, Row, build_machine_config

LATE = FrameBuilder(12_000)
TPDO1, TPDO2, TPDO3, TPDO4 = 0x181, 0x281, 0x381, 0x481


def decode_notices(rows: list[Row]) -> tuple[BusDecoder, list[Notice], list[AxisSamples]]:
    """Feed a bus half a second at a time; return its decoder, the notices about TPDOs, and the samples."""
    decoder = BusDecoder("can0", build_machine_config())
    out = []
    for start in range(0, len(rows), 2000):
        block = rows[start : start + 2000]
        out += decoder.decode_frames(pack_frames(block), block[-1][0])
    notices = [each for each in out if isinstance(each, Notice) and each.code == "PdoMissing"]
    return decoder, notices, [each for each in out if isinstance(each, AxisSamples)]


def remove_frames(*can_ids: int) -> list[Row]:
    return [row for row in LATE.build_rows() if row[1] not in can_ids]


@pytest.mark.parametrize(
    ("silent", "severity", "named"),
    [
        ((TPDO1, TPDO2, TPDO3, TPDO4), "MAJOR", "TPDO1 (181), TPDO2 (281), TPDO3 (381), TPDO4 (481)"),
        ((TPDO2,), "MAJOR", "TPDO2 (281)"),
        ((TPDO4,), "minor", "TPDO4 (481)"),
    ],
)
def test_missing_tpdos_are_reported_and_not_counted_lost(silent: tuple[int, ...], severity: str, named: str) -> None:
    decoder, (notice,), samples = decode_notices(remove_frames(*silent))
    assert notice.severity == severity
    assert notice.text == (
        f"Drive X (node-ID 1) never sent {named} though SYNC runs; "
        "compare its mapping, COB-IDs and transmission types with fdhil check."
    )
    assert decoder.read_counters()["pdo_lost"] == 0
    assert sum(each.lost for each in samples) == 0
    assert any(each.tick.size for each in samples) == (severity == "minor")


def test_drive_not_started_by_the_nc_is_reported() -> None:
    beats = [(LATE.time_ns(k, 0.05), 0x701, b"\x7f") for k in range(0, LATE.n, 100)]
    _, (notice,), _ = decode_notices(sorted([*remove_frames(TPDO1, TPDO2, TPDO3, TPDO4), *beats]))
    assert notice.text.endswith("though SYNC runs; its NMT state is pre-operational: let the NC start it.")


def test_late_drive_has_lost_nothing_and_is_reported() -> None:
    drive = {TPDO1, TPDO2, TPDO3, TPDO4}
    started = LATE.time_ns(11_000, 0)
    rows = [(t, i, d) for t, i, d in LATE.build_rows() if i not in drive or t > started]
    decoder, notices, samples = decode_notices(rows)
    assert [notice.severity for notice in notices] == ["MAJOR", "info"]
    assert decoder.read_counters()["pdo_lost"] == 0
    assert sum(each.tick.size for each in samples) > 900


def test_lost_frames_of_a_present_tpdo_are_counted() -> None:
    gone = range(500, 700)
    rows = [(t, i, d) for t, i, d in LATE.build_rows() if not (i == TPDO1 and (t - LATE.start_ns) // 1_000_000 in gone)]
    decoder, notices, _ = decode_notices(rows)
    assert (decoder.read_counters()["pdo_lost"], notices) == (200, [])


def test_event_driven_tpdo_is_reported_and_not_counted_lost() -> None:
    """The default of most drives: transmission type 255."""
    rarely = {LATE.time_ns(k, 0.1) for k in range(0, LATE.n, 37)}
    rows = [(t, i, d) for t, i, d in LATE.build_rows() if i != TPDO1 or t in rarely]
    decoder = BusDecoder("can0", build_machine_config())
    reported = [
        each.text
        for start in range(0, len(rows), 200)
        for each in decoder.decode_frames(pack_frames(rows[start : start + 200]), rows[start][0])
        if isinstance(each, Notice)
    ]
    assert reported == [
        "Drive X sends TPDO1 (181) with few of the SYNCs, so its samples have gaps; "
        "set the transmission type (0x1800:02) to 1, or check that it is still Operational."
    ]
    assert decoder.read_counters()["pdo_lost"] < 1000


def test_stopped_drive_does_not_count_losses_for_ever() -> None:
    rows = [(t, i, d) for t, i, d in LATE.build_rows() if t < LATE.time_ns(3000, 0) or i not in (TPDO1, TPDO2)]
    decoder = BusDecoder("can0", build_machine_config())
    for start in range(0, len(rows), 200):
        decoder.decode_frames(pack_frames(rows[start : start + 200]), rows[start][0])
    assert decoder.read_counters()["pdo_lost"] < 5000
