"""The NC: takeover, set-point timing, rapid to the start, feed hold, override, faults."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.sim.nc.nc_path import NEGLIGIBLE_MM, PathRate, RowPlayer, plan_rapid_rows
from tests.sim.bench_simulator import (
    PERIOD_S,
    SteppedSimulator,
    build_corner_rows,
    build_simulator_config,
    list_targets,
    smooth_rows,
)

PER_MM = 65536 / 20


def test_takeover_starts_enables_and_holds_the_actual_position() -> None:
    twin = SteppedSimulator(build_simulator_config(sim={"axis": {"X": {"start_mm": 12.5}, "Y": {"start_mm": -3.0}}}))
    twin.switch_on()
    twin.run_cycles(50)
    sync = [data for can_id, data in twin.wire if can_id == 0x80]
    assert [data[0] for data in sync] == list(range(1, len(sync) + 1))
    assert [data for can_id, data in twin.wire if can_id == 0] == [b"\x80\1", b"\x80\2", b"\1\1", b"\1\2"]
    words = [word for word, _ in list_targets(twin.wire, 1)]
    assert [word for place, word in enumerate(words) if place == 0 or words[place - 1] != word] == [0x06, 0x07, 0x0F]
    assert {target for _, target in list_targets(twin.wire, 1)} == {round(12.5 * PER_MM)}
    assert {target for _, target in list_targets(twin.wire, 2)} == {round(-3.0 * PER_MM)}
    for unit, start in zip(twin.machine.units.values(), (12.5, -3.0), strict=True):
        assert unit.drive.dictionary.get_number(0x6041) & 0x6F == 0x27
        assert unit.drive.dictionary.get_number(0x6061) == 8
        assert unit.drive.dictionary.get_number(0x1019) == 240
        assert unit.drive.table_mm == pytest.approx(start, abs=1e-3)


def test_the_sync_counter_wraps_at_240() -> None:
    twin = SteppedSimulator(build_simulator_config("X"))
    twin.switch_on()
    twin.run_cycles(500)
    counters = [data[0] for can_id, data in twin.wire if can_id == 0x80]
    assert counters[239:241] == [240, 1]
    assert max(counters) == 240


@pytest.mark.parametrize("delay", [0, 1, 2, 4])
def test_target_sent_before_sync_is_row_delay_cycles_later(delay: int) -> None:
    twin = SteppedSimulator(build_simulator_config(drive={"setpoint_delay_cycles": delay}))
    twin.switch_on()
    rows = build_corner_rows()
    twin.play_rows(rows)
    references = []
    twin.each_cycle = lambda: references.append(
        (twin.machine.nc.in_force, [unit.drive.reference_mm for unit in twin.machine.units.values()])
    )
    twin.run_until("finished")
    played = [(row.position_mm, followed) for row, followed in references if row is not None and row.playing]
    assert len(played) == len(rows) + 300
    commanded, followed = np.array([p for p, _ in played]), np.array([f for _, f in played])
    assert np.array_equal(commanded[: len(rows)], rows)
    assert np.array_equal(commanded[len(rows) :], np.repeat(rows[-1:], 300, axis=0))
    assert np.abs(followed - commanded).max() <= 0.5 / PER_MM + 1e-9


def test_axes_with_different_delays_still_follow_the_same_row() -> None:
    """The slower drive must get its target earlier."""
    from fdhil import config
    from tests.bench import bench_document

    document = bench_document()
    document["axis"]["X"]["drive"] = {"setpoint_delay_cycles": 4}
    document["axis"]["Y"]["drive"] = {"setpoint_delay_cycles": 1}
    twin = SteppedSimulator(config.parse_config(document))
    twin.switch_on()
    twin.play_rows(build_corner_rows())
    worst = []

    def compare_rows() -> None:
        row = twin.machine.nc.in_force
        if row is not None and row.playing:
            units = twin.machine.units.values()
            worst.append(max(abs(u.drive.reference_mm - r) for u, r in zip(units, row.position_mm, strict=True)))

    twin.each_cycle = compare_rows
    twin.run_until("finished")
    assert max(worst) <= 0.5 / PER_MM + 1e-9


def test_rapid_moves_axes_to_start_within_limits() -> None:
    twin = SteppedSimulator(build_simulator_config())
    twin.switch_on()
    twin.play_rows(build_corner_rows() + np.array([300.0, 100.0]))
    inputs = []
    twin.each_cycle = lambda: inputs.append(twin.machine.units["X"].drive.feedback.digital_inputs >> 16 & 1)
    twin.run_until("playing")
    x = np.array([target for _, target in list_targets(twin.wire, 1)]) / PER_MM
    speed = np.diff(x) / PERIOD_S
    assert speed.max() == pytest.approx(500.0, rel=0.01)
    assert np.abs(np.diff(speed)).max() / PERIOD_S < 4000.0 + 2 / PER_MM / PERIOD_S**2
    assert x[-1] == pytest.approx(300.0, abs=1e-3)
    rising, falling = inputs.index(1), len(inputs) - inputs[::-1].index(1)
    assert sum(inputs) == falling - rising
    assert falling - rising > 600
    assert inputs[-1] == 0
    assert twin.machine.units["X"].drive.table_mm == pytest.approx(300.0, abs=0.01)


def test_rapid_rows_set_digital_input() -> None:
    twin = SteppedSimulator(build_simulator_config())
    twin.switch_on()
    twin.play_rows(build_corner_rows(), rapid=True)
    twin.run_until("playing")
    assert twin.machine.units["Y"].drive.feedback.digital_inputs >> 16 & 1 == 1
    twin.run_until("finished")
    assert twin.machine.units["Y"].drive.feedback.digital_inputs == 0


def test_feed_hold_decelerates_along_path_and_resumes() -> None:
    twin = SteppedSimulator(build_simulator_config())
    twin.switch_on()
    rows = build_corner_rows(speed_mm_s=300.0, side_mm=60.0)
    twin.play_rows(rows)
    twin.run_until("playing")
    twin.run_cycles(150)
    start = len(twin.wire)
    twin.machine.nc.set_feed_hold(True)
    twin.run_cycles(400)
    held = [target for _, target in list_targets(twin.wire[start:], 2)]
    assert len(set(held[-150:])) == 1
    assert np.all(np.diff(held) >= 0)
    speed = np.diff(np.array(held) / PER_MM) / PERIOD_S
    assert np.abs(np.diff(speed)).max() / PERIOD_S < 4000.0 + 3 / PER_MM / PERIOD_S**2
    twin.machine.nc.set_feed_hold(False)
    finished = twin.run_until("finished")
    assert finished["rows"] == len(rows)
    assert not finished["stopped"]
    every = np.column_stack([[t for _, t in list_targets(twin.wire, node)] for node in (1, 2)]) / PER_MM
    assert _distance_to(rows, every).max() < 2e-3


def test_override_scales_the_path_in_time() -> None:
    twin = SteppedSimulator(build_simulator_config())
    twin.switch_on()
    twin.machine.nc.set_override(50)
    rows = build_corner_rows()
    twin.play_rows(rows)
    twin.run_until("playing")
    cycles = len(twin.table)
    twin.run_until("finished")
    assert len(twin.table) - cycles == pytest.approx(2 * len(rows) + 300, abs=5)
    every = np.column_stack([[t for _, t in list_targets(twin.wire, node)] for node in (1, 2)]) / PER_MM
    assert _distance_to(rows, every).max() < 2e-3
    with pytest.raises(ValueError, match="0 to 150 %"):
        twin.machine.nc.set_override(200)


def test_stop_decelerates_and_abandons_path() -> None:
    twin = SteppedSimulator(build_simulator_config())
    twin.switch_on()
    rows = build_corner_rows()
    twin.play_rows(rows)
    twin.run_until("playing")
    twin.run_cycles(100)
    twin.machine.nc.stop_path()
    finished = twin.run_until("finished")
    assert finished["stopped"]
    assert 100 <= finished["rows"] < len(rows)
    held = twin.table[-1]
    twin.run_cycles(200)
    assert twin.table[-1] == pytest.approx(held, abs=0.1)
    twin.play_rows(rows)
    assert not twin.run_until("finished")["stopped"]


def test_stop_at_path_end_does_not_stop_next_path() -> None:
    """The rest after a path is shorter than the braking distance: the stop ends with the path."""
    twin = SteppedSimulator(build_simulator_config())
    twin.switch_on()
    rows = build_corner_rows()
    twin.play_rows(rows)
    twin.run_until("playing")
    twin.run_cycles(len(rows) + 285)
    twin.machine.nc.stop_path()
    twin.run_until("finished")
    twin.play_rows(rows[::-1])
    assert twin.run_until("finished")["stopped"] is False


def test_drive_fault_stops_path_and_switching_on_recovers() -> None:
    twin = SteppedSimulator(build_simulator_config())
    twin.switch_on()
    twin.play_rows(build_corner_rows())
    twin.run_until("playing")
    twin.run_cycles(100)
    twin.machine.units["X"].drive.trip_fault(0x3210)
    error = twin.run_until("error")
    assert "drive X left Operation enabled" in error["text"]
    assert twin.run_until("finished")["stopped"]
    twin.run_cycles(100)
    y = [target for _, target in list_targets(twin.wire, 2)][-50:]
    assert len(set(y)) == 1
    assert twin.machine.units["Y"].drive.dictionary.get_number(0x6041) & 0x6F == 0x27
    twin.play_rows(build_corner_rows())
    assert "switch it on first" in twin.run_until("error")["text"]
    twin.machine.nc.switch_on_off(True)
    assert twin.run_until("nc")["on"] is True
    assert twin.machine.units["X"].drive.dictionary.get_number(0x6041) & 0x6F == 0x27
    twin.play_rows(build_corner_rows())
    assert not twin.run_until("finished")["stopped"]


def test_silent_drive_stops_path() -> None:
    twin = SteppedSimulator(build_simulator_config())
    twin.switch_on()
    twin.machine.units["Y"].switch_power(False)
    assert "drive Y stopped sending its statusword" in twin.run_until("error")["text"]


def test_switching_off_disables_drives_and_releases_bus() -> None:
    twin = SteppedSimulator(build_simulator_config())
    twin.switch_on()
    twin.play_rows(build_corner_rows())
    twin.run_until("playing")
    twin.run_cycles(50)
    twin.machine.nc.switch_on_off(False)
    assert twin.run_until("finished")["stopped"]
    assert twin.run_until("nc")["on"] is False
    count = len(twin.wire)
    twin.run_cycles(20)
    assert len(twin.wire) == count
    for unit in twin.machine.units.values():
        assert not unit.drive.power.powered
        assert unit.drive.nmt == 0x7F


def test_unplayable_demand_is_refused() -> None:
    twin = SteppedSimulator(build_simulator_config())
    twin.play_rows(build_corner_rows())
    assert "switch it on first" in twin.machine.take_events()[0]["text"]
    twin.switch_on()
    twin.play_rows(build_corner_rows(), axes="XZ")
    assert "no axis Z" in twin.machine.take_events()[0]["text"]
    twin.play_rows(build_corner_rows())
    twin.play_rows(build_corner_rows())
    assert "stop it first" in twin.machine.take_events()[0]["text"]


@settings(max_examples=40)
@given(
    st.lists(st.floats(-500, 500), min_size=2, max_size=2),
    st.lists(st.floats(-500, 500), min_size=2, max_size=2),
)
def test_rapids_respect_limits(start: list[float], end: list[float]) -> None:
    rows = plan_rapid_rows(start, end, [500.0, 300.0], [4000.0, 2000.0], [0.06, 0.03], PERIOD_S)
    if np.max(np.abs(np.subtract(start, end))) <= NEGLIGIBLE_MM:
        assert len(rows) == 0
        return
    assert rows[0] == pytest.approx(start)
    assert rows[-1].tolist() == end
    speed = np.diff(rows, axis=0) / PERIOD_S
    rate = np.diff(speed, axis=0) / PERIOD_S
    assert np.all(np.abs(speed) <= np.array([500.0, 300.0]) * (1 + 1e-9) + 1e-9)
    assert np.all(np.abs(rate) <= np.array([4000.0, 2000.0]) * 1.001 + 1e-3)
    assert np.abs(speed[-1]).max() < 1.0


@settings(max_examples=50)
@given(st.lists(st.tuples(st.sampled_from([0.0, 0.25, 0.5, 1.0, 1.2]), st.integers(1, 400)), min_size=1, max_size=6))
def test_path_rate_is_slope_limited_and_reaches_target(orders: list[tuple[float, int]]) -> None:
    rate = PathRate(8.0, PERIOD_S)
    before = rate.value
    for target, cycles in orders:
        for _ in range(cycles):
            value = rate.advance_rate(target)
            assert abs(value - before) <= 8.0 * PERIOD_S + 1e-12
            before = value
    for _ in range(400):
        before = rate.advance_rate(orders[-1][0])
    assert before == orders[-1][0]


@settings(max_examples=50)
@given(st.floats(0.05, 1.5))
def test_player_ends_exactly_on_last_row(rate: float) -> None:
    rows = smooth_rows(np.linspace([0.0, 0.0], [1.0, 2.0], 20), (5,))
    player = RowPlayer(rows, np.zeros(len(rows), dtype=bool))
    places = []
    while not player.has_ended:
        places.append(player.play_row(rate)[0])
    assert places[0] == rows[0].tolist()
    assert places[-1] == rows[-1].tolist()
    assert len(places) == pytest.approx((len(rows) - 1) / rate + 1, abs=2)


def _distance_to(rows: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the distance of each point to the polyline of the rows, mm."""
    start, way = rows[:-1], np.diff(rows, axis=0)
    length = np.maximum((way**2).sum(axis=1), 1e-18)
    best = np.full(len(points), np.inf)
    for a, b, n in zip(start, way, length, strict=True):
        part = np.clip(((points - a) @ b) / n, 0, 1)
        best = np.minimum(best, np.hypot(*(points - a - part[:, None] * b).T))
    return best
