"""The SYNC grid, and heartbeats, boot-ups and emergencies of the nodes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdhil.cia402 import describe_emergency
from fdhil.drivers.can.frame_ring import pack_frames
from fdhil.drivers.can.node_monitor import NodeMonitor
from fdhil.drivers.can.sync_grid import LONGEST_SILENCE_S, SyncGrid
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.cia402.bus_decoder import BusDecoder
from fdhil.records import Notice, TickTimes
from tests.drivers.frame_builder import Row, build_machine_config

MS = 1_000_000


def build_syncs(ticks: list[int], counter: bool = True, step_ns: int = MS) -> list[Row]:
    return [(k * step_ns, 0x80, bytes([k % 240 + 1]) if counter else b"") for k in ticks]


@given(st.lists(st.integers(1, 100), min_size=1, max_size=60), st.integers(0, 239))
def test_missed_syncs_are_counted_by_their_counter(steps: list[int], start: int) -> None:
    grid = SyncGrid(0.001)
    ticks = (start + np.concatenate([[0], np.cumsum(steps)])).tolist()
    got = np.concatenate([grid.assign_ticks(pack_frames(build_syncs([k]))).syncs.tick for k in ticks])
    assert got.tolist() == [k - start for k in ticks]
    assert grid.missed == sum(steps) - len(steps)


def test_full_counter_turns_are_recognised_by_time() -> None:
    grid = SyncGrid(0.001)
    got = grid.assign_ticks(pack_frames(build_syncs([0, 1, 242, 243 + 480])))
    assert got.syncs.tick.tolist() == [0, 1, 242, 723]


@pytest.mark.parametrize("missed", [240, 5_000, 30_123, 59_000])
def test_syncs_missed_in_a_silence_are_counted(missed: int) -> None:
    grid = SyncGrid(0.001)
    grid.assign_ticks(pack_frames(build_syncs([0, 1])))
    # the counter is right where the time is not quite
    assert grid.assign_ticks(pack_frames(build_syncs([missed + 2], step_ns=MS + 500))).syncs.tick.tolist() == [
        missed + 2
    ]
    assert grid.missed == missed


@pytest.mark.parametrize("hours", [0.05, 16, 24 * 365 * 170])
def test_silence_beyond_the_limit_restarts_the_grid(hours: float) -> None:
    """An NC that was off overnight caused 60 million missing rows, all created at once."""
    grid, begin = SyncGrid(0.001), round(hours * 3_600_000)
    before = grid.assign_ticks(pack_frames(build_syncs([0, 1]))).syncs.tick
    after = grid.assign_ticks(pack_frames(build_syncs(list(range(begin, begin + 50))))).syncs.tick
    longest = round(LONGEST_SILENCE_S * 1000)
    assert longest - 240 < after[0] - before[-1] < longest + 240
    assert np.diff(after).tolist() == [1] * 49
    assert (after[0] - begin) % 240 == 0  # as its counter says
    assert grid.missed == after[0] - before[-1] - 1


@pytest.mark.parametrize("block", [1, 500])
def test_missed_syncs_of_a_block_are_bounded_despite_clock_jumps(block: int) -> None:
    """Each SYNC appears to come hours after the previous one."""
    grid = SyncGrid(0.001)
    rows = [(k * 10_000_000 * MS, 0x80, bytes([k % 240 + 1])) for k in range(500)]
    fed = [grid.assign_ticks(pack_frames(rows[start : start + block])) for start in range(0, 500, block)]
    steps = np.diff([-1, *(each.last_tick for each in fed)])
    assert steps.max() < LONGEST_SILENCE_S * 1000 + 2 * 240 * block
    assert [each.syncs.tick.size for each in fed] == [block] * len(fed)  # none is put aside
    assert np.all(np.diff(np.concatenate([each.syncs.tick for each in fed])) > 0)


def test_paused_simulated_machine_misses_no_sync() -> None:
    grid = SyncGrid(0.001)
    rows = build_syncs([0, 1, 2])
    rows += [(t + 180 * MS, i, d) for t, i, d in build_syncs([3, 4, 5])]
    assert grid.assign_ticks(pack_frames(rows)).syncs.tick.tolist() == [0, 1, 2, 3, 4, 5]
    assert grid.missed == 0


@pytest.mark.fault("A6")
def test_repeatedly_lost_counter_end_does_not_shorten_its_range() -> None:
    """Otherwise every later row would be one too early."""
    grid = SyncGrid(0.001)
    received = [k for k in range(1000) if k not in (239, 479, 718, 719)]
    got = np.concatenate([grid.assign_ticks(pack_frames(build_syncs([k]))).syncs.tick for k in received])
    assert got.tolist() == received
    assert grid.missed == 4


@pytest.mark.fault("A11", "A12")
def test_duplicate_and_reordered_syncs_are_discarded() -> None:
    grid = SyncGrid(0.001)
    rows = build_syncs([0, 1, 1, 2, 1, 3, 4])
    assert grid.assign_ticks(pack_frames(rows)).syncs.tick.tolist() == [0, 1, 2, 3, 4]
    assert (grid.duplicates, grid.out_of_order) == (1, 1)


def test_restarted_sync_producer_is_followed() -> None:
    grid = SyncGrid(0.001)
    rows = [*build_syncs(list(range(200, 205))), *[(t + 300 * MS, i, d) for t, i, d in build_syncs([0, 1, 2])]]
    got = grid.assign_ticks(pack_frames(rows)).syncs.tick
    assert np.all(np.diff(got) > 0)
    assert got.size >= 7


def test_frames_belong_to_the_sync_before_them() -> None:
    grid = SyncGrid(0.001)
    frames = pack_frames(
        [(0, 0x181, b""), *build_syncs([5]), (2, 0x181, b""), (3, 0x181, b""), *build_syncs([6, 7]), (9, 0x181, b"")]
    )
    assert grid.assign_ticks(frames).tick.tolist() == [-1, 0, 0, 0, 1, 2, 2]
    assert grid.assign_ticks(pack_frames([(10, 0x181, b"")])).tick.tolist() == [2]


def test_two_sync_producers_are_reported_once() -> None:
    grid = SyncGrid(0.001)
    notices: list[Notice] = []
    for k in range(100):
        rows = [*build_syncs([k]), (k * MS + 400_000, 0x80, bytes([(k + 77) % 240 + 1]))]
        notices += grid.assign_ticks(pack_frames(rows)).notices
    assert [n.code for n in notices] == ["SyncCollision"]


def build_uncounted_syncs(steps_ns: list[int]) -> list[Row]:
    """Return SYNCs without a counter with these intervals."""
    return [(int(t), 0x80, b"") for t in np.cumsum(steps_ns)]


def feed_producers(rows: list[Row], realtime: bool = True, block: int = 7) -> list[str]:
    """Return the notices of a grid that gets some SYNCs at a time."""
    grid = SyncGrid(0.001, realtime)
    blocks = [rows[start : start + block] for start in range(0, len(rows), block)]
    return [notice.code for each in blocks for notice in grid.assign_ticks(pack_frames(each)).notices]


@pytest.mark.parametrize("early_us", [50, 300, 440])
def test_two_producers_without_counters_are_detected_by_timing(early_us: int) -> None:
    random = np.random.default_rng(early_us)
    steps = [early_us * 1000 + int(random.normal(0, 20_000)), (1000 - early_us) * 1000] * 100
    assert feed_producers(build_uncounted_syncs(steps)) == ["SyncCollision"]
    assert feed_producers(build_uncounted_syncs(steps), realtime=False) == []


@pytest.mark.parametrize("period_us", [250, 500, 700, 1000, 1400, 4000])
@pytest.mark.parametrize("jitter_us", [0, 60])
def test_producer_with_another_period_is_not_a_collision(period_us: int, jitter_us: int) -> None:
    """Its rate has a notice of its own, with the period measured."""
    random = np.random.default_rng(period_us)
    steps = [period_us * 1000 + int(random.normal(0, jitter_us * 1000)) for _ in range(2000)]
    assert feed_producers(build_uncounted_syncs(steps)) == []


def test_sync_with_and_without_counter_is_a_collision() -> None:
    rows = [row for k in range(100) for row in (*build_syncs([k]), (k * MS + 300_000, 0x80, b""))]
    assert feed_producers(rows) == ["SyncCollision"]


@pytest.mark.parametrize("every", [2, 3, 5])
def test_lost_syncs_are_not_a_collision(every: int) -> None:
    grid = SyncGrid(0.001)
    received = [k for k in range(600) if k % every]
    notices = [n for k in received for n in grid.assign_ticks(pack_frames(build_syncs([k]))).notices]
    assert notices == []
    assert grid.missed == received[-1] - received[0] + 1 - len(received)


@pytest.mark.parametrize("overflow", [2, 3, 10, 100, 200, 239, 240])
@pytest.mark.parametrize("block", [1, 50])
def test_any_counter_overflow_is_learned(overflow: int, block: int) -> None:
    """Masters by others choose the overflow; no SYNC is counted as missing, duplicate or of a second producer."""
    grid = SyncGrid(0.001)
    rows: list[Row] = [(10**15 + k * MS, 0x80, bytes([(k + 1) % overflow + 1])) for k in range(1000)]
    taken = [grid.assign_ticks(pack_frames(rows[start : start + block])) for start in range(0, 1000, block)]
    assert np.concatenate([each.syncs.tick for each in taken]).tolist() == list(range(1000))
    assert (grid.missed, grid.duplicates, grid.out_of_order) == (0, 0, 0)
    assert not [notice for each in taken for notice in each.notices]


@pytest.mark.parametrize("overflow", [10, 200])
def test_overflow_of_an_unsteady_counter_is_learned_at_the_second_turn(overflow: int) -> None:
    """With a master on a busy computer the intervals are useless, the counter is not."""
    random = np.random.default_rng(overflow)
    grid = SyncGrid(0.001)
    times = np.cumsum(random.integers(MS // 10, 8 * MS, 1000))
    rows: list[Row] = [(int(t), 0x80, bytes([k % overflow + 1])) for k, t in enumerate(times)]
    ticks = np.concatenate([grid.assign_ticks(pack_frames([row])).syncs.tick for row in rows])
    assert np.all(np.diff(ticks[-2 * overflow :]) == 1)
    assert np.all(np.diff(ticks) > 0)


def test_master_without_counter_takes_over() -> None:
    grid = SyncGrid(0.001)
    grid.assign_ticks(pack_frames(build_syncs(list(range(50)))))
    got = grid.assign_ticks(pack_frames([(t + 500 * MS, i, b"") for t, i, _ in build_syncs(list(range(100)))]))
    assert got.syncs.tick.size >= 90
    assert not got.notices


@pytest.mark.parametrize("data", [b"\x11\x86\x01\0\0\0\0\0", b"\x11\x86\x01", b"\x11\x86"])
@pytest.mark.fault("A20", "A21")
def test_emergency_of_any_length_is_reported(data: bytes) -> None:
    watch = NodeMonitor("X", 1)
    (notice,) = watch.watch_frames(pack_frames([(0, 0x81, data)]), 0)
    assert notice.code == "DriveEmergency"
    assert "8611 (following error" in notice.text
    assert watch.watch_frames(pack_frames([(0, 0x81, data)] * 1000), 0) == []
    assert watch.emcy_count == 1001


def test_cleared_emergency_is_reported() -> None:
    watch = NodeMonitor("X", 1)
    watch.watch_frames(pack_frames([(0, 0x81, b"\x11\x86\x01")]), 0)
    assert [n.severity for n in watch.watch_frames(pack_frames([(0, 0x81, bytes(8))]), 0)] == ["info"]
    assert len(watch.watch_frames(pack_frames([(0, 0x81, b"\x11\x86\x01")]), 0)) == 1


def test_flood_of_emergency_codes_is_bounded() -> None:
    watch = NodeMonitor("X", 1)
    rows = [(0, 0x81, bytes([k % 256, 0x10 + k // 256])) for k in range(2000)]
    assert len(watch.watch_frames(pack_frames(rows), 0)) <= 32


def test_emergency_without_code_is_reported() -> None:
    assert len(NodeMonitor("X", 1).watch_frames(pack_frames([(0, 0x81, b"")]), 0)) == 1


def build_heartbeats(times_ms: list[int], state: int = 5) -> list[Row]:
    return [(t * MS, 0x701, bytes([state])) for t in times_ms]


def test_lost_heartbeat_and_its_return_are_reported() -> None:
    watch = NodeMonitor("X", 1)
    assert watch.watch_frames(pack_frames(build_heartbeats([0, 100, 200, 300])), 300 * MS) == []
    assert watch.watch_frames(pack_frames([]), 650 * MS) == []
    assert [n.code for n in watch.watch_frames(pack_frames([]), 750 * MS)] == ["HeartbeatLost"]
    assert watch.watch_frames(pack_frames([]), 2000 * MS) == []
    back = [n for t in range(2100, 6000, 100) for n in watch.watch_frames(pack_frames(build_heartbeats([t])), t * MS)]
    assert [n.severity for n in back] == ["info"]
    assert [n.code for n in watch.watch_frames(pack_frames([]), 7000 * MS)] == ["HeartbeatLost"]


def test_intermittent_heartbeat_is_one_outage() -> None:
    """Four at 20 ms each second for half a minute: two notices, not two a second."""
    watch = NodeMonitor("X", 1)
    reported = []
    for t in range(0, 30_000, 1000):
        reported += watch.watch_frames(pack_frames(build_heartbeats([t, t + 20, t + 40, t + 60])), (t + 60) * MS)
        reported += watch.watch_frames(pack_frames([]), (t + 500) * MS)
    assert [n.severity for n in reported] == ["MAJOR"]
    reported = [
        n for t in range(30_000, 36_000, 20) for n in watch.watch_frames(pack_frames(build_heartbeats([t])), t * MS)
    ]
    assert [n.severity for n in reported] == ["info"]


def test_boot_during_an_outage_is_the_same_outage() -> None:
    """After a power-up with heartbeats before the boot-up message the daemon once ended."""
    watch = NodeMonitor("X", 1)
    watch.watch_frames(pack_frames(build_heartbeats([0, 100, 200, 300])), 300 * MS)
    reported = watch.watch_frames(pack_frames([]), 2000 * MS)
    reported += watch.watch_frames(pack_frames(build_heartbeats([2100, 2200])), 2200 * MS)
    reported += watch.watch_frames(pack_frames(build_heartbeats([2300], 0)), 2300 * MS)
    reported += [
        n for t in range(2400, 6000, 100) for n in watch.watch_frames(pack_frames(build_heartbeats([t])), t * MS)
    ]
    assert [(n.code, n.severity) for n in reported] == [
        ("HeartbeatLost", "MAJOR"), ("NodeRebooted", "MAJOR"), ("HeartbeatLost", "info")
    ]  # fmt: skip


@given(st.lists(st.tuples(st.integers(0, 3000), st.sampled_from([0, 4, 5, 0x7F, 0x85, 0x33])), max_size=60))
def test_any_node_traffic_gives_one_begin_and_one_end_per_outage(said: list[tuple[int, int]]) -> None:
    watch, t, reported = NodeMonitor("X", 1), 0, []
    for later, state in said:
        t += later
        reported += watch.watch_frames(pack_frames([]), t * MS)
        reported += watch.watch_frames(pack_frames(build_heartbeats([t], state)), t * MS)
    lost = [n.severity for n in reported if n.code == "HeartbeatLost"]
    assert lost == ["MAJOR", "info"] * (len(lost) // 2) + ["MAJOR"] * (len(lost) % 2)


def test_frames_of_each_node_are_counted() -> None:
    decoder = BusDecoder("can0", build_machine_config())
    decoder.decode_frames(pack_frames(build_heartbeats([0, 100])), 100 * MS)
    axis = decoder.axes[0]
    assert decoder.read_counters()[f"{axis}.heard"] == 2
    decoder.decode_frames(pack_frames(build_syncs([0, 1])), 200 * MS)
    assert decoder.read_counters()[f"{axis}.heard"] == 2


def test_reboot_and_lost_operational_state_are_reported() -> None:
    watch = NodeMonitor("X", 1)
    watch.watch_frames(pack_frames(build_heartbeats([0, 100])), 0)
    assert [n.code for n in watch.watch_frames(pack_frames(build_heartbeats([200], 0x7F)), 0)] == ["NmtStateWrong"]
    assert [n.code for n in watch.watch_frames(pack_frames(build_heartbeats([300], 0)), 0)] == ["NodeRebooted"]
    assert watch.boots == 1


@pytest.mark.parametrize(
    ("code", "text"), [(0x8130, "heartbeat or life guarding lost"), (0x3210, "voltage"), (0x0100, "unknown")]
)
def test_emergency_codes_have_texts(code: int, text: str) -> None:
    assert describe_emergency(code) == text


def test_stopped_sync_is_reported_once() -> None:
    decoder = BusDecoder("can0", build_machine_config())
    decoder.decode_frames(pack_frames(build_syncs([0, 1, 2])), 2 * MS)
    codes = [
        r.code
        for t in (500, 1100, 1200)
        for r in decoder.decode_frames(pack_frames([]), t * MS)
        if isinstance(r, Notice)
    ]
    assert codes == ["SyncLost"]
    back = decoder.decode_frames(pack_frames(build_syncs([1300])), 1300 * MS)
    assert [r.severity for r in back if isinstance(r, Notice)] == ["info"]


def test_tick_clock_follows_a_paused_producer() -> None:
    clock = TickClock(0.001)
    clock.add_arrivals(TickTimes(np.array([0, 1, 2, 3]), np.array([0, 1, 2, 53]) * MS))
    assert clock.bound_ticks(2 * MS, 27 * MS + MS // 2) == pytest.approx((2.0, 2.5))
    np.testing.assert_allclose(clock.convert_to_ns(np.array([-1.0, 2.5, 5.0])), np.array([-1.0, 27.5, 55.0]) * MS)
    assert clock.bound_ticks(-MS, MS) is None
    assert clock.bound_ticks(60 * MS, 600 * MS) is None
    clock.add_arrivals(TickTimes(np.array([0, 1]), np.array([100, 101]) * MS))
    assert clock.newest_tick == 1


def test_late_stamp_does_not_narrow_the_bounds() -> None:
    clock = TickClock(0.001)
    stamps = np.arange(200) * MS
    stamps[50:60] = 59 * MS + 500_000  # this computer did not look for ten SYNCs
    clock.add_arrivals(TickTimes(np.arange(200), stamps))
    low, high = clock.bound_ticks(55 * MS, 55 * MS + MS // 2) or (0.0, 0.0)
    assert low <= 55.0
    assert high == pytest.approx(55.5)
    assert clock.bound_ticks(100 * MS, 101 * MS) == pytest.approx((100.0, 101.0))


@given(st.integers(0, 2**32 - 1), st.floats(10, 280), st.floats(0, 5), st.sampled_from([0.4, 1.0]))
def test_tick_bounds_enclose_the_truth_despite_late_stamps(seed: int, asked: float, takes: float, pace: float) -> None:
    rng = np.random.default_rng(seed)
    true_ms = np.arange(300) * pace  # a simulated machine may run faster than the clock
    late_ms = np.where(rng.random(300) < 0.1, rng.uniform(0, 3, 300) * pace, 0.0)
    clock = TickClock(0.001)
    clock.add_arrivals(TickTimes(np.arange(300), (np.maximum.accumulate(true_ms + late_ms) * MS).astype(np.int64)))
    low, high = clock.bound_ticks(round(asked * pace * MS), round((asked + takes) * pace * MS)) or (0.0, 300.0)
    assert low <= asked + 0.01
    assert high >= asked + takes - 0.01


def test_guarded_node_is_not_reported_lost_without_requests() -> None:
    watch = NodeMonitor("X", 1)
    rows = [(t * MS, 0x701, bytes([0x05 | (t // 100 % 2) << 7])) for t in range(0, 2000, 100)]
    assert watch.watch_frames(pack_frames(rows), 2000 * MS) == []
    assert watch.watch_frames(pack_frames([]), 60_000 * MS) == []
    assert watch.nmt == 5


def test_drive_filters_pass_every_decoded_frame() -> None:
    config = build_machine_config(axes="XY")
    decoder = BusDecoder("can0", config)
    read = {0x000, 0x080} | {pdo for each in decoder.decoders.values() for pdo in each.cob_ids}
    for node in (1, 2, config.guard.node_id):
        read |= {0x700 + node}
    for node in (1, 2):
        read |= {0x080 + node, 0x580 + node, 0x600 + node}
    filters = decoder.build_filters()

    def passes(can_id: int) -> bool:
        return any(can_id & mask == wanted & mask for wanted, mask in filters)

    assert [can_id for can_id in read if not passes(can_id)] == []
    assert not any(passes(can_id) for can_id in (0x183, 0x703, 0x7FF, 0x80000001))
    assert len(filters) < 10
