"""TPDOs that are never received: reported by name, and not counted as lost frames."""

from __future__ import annotations

import pytest

from fdhil.drivers.can.frames import frames_of
from fdhil.drivers.cia402.bus_decoder import BusDecoder
from fdhil.records import AxisSamples, Notice
from tests.drivers.wire import Row, Wire, machine

LATE = Wire(12_000)
TPDO1, TPDO2, TPDO3, TPDO4 = 0x181, 0x281, 0x381, 0x481


def decoded(rows: list[Row]) -> tuple[BusDecoder, list[Notice], list[AxisSamples]]:
    """Feed a bus half a second at a time; return its decoder, the notices about TPDOs, and the samples."""
    decoder = BusDecoder("can0", machine())
    out = []
    for start in range(0, len(rows), 2000):
        block = rows[start : start + 2000]
        out += decoder.feed(frames_of(block), block[-1][0])
    notices = [each for each in out if isinstance(each, Notice) and each.code == "PdoMissing"]
    return decoder, notices, [each for each in out if isinstance(each, AxisSamples)]


def without(*can_ids: int) -> list[Row]:
    return [row for row in LATE.rows() if row[1] not in can_ids]


@pytest.mark.parametrize(
    ("silent", "severity", "named"),
    [
        ((TPDO1, TPDO2, TPDO3, TPDO4), "MAJOR", "TPDO1 (181), TPDO2 (281), TPDO3 (381), TPDO4 (481)"),
        ((TPDO2,), "MAJOR", "TPDO2 (281)"),
        ((TPDO4,), "minor", "TPDO4 (481)"),
    ],
)
def test_tpdos_that_never_come_are_told_and_not_lost(silent: tuple[int, ...], severity: str, named: str) -> None:
    decoder, (notice,), samples = decoded(without(*silent))
    assert notice.severity == severity
    assert notice.text == (
        f"Drive X (node-ID 1) never sent {named} though SYNC runs; "
        "compare its mapping, COB-IDs and transmission types with fdhil check."
    )
    assert decoder.counters()["pdo_lost"] == 0
    assert sum(each.lost for each in samples) == 0
    assert any(each.tick.size for each in samples) == (severity == "minor")


def test_a_drive_that_the_nc_does_not_start_is_told_as_such() -> None:
    beats = [(LATE.time_ns(k, 0.05), 0x701, b"\x7f") for k in range(0, LATE.n, 100)]
    _, (notice,), _ = decoded(sorted([*without(TPDO1, TPDO2, TPDO3, TPDO4), *beats]))
    assert notice.text.endswith("though SYNC runs; its NMT state is pre-operational: let the NC start it.")


def test_a_drive_that_comes_late_has_lost_nothing_and_is_told_to_come() -> None:
    drive = {TPDO1, TPDO2, TPDO3, TPDO4}
    started = LATE.time_ns(11_000, 0)
    rows = [(t, i, d) for t, i, d in LATE.rows() if i not in drive or t > started]
    decoder, notices, samples = decoded(rows)
    assert [notice.severity for notice in notices] == ["MAJOR", "info"]
    assert decoder.counters()["pdo_lost"] == 0
    assert sum(each.tick.size for each in samples) > 900


def test_frames_of_a_tpdo_that_comes_are_lost_as_ever() -> None:
    gone = range(500, 700)
    rows = [(t, i, d) for t, i, d in LATE.rows() if not (i == TPDO1 and (t - LATE.start_ns) // 1_000_000 in gone)]
    decoder, notices, _ = decoded(rows)
    assert (decoder.counters()["pdo_lost"], notices) == (200, [])


def test_a_tpdo_that_is_sent_on_change_alone_is_told_and_not_lost() -> None:
    """The default of most drives: transmission type 255."""
    seldom = {LATE.time_ns(k, 0.1) for k in range(0, LATE.n, 37)}
    rows = [(t, i, d) for t, i, d in LATE.rows() if i != TPDO1 or t in seldom]
    decoder = BusDecoder("can0", machine())
    told = [
        each.text
        for start in range(0, len(rows), 200)
        for each in decoder.feed(frames_of(rows[start : start + 200]), rows[start][0])
        if isinstance(each, Notice)
    ]
    assert told == [
        "Drive X sends TPDO1 (181) with few of the SYNCs, so its samples have gaps; "
        "set the transmission type (0x1800:02) to 1, or check that it is still Operational."
    ]
    assert decoder.counters()["pdo_lost"] < 1000


def test_a_drive_that_stops_does_not_count_for_ever() -> None:
    rows = [(t, i, d) for t, i, d in LATE.rows() if t < LATE.time_ns(3000, 0) or i not in (TPDO1, TPDO2)]
    decoder = BusDecoder("can0", machine())
    for start in range(0, len(rows), 200):
        decoder.feed(frames_of(rows[start : start + 200]), rows[start][0])
    assert decoder.counters()["pdo_lost"] < 5000
