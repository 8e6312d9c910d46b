"""The decoder puts every signal in the correct row and counts the lost ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.drivers.can.frame_ring import Frames, pack_frames
from fdhil.drivers.cia402.bus_decoder import BusDecoder
from fdhil.records import AxisSamples, Notice
from tests.drivers.frame_builder import FrameBuilder, Row, build_machine_config

PER_MM = 65536 / 20


def decode_all(
    blocks: Sequence[Frames], decoder: BusDecoder | None = None, **kwargs: object
) -> tuple[dict[str, np.ndarray], list[Notice], BusDecoder]:
    decoder = decoder or BusDecoder("can0", build_machine_config(**kwargs))  # type: ignore[arg-type]
    records = [r for block in blocks for r in decoder.decode_frames(block, int(block["t_ns"][-1]) if block.size else 0)]
    samples = [r for r in records if isinstance(r, AxisSamples)]
    names = ("tick", "demand_mm", "position_mm", "speed_rad_s", "current_a", "voltage_v", "offset_mm", "statusword")
    joined = {name: np.concatenate([getattr(s, name) for s in samples] or [np.empty(0)]) for name in names}
    joined["lost"] = np.array([s.lost for s in samples])
    return joined, [r for r in records if isinstance(r, Notice)], decoder


def check_rows(wire: FrameBuilder, got: dict[str, np.ndarray]) -> None:
    ticks = got["tick"]
    reference = np.array([wire.reference[int(k)] for k in ticks])
    offset = np.array([wire.offset[int(k)] for k in ticks])
    first = np.array([wire.build_tpdo1(int(k)) for k in ticks])
    second = np.array([wire.build_tpdo2(int(k)) for k in ticks])
    after = np.array([wire.build_tpdo2(int(k) + 1) for k in ticks])
    np.testing.assert_allclose(got["demand_mm"] * PER_MM, reference, atol=1e-9)
    np.testing.assert_allclose(got["offset_mm"] * PER_MM, offset, atol=1e-9)
    np.testing.assert_allclose(got["position_mm"] * PER_MM, first[:, 0], atol=1e-9)
    np.testing.assert_allclose(got["speed_rad_s"], first[:, 1] * 2 * math.pi / 65536)
    np.testing.assert_allclose(got["current_a"], second[:, 1] * 0.05)
    np.testing.assert_allclose(got["voltage_v"], after[:, 2] * 0.02, err_msg="the mean of [k, k+1) is sent at SYNC k+1")


def test_every_signal_is_decoded_at_its_tick() -> None:
    wire = FrameBuilder()
    got, notices, decoder = decode_all([wire.build_frames()])
    check_rows(wire, got)
    assert got["tick"].tolist() == list(range(2, 198))  # r[2] is the first target that was seen
    assert notices == []
    assert got["lost"].sum() == 0
    assert decoder.read_counters()["pdo_lost"] == 0


@settings(deadline=None, max_examples=30)
@given(cuts=st.lists(st.integers(0, 800), max_size=12), counter=st.booleans())
def test_samples_are_independent_of_block_size(cuts: list[int], counter: bool) -> None:
    wire = FrameBuilder(n=120, counter=counter)
    frames = wire.build_frames()
    edges = [0, *sorted(min(c, frames.size) for c in cuts), frames.size]
    blocks = [frames[a:b] for a, b in pairwise(edges)]
    got, notices, _ = decode_all(blocks)
    check_rows(wire, got)
    assert got["tick"].tolist() == list(range(2, 118))
    assert notices == []


def remove_frames(frames: Frames, dropped: Sequence[int]) -> Frames:
    return np.delete(frames, list(dropped))


@settings(deadline=None, max_examples=40)
@given(data=st.data(), cut=st.integers(0, 900))
@pytest.mark.fault("A10")
def test_every_lost_frame_is_a_counted_gap(data: st.DataObject, cut: int) -> None:
    wire = FrameBuilder(n=120)
    frames = wire.build_frames()
    ids, ticks = frames["id"], np.cumsum(frames["id"] == 0x80) - 1
    # every-SYNC PDOs and SYNCs, not next to each other, so that each loss can be told from its neighbour's
    candidates = np.flatnonzero(np.isin(ids, [0x80, 0x181, 0x281]) & (ticks > 10) & (ticks < 100))
    chosen = data.draw(st.lists(st.sampled_from(candidates.tolist()), unique=True, max_size=8))
    chosen = [c for c in chosen if not any(o != c and abs(int(ticks[o]) - int(ticks[c])) < 8 for o in chosen)]
    left = remove_frames(frames, chosen)
    got, _, decoder = decode_all([left[:cut], left[cut:]])
    check_rows(wire, got)
    counted = decoder.read_counters()
    lost_syncs = sum(int(ids[c]) == 0x80 for c in chosen)
    assert counted["sync_missed"] == lost_syncs
    assert counted["pdo_lost"] == len(chosen) - lost_syncs
    assert got["lost"].sum() == len(chosen)
    holes = {int(k) for k in set(range(2, 118)) - set(got["tick"].tolist())}
    expected: set[int] = set()
    for c in chosen:
        k = int(ticks[c])
        expected |= {
            0x80: {k - 1, k, k - 2, k + 2, k + 3},  # both neighbours are ambiguous, TPDOs and targets alike
            0x181: {k},
            0x281: {k - 1, k},  # the voltage of row k-1 came with it
        }[int(ids[c])]
    assert holes <= expected
    for c in chosen:
        assert int(ticks[c]) in holes


@pytest.mark.usefixtures("long_computation")
def test_lost_sync_is_not_a_lost_pdo_for_any_block_border() -> None:
    wire = FrameBuilder(n=60)
    frames = wire.build_frames()
    syncs = np.flatnonzero(frames["id"] == 0x80)
    left = remove_frames(frames, [int(syncs[11]), int(syncs[33])])
    for cut in range(left.size):
        _, _, decoder = decode_all([left[:cut], left[cut:]])
        assert decoder.read_counters()["sync_missed"] == 2, cut
        assert decoder.read_counters()["pdo_lost"] == 0, cut


@pytest.mark.parametrize("hours", [0.01, 1, 16])
def test_sampling_continues_after_a_long_silence(hours: float) -> None:
    frames = FrameBuilder().build_frames()
    half = int(np.flatnonzero(frames["id"] == 0x80)[100])
    begun = frames[half:].copy()
    begun["t_ns"] += round(hours * 15_000) * 240_000_000  # as if the NC had gone on counting
    (got, _, _), (true, _, _) = decode_all([frames[:half], begun]), decode_all([frames])
    left_out = np.diff(got["tick"]).max()
    assert 1000 < left_out <= 61_000
    after = slice(-int((true["tick"] > 102).sum()), None)
    for name in ("demand_mm", "position_mm", "speed_rad_s", "current_a", "voltage_v", "offset_mm", "statusword"):
        np.testing.assert_array_equal(got[name][after], true[name][after])
        np.testing.assert_array_equal(got[name][:96], true[name][:96])


def test_constant_target_survives_a_lost_sync() -> None:
    wire = FrameBuilder(n=60)
    wire.reference = {k: min(k, 30) for k in wire.reference}
    rows = [row for row in wire.build_rows() if row != wire.build_sync(40)]
    got, _, decoder = decode_all([pack_frames(rows)])
    check_rows(wire, got)
    assert (decoder.read_counters()["sync_missed"], decoder.read_counters()["pdo_lost"]) == (1, 0)


def test_frame_next_to_a_lost_sync_is_not_assigned_to_another_tick() -> None:
    """SYNC 30 and the TPDO of tick 29 are lost: the frame after SYNC 29 belongs to tick 30."""
    wire = FrameBuilder(n=60)
    lost = (wire.build_sync(30), *wire.build_tpdos(29)[:2])
    got, _, decoder = decode_all([pack_frames([row for row in wire.build_rows() if row not in lost])])
    check_rows(wire, got)
    assert (decoder.read_counters()["sync_missed"], decoder.read_counters()["pdo_lost"]) == (1, 2)


def test_lost_target_is_a_gap_at_the_affected_ticks() -> None:
    wire = FrameBuilder(n=60)
    frames = wire.build_frames()
    ticks = np.cumsum(frames["id"] == 0x80) - 1
    lost = np.flatnonzero((frames["id"] == 0x201) & (ticks == 30))
    got, _, decoder = decode_all([remove_frames(frames, lost.tolist())])
    check_rows(wire, got)
    assert set(range(2, 58)) - set(got["tick"].tolist()) == {33}  # sent after SYNC 30, in force at 30 + 1 + 2
    assert decoder.read_counters()["pdo_lost"] == 1


@pytest.mark.fault("A11")
def test_duplicate_frame_gives_no_second_sample() -> None:
    wire = FrameBuilder(n=60)
    frames = wire.build_frames()
    twice = np.insert(frames, 100, frames[100])
    got, _, decoder = decode_all([np.insert(twice, 40, twice[40])])
    check_rows(wire, got)
    counted = decoder.read_counters()
    assert counted["pdo_duplicates"] + counted["sync_duplicates"] <= 2
    assert got["tick"].tolist() == list(range(2, 58))


@pytest.mark.fault("A13")
@pytest.mark.parametrize("still", [False, True])
def test_late_frame_is_reported_and_both_samples_are_gaps(still: bool) -> None:
    """``still``: at standstill consecutive frames are equal, so no value is wrong."""
    wire = FrameBuilder(n=60)
    rows = wire.build_rows()
    mine = [i for i, row in enumerate(rows) if row[1] == 0x181]
    late = rows[mine[30]]
    if still:
        late = rows[mine[30]] = (late[0], late[1], rows[mine[31]][2])
    moved = [*rows[: mine[30]], *rows[mine[30] + 1 : mine[31]], late, *rows[mine[31] :]]
    for cut in (0, mine[30], mine[31], mine[31] + 1):
        got, notices, decoder = decode_all([pack_frames(moved[:cut]), pack_frames(moved[cut:])])
        check_rows(wire, got)
        holes = set(range(2, 58)) - set(got["tick"].tolist())
        assert holes == ({30} if still else {30, 31}), cut
        counted = decoder.read_counters()
        assert (counted["pdo_late"], counted["pdo_lost"]) == (1, 0), cut
        assert [notice.code for notice in notices] == ["LateFrame"], cut


@pytest.mark.fault("A15", "A16")
def test_short_pdo_is_discarded_and_long_one_truncated() -> None:
    wire = FrameBuilder(n=80)
    rows = wire.build_rows()
    short = [i for i, row in enumerate(rows) if row[1] == 0x281][20:24]
    for i in short:
        rows[i] = (*rows[i][:2], rows[i][2][:4])
    long = [i for i, row in enumerate(rows) if row[1] == 0x281][40]
    rows[long] = (*rows[long][:2], rows[long][2] + b"\xff\xff")
    got, notices, decoder = decode_all([pack_frames(rows)])
    check_rows(wire, got)
    assert decoder.read_counters()["pdo_short"] == 4
    assert decoder.read_counters()["pdo_long"] == 1
    assert {n.code for n in notices} == {"PdoLength", "PdoMapping"}


def test_second_node_with_the_same_id_is_reported() -> None:
    wire = FrameBuilder(n=80)
    rows: list[Row] = []
    for row in wire.build_rows():
        rows.append(row)
        if row[1] == 0x181:
            rows.append((row[0], 0x181, bytes(8)))
    got, notices, _ = decode_all([pack_frames(rows)])
    assert got["tick"].size == 0
    assert [n.code for n in notices] == ["ForeignProducer"]


def test_wrong_setpoint_delay_is_reported() -> None:
    _, notices, _ = decode_all([FrameBuilder(n=200).build_frames()], drive={"setpoint_delay_cycles": 3})
    assert "DemandMismatch" in {n.code for n in notices}


def test_negative_sign_reverses_all_signals() -> None:
    wire = FrameBuilder(n=40)
    forward, _, _ = decode_all([wire.build_frames()])
    backward, _, _ = decode_all([wire.build_frames()], drive={"sign": -1})
    for name in ("demand_mm", "position_mm", "speed_rad_s", "current_a", "voltage_v", "offset_mm"):
        np.testing.assert_array_equal(forward[name], -backward[name])


def test_instantaneous_voltage_keeps_its_tick() -> None:
    wire = FrameBuilder(n=40)
    got, _, _ = decode_all([wire.build_frames()], voltage={"sampling": "instant"})
    second = np.array([wire.build_tpdo2(int(k))[2] for k in got["tick"]])
    np.testing.assert_allclose(got["voltage_v"], second * 0.02)


def test_uncommanded_drive_supplies_its_own_demand() -> None:
    wire = FrameBuilder(n=80)
    wire.reference = dict.fromkeys(wire.reference, 4711)
    wire.offset = dict.fromkeys(wire.offset, 13)
    rows = [row for row in wire.build_rows() if row[1] not in (0x201, 0x301)]
    got, notices, _ = decode_all([pack_frames(rows)])
    check_rows(wire, got)
    assert got["tick"].size == 78
    assert notices == []


def test_two_drives_of_one_bus_are_decoded_separately() -> None:
    both = sorted(
        [*FrameBuilder(n=40).build_rows(), *(r for r in FrameBuilder(n=40, node_id=2).build_rows() if r[1] != 0x80)],
        key=lambda r: r[0],
    )
    decoder = BusDecoder("can0", build_machine_config(axes="XY"))
    samples = [r for r in decoder.decode_frames(pack_frames(both), 0) if isinstance(r, AxisSamples)]
    assert [s.axis for s in samples] == ["X", "Y"]
    np.testing.assert_array_equal(samples[0].position_mm, samples[1].position_mm)
