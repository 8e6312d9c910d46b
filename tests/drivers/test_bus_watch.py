"""The SYNC grid, and heartbeats, boot-ups and emergencies of the nodes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdhil.cia402 import describe_emergency
from fdhil.drivers.can.frames import frames_of
from fdhil.drivers.can.node_watch import NodeWatch
from fdhil.drivers.can.sync_grid import LONGEST_SILENCE_S, SyncGrid
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.cia402.bus_decoder import BusDecoder
from fdhil.records import Notice, TickTimes
from tests.drivers.wire import Row, machine

MS = 1_000_000


def syncs(ticks: list[int], counter: bool = True, step_ns: int = MS) -> list[Row]:
    return [(k * step_ns, 0x80, bytes([k % 240 + 1]) if counter else b"") for k in ticks]


@given(st.lists(st.integers(1, 100), min_size=1, max_size=60), st.integers(0, 239))
def test_missed_syncs_are_counted_by_their_counter(steps: list[int], start: int) -> None:
    grid = SyncGrid(0.001)
    ticks = (start + np.concatenate([[0], np.cumsum(steps)])).tolist()
    got = np.concatenate([grid.feed(frames_of(syncs([k]))).syncs.tick for k in ticks])
    assert got.tolist() == [k - start for k in ticks]
    assert grid.missed == sum(steps) - len(steps)


def test_whole_turns_of_the_counter_are_told_by_time() -> None:
    grid = SyncGrid(0.001)
    got = grid.feed(frames_of(syncs([0, 1, 242, 243 + 480])))
    assert got.syncs.tick.tolist() == [0, 1, 242, 723]


@pytest.mark.parametrize("missed", [240, 5_000, 30_123, 59_000])
def test_the_syncs_of_a_silence_are_counted(missed: int) -> None:
    grid = SyncGrid(0.001)
    grid.feed(frames_of(syncs([0, 1])))
    # the counter is right where the time is not quite
    assert grid.feed(frames_of(syncs([missed + 2], step_ns=MS + 500))).syncs.tick.tolist() == [missed + 2]
    assert grid.missed == missed


@pytest.mark.parametrize("hours", [0.05, 16, 24 * 365 * 170])
def test_a_longer_silence_is_a_new_beginning(hours: float) -> None:
    """An NC that was off overnight caused 60 million missing rows, all created at once."""
    grid, begin = SyncGrid(0.001), round(hours * 3_600_000)
    before = grid.feed(frames_of(syncs([0, 1]))).syncs.tick
    after = grid.feed(frames_of(syncs(list(range(begin, begin + 50))))).syncs.tick
    longest = round(LONGEST_SILENCE_S * 1000)
    assert longest - 240 < after[0] - before[-1] < longest + 240
    assert np.diff(after).tolist() == [1] * 49
    assert (after[0] - begin) % 240 == 0  # as its counter says
    assert grid.missed == after[0] - before[-1] - 1


@pytest.mark.parametrize("block", [1, 500])
def test_what_a_block_leaves_out_is_bounded_however_its_clock_jumps(block: int) -> None:
    """Each SYNC appears to come hours after the previous one."""
    grid = SyncGrid(0.001)
    rows = [(k * 10_000_000 * MS, 0x80, bytes([k % 240 + 1])) for k in range(500)]
    fed = [grid.feed(frames_of(rows[start : start + block])) for start in range(0, 500, block)]
    steps = np.diff([-1, *(each.last_tick for each in fed)])
    assert steps.max() < LONGEST_SILENCE_S * 1000 + 2 * 240 * block
    assert [each.syncs.tick.size for each in fed] == [block] * len(fed)  # none is put aside
    assert np.all(np.diff(np.concatenate([each.syncs.tick for each in fed])) > 0)


def test_a_simulated_machine_that_was_held_up_misses_nothing() -> None:
    grid = SyncGrid(0.001)
    rows = syncs([0, 1, 2])
    rows += [(t + 180 * MS, i, d) for t, i, d in syncs([3, 4, 5])]
    assert grid.feed(frames_of(rows)).syncs.tick.tolist() == [0, 1, 2, 3, 4, 5]
    assert grid.missed == 0


@pytest.mark.fault("A6")
def test_a_turn_whose_end_is_lost_again_and_again_is_no_shorter_one() -> None:
    """Otherwise every later row would be one too early."""
    grid = SyncGrid(0.001)
    heard = [k for k in range(1000) if k not in (239, 479, 718, 719)]
    got = np.concatenate([grid.feed(frames_of(syncs([k]))).syncs.tick for k in heard])
    assert got.tolist() == heard
    assert grid.missed == 4


@pytest.mark.fault("A11", "A12")
def test_duplicates_and_reordered_syncs_are_put_aside() -> None:
    grid = SyncGrid(0.001)
    rows = syncs([0, 1, 1, 2, 1, 3, 4])
    assert grid.feed(frames_of(rows)).syncs.tick.tolist() == [0, 1, 2, 3, 4]
    assert (grid.duplicates, grid.out_of_order) == (1, 1)


def test_a_producer_that_starts_again_is_followed() -> None:
    grid = SyncGrid(0.001)
    rows = [*syncs(list(range(200, 205))), *[(t + 300 * MS, i, d) for t, i, d in syncs([0, 1, 2])]]
    got = grid.feed(frames_of(rows)).syncs.tick
    assert np.all(np.diff(got) > 0)
    assert got.size >= 7


def test_frames_belong_to_the_sync_before_them() -> None:
    grid = SyncGrid(0.001)
    frames = frames_of(
        [(0, 0x181, b""), *syncs([5]), (2, 0x181, b""), (3, 0x181, b""), *syncs([6, 7]), (9, 0x181, b"")]
    )
    assert grid.feed(frames).tick.tolist() == [-1, 0, 0, 0, 1, 2, 2]
    assert grid.feed(frames_of([(10, 0x181, b"")])).tick.tolist() == [2]


def test_two_producers_are_noticed_once() -> None:
    grid = SyncGrid(0.001)
    notices: list[Notice] = []
    for k in range(100):
        rows = [*syncs([k]), (k * MS + 400_000, 0x80, bytes([(k + 77) % 240 + 1]))]
        notices += grid.feed(frames_of(rows)).notices
    assert [n.code for n in notices] == ["SyncCollision"]


def uncounted(steps_ns: list[int]) -> list[Row]:
    """Return SYNCs without a counter with these intervals."""
    return [(int(t), 0x80, b"") for t in np.cumsum(steps_ns)]


def noticed(rows: list[Row], realtime: bool = True, block: int = 7) -> list[str]:
    """Return the notices of a grid that gets some SYNCs at a time."""
    grid = SyncGrid(0.001, realtime)
    blocks = [rows[start : start + block] for start in range(0, len(rows), block)]
    return [notice.code for each in blocks for notice in grid.feed(frames_of(each)).notices]


@pytest.mark.parametrize("early_us", [50, 300, 440])
def test_two_producers_without_counters_are_noticed_by_their_rhythm(early_us: int) -> None:
    random = np.random.default_rng(early_us)
    steps = [early_us * 1000 + int(random.normal(0, 20_000)), (1000 - early_us) * 1000] * 100
    assert noticed(uncounted(steps)) == ["SyncCollision"]
    assert noticed(uncounted(steps), realtime=False) == []


@pytest.mark.parametrize("period_us", [250, 500, 700, 1000, 1400, 4000])
@pytest.mark.parametrize("jitter_us", [0, 60])
def test_one_producer_of_another_period_is_no_second_one(period_us: int, jitter_us: int) -> None:
    """Its rate has a notice of its own, with the period measured."""
    random = np.random.default_rng(period_us)
    steps = [period_us * 1000 + int(random.normal(0, jitter_us * 1000)) for _ in range(2000)]
    assert noticed(uncounted(steps)) == []


def test_a_counter_beside_none_is_a_second_producer() -> None:
    rows = [row for k in range(100) for row in (*syncs([k]), (k * MS + 300_000, 0x80, b""))]
    assert noticed(rows) == ["SyncCollision"]


@pytest.mark.parametrize("every", [2, 3, 5])
def test_syncs_that_are_lost_are_no_second_producer(every: int) -> None:
    grid = SyncGrid(0.001)
    heard = [k for k in range(600) if k % every]
    notices = [n for k in heard for n in grid.feed(frames_of(syncs([k]))).notices]
    assert notices == []
    assert grid.missed == heard[-1] - heard[0] + 1 - len(heard)


@pytest.mark.parametrize("overflow", [2, 3, 10, 100, 200, 239, 240])
@pytest.mark.parametrize("block", [1, 50])
def test_a_counter_may_go_up_to_any_number(overflow: int, block: int) -> None:
    """Masters by others choose the overflow; no SYNC is counted as missing, duplicate or of a second producer."""
    grid = SyncGrid(0.001)
    rows: list[Row] = [(10**15 + k * MS, 0x80, bytes([(k + 1) % overflow + 1])) for k in range(1000)]
    taken = [grid.feed(frames_of(rows[start : start + block])) for start in range(0, 1000, block)]
    assert np.concatenate([each.syncs.tick for each in taken]).tolist() == list(range(1000))
    assert (grid.missed, grid.duplicates, grid.out_of_order) == (0, 0, 0)
    assert not [notice for each in taken for notice in each.notices]


@pytest.mark.parametrize("overflow", [10, 200])
def test_an_unsteady_counter_is_known_after_its_second_turn(overflow: int) -> None:
    """With a master on a busy computer the intervals are useless, the counter is not."""
    random = np.random.default_rng(overflow)
    grid = SyncGrid(0.001)
    times = np.cumsum(random.integers(MS // 10, 8 * MS, 1000))
    rows: list[Row] = [(int(t), 0x80, bytes([k % overflow + 1])) for k, t in enumerate(times)]
    ticks = np.concatenate([grid.feed(frames_of([row])).syncs.tick for row in rows])
    assert np.all(np.diff(ticks[-2 * overflow :]) == 1)
    assert np.all(np.diff(ticks) > 0)


def test_a_master_without_a_counter_takes_over_from_one_that_counts() -> None:
    grid = SyncGrid(0.001)
    grid.feed(frames_of(syncs(list(range(50)))))
    got = grid.feed(frames_of([(t + 500 * MS, i, b"") for t, i, _ in syncs(list(range(100)))]))
    assert got.syncs.tick.size >= 90
    assert not got.notices


@pytest.mark.parametrize("data", [b"\x11\x86\x01\0\0\0\0\0", b"\x11\x86\x01", b"\x11\x86"])
@pytest.mark.fault("A20", "A21")
def test_an_emergency_is_told_whatever_its_length(data: bytes) -> None:
    watch = NodeWatch("X", 1)
    (notice,) = watch.feed(frames_of([(0, 0x81, data)]), 0)
    assert notice.code == "DriveEmergency"
    assert "8611 (following error" in notice.text
    assert watch.feed(frames_of([(0, 0x81, data)] * 1000), 0) == []
    assert watch.emcy_count == 1001


def test_an_emergency_that_is_over_is_told() -> None:
    watch = NodeWatch("X", 1)
    watch.feed(frames_of([(0, 0x81, b"\x11\x86\x01")]), 0)
    assert [n.severity for n in watch.feed(frames_of([(0, 0x81, bytes(8))]), 0)] == ["info"]
    assert len(watch.feed(frames_of([(0, 0x81, b"\x11\x86\x01")]), 0)) == 1


def test_a_flood_of_codes_is_bounded() -> None:
    watch = NodeWatch("X", 1)
    rows = [(0, 0x81, bytes([k % 256, 0x10 + k // 256])) for k in range(2000)]
    assert len(watch.feed(frames_of(rows), 0)) <= 32


def test_an_emergency_without_a_code_is_told_too() -> None:
    assert len(NodeWatch("X", 1).feed(frames_of([(0, 0x81, b"")]), 0)) == 1


def beats(times_ms: list[int], state: int = 5) -> list[Row]:
    return [(t * MS, 0x701, bytes([state])) for t in times_ms]


def test_a_heartbeat_that_stops_is_noticed_and_its_return_too() -> None:
    watch = NodeWatch("X", 1)
    assert watch.feed(frames_of(beats([0, 100, 200, 300])), 300 * MS) == []
    assert watch.feed(frames_of([]), 650 * MS) == []
    assert [n.code for n in watch.feed(frames_of([]), 750 * MS)] == ["HeartbeatLost"]
    assert watch.feed(frames_of([]), 2000 * MS) == []
    back = [n for t in range(2100, 6000, 100) for n in watch.feed(frames_of(beats([t])), t * MS)]
    assert [n.severity for n in back] == ["info"]
    assert [n.code for n in watch.feed(frames_of([]), 7000 * MS)] == ["HeartbeatLost"]


def test_a_heartbeat_that_comes_and_goes_is_one_outage() -> None:
    """Four at 20 ms each second for half a minute: two notices, not two a second."""
    watch = NodeWatch("X", 1)
    told = []
    for t in range(0, 30_000, 1000):
        told += watch.feed(frames_of(beats([t, t + 20, t + 40, t + 60])), (t + 60) * MS)
        told += watch.feed(frames_of([]), (t + 500) * MS)
    assert [n.severity for n in told] == ["MAJOR"]
    told = [n for t in range(30_000, 36_000, 20) for n in watch.feed(frames_of(beats([t])), t * MS)]
    assert [n.severity for n in told] == ["info"]


def test_a_boot_after_the_first_heartbeats_is_the_same_outage() -> None:
    """After a power-up with heartbeats before the boot-up message the daemon once ended."""
    watch = NodeWatch("X", 1)
    watch.feed(frames_of(beats([0, 100, 200, 300])), 300 * MS)
    told = watch.feed(frames_of([]), 2000 * MS)
    told += watch.feed(frames_of(beats([2100, 2200])), 2200 * MS)
    told += watch.feed(frames_of(beats([2300], 0)), 2300 * MS)
    told += [n for t in range(2400, 6000, 100) for n in watch.feed(frames_of(beats([t])), t * MS)]
    assert [(n.code, n.severity) for n in told] == [
        ("HeartbeatLost", "MAJOR"), ("NodeRebooted", "MAJOR"), ("HeartbeatLost", "info")
    ]  # fmt: skip


@given(st.lists(st.tuples(st.integers(0, 3000), st.sampled_from([0, 4, 5, 0x7F, 0x85, 0x33])), max_size=60))
def test_whatever_a_node_says_of_itself_an_outage_has_one_beginning_and_one_end(said: list[tuple[int, int]]) -> None:
    watch, t, told = NodeWatch("X", 1), 0, []
    for later, state in said:
        t += later
        told += watch.feed(frames_of([]), t * MS)
        told += watch.feed(frames_of(beats([t], state)), t * MS)
    lost = [n.severity for n in told if n.code == "HeartbeatLost"]
    assert lost == ["MAJOR", "info"] * (len(lost) // 2) + ["MAJOR"] * (len(lost) % 2)


def test_what_each_node_sends_is_counted() -> None:
    decoder = BusDecoder("can0", machine())
    decoder.feed(frames_of(beats([0, 100])), 100 * MS)
    axis = decoder.axes[0]
    assert decoder.counters()[f"{axis}.heard"] == 2
    decoder.feed(frames_of(syncs([0, 1])), 200 * MS)
    assert decoder.counters()[f"{axis}.heard"] == 2


def test_a_boot_and_a_lost_state_are_noticed() -> None:
    watch = NodeWatch("X", 1)
    watch.feed(frames_of(beats([0, 100])), 0)
    assert [n.code for n in watch.feed(frames_of(beats([200], 0x7F)), 0)] == ["NmtStateWrong"]
    assert [n.code for n in watch.feed(frames_of(beats([300], 0)), 0)] == ["NodeRebooted"]
    assert watch.boots == 1


@pytest.mark.parametrize(
    ("code", "text"), [(0x8130, "heartbeat or life guarding lost"), (0x3210, "voltage"), (0x0100, "unknown")]
)
def test_emergency_texts(code: int, text: str) -> None:
    assert describe_emergency(code) == text


def test_a_sync_that_stops_is_noticed_once() -> None:
    decoder = BusDecoder("can0", machine())
    decoder.feed(frames_of(syncs([0, 1, 2])), 2 * MS)
    codes = [r.code for t in (500, 1100, 1200) for r in decoder.feed(frames_of([]), t * MS) if isinstance(r, Notice)]
    assert codes == ["SyncLost"]
    back = decoder.feed(frames_of(syncs([1300])), 1300 * MS)
    assert [r.severity for r in back if isinstance(r, Notice)] == ["info"]


def test_tick_clock_follows_a_producer_that_is_held_up() -> None:
    clock = TickClock(0.001)
    clock.add(TickTimes(np.array([0, 1, 2, 3]), np.array([0, 1, 2, 53]) * MS))
    assert clock.bounds(2 * MS, 27 * MS + MS // 2) == pytest.approx((2.0, 2.5))
    np.testing.assert_allclose(clock.time_ns(np.array([-1.0, 2.5, 5.0])), np.array([-1.0, 27.5, 55.0]) * MS)
    assert clock.bounds(-MS, MS) is None
    assert clock.bounds(60 * MS, 600 * MS) is None
    clock.add(TickTimes(np.array([0, 1]), np.array([100, 101]) * MS))
    assert clock.newest_tick == 1


def test_a_stamp_that_was_late_does_not_narrow_the_bounds() -> None:
    clock = TickClock(0.001)
    stamps = np.arange(200) * MS
    stamps[50:60] = 59 * MS + 500_000  # this computer did not look for ten SYNCs
    clock.add(TickTimes(np.arange(200), stamps))
    low, high = clock.bounds(55 * MS, 55 * MS + MS // 2) or (0.0, 0.0)
    assert low <= 55.0
    assert high == pytest.approx(55.5)
    assert clock.bounds(100 * MS, 101 * MS) == pytest.approx((100.0, 101.0))


@given(st.integers(0, 2**32 - 1), st.floats(10, 280), st.floats(0, 5), st.sampled_from([0.4, 1.0]))
def test_bounds_enclose_the_truth_though_some_stamps_are_late(
    seed: int, asked: float, takes: float, pace: float
) -> None:
    rng = np.random.default_rng(seed)
    true_ms = np.arange(300) * pace  # a simulated machine may run faster than the clock
    late_ms = np.where(rng.random(300) < 0.1, rng.uniform(0, 3, 300) * pace, 0.0)
    clock = TickClock(0.001)
    clock.add(TickTimes(np.arange(300), (np.maximum.accumulate(true_ms + late_ms) * MS).astype(np.int64)))
    low, high = clock.bounds(round(asked * pace * MS), round((asked + takes) * pace * MS)) or (0.0, 300.0)
    assert low <= asked + 0.01
    assert high >= asked + takes - 0.01


def test_a_drive_that_answers_to_node_guarding_is_not_missed_when_it_is_not_asked() -> None:
    watch = NodeWatch("X", 1)
    rows = [(t * MS, 0x701, bytes([0x05 | (t // 100 % 2) << 7])) for t in range(0, 2000, 100)]
    assert watch.feed(frames_of(rows), 2000 * MS) == []
    assert watch.feed(frames_of([]), 60_000 * MS) == []
    assert watch.nmt == 5


def test_the_filters_let_all_through_that_is_read() -> None:
    config = machine(axes="XY")
    decoder = BusDecoder("can0", config)
    read = {0x000, 0x080} | {pdo for each in decoder.decoders.values() for pdo in each.cob_ids}
    for node in (1, 2, config.guard.node_id):
        read |= {0x700 + node}
    for node in (1, 2):
        read |= {0x080 + node, 0x580 + node, 0x600 + node}
    filters = decoder.filters()

    def passes(can_id: int) -> bool:
        return any(can_id & mask == wanted & mask for wanted, mask in filters)

    assert [can_id for can_id in read if not passes(can_id)] == []
    assert not any(passes(can_id) for can_id in (0x183, 0x703, 0x7FF, 0x80000001))
    assert len(filters) < 10
