"""What the daemon reads from drives of every vendor: the same motion in each vendor's units, and its model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fdhil.drivers.can.frame_ring import pack_frames
from fdhil.drivers.cia402.bus_decoder import BusDecoder
from fdhil.drivers.moves.inferred_moves import InferredMoves
from fdhil.pipeline import AxisPipeline
from fdhil.program import load_trajectory
from fdhil.records import AxisSamples, Float, TickTimes, WindowOutcome
from tests.sim.bench_simulator import SteppedSimulator
from tests.vendor_drives.vendor_machines import LED, OUTFITS, VendorDrive, build_vendor_config, start_drives

pytestmark = pytest.mark.usefixtures("long_computation")

K, R, CRUISE_RAD_S = 0.8, 0.5, 157.08
CRUISE_A = (5.0 + 0.05 * CRUISE_RAD_S) / K
IDENTIFIED = [o for o in OUTFITS if o.name in ("epos4", "nanotec", "trinamic", "technosoft", "cia402-ingenia")]


def decode_motion(twin: SteppedSimulator, rounds: int, way_mm: float, folder: Path) -> list[AxisSamples | TickTimes]:
    """Run rapids out and back on the NC; return the records decoded from the frames."""
    config = twin.machine.config
    program = folder / "rapids.ngc"
    program.write_text("G21 G90 G94\n" + f"G0 X{way_mm:g}\nG4 P0.3\nG0 X0\nG4 P0.3\n" * rounds + "M2\n", "utf-8")
    twin.machine.nc.play_demand("rapids", load_trajectory(program, config))
    twin.run_until("finished")
    rows, t_ns = [], 1_000_000_000
    for can_id, data in twin.wire:
        t_ns = (t_ns // 1_000_000 + 1) * 1_000_000 if can_id == 0x80 else t_ns + 1000
        rows.append((t_ns, can_id, bytes(data)))
    decoder = BusDecoder("can0", config)
    records = decoder.decode_frames(pack_frames(rows), t_ns)
    assert (
        decoder.read_counters()["pdo_lost"]
        == decoder.read_counters()["pdo_short"]
        == decoder.read_counters()["pdo_long"]
        == 0
    )
    return [record for record in records if isinstance(record, AxisSamples | TickTimes)]


def concatenate_samples(records: list[AxisSamples | TickTimes], name: str) -> Float:
    return np.concatenate([getattr(block, name) for block in records if isinstance(block, AxisSamples)])


@LED
def test_same_motion_is_decoded_from_every_vendors_drive(outfit: VendorDrive, tmp_path: Path) -> None:
    twin = start_drives(build_vendor_config(outfit, tmp_path))
    records = decode_motion(twin, 1, 720.0 if outfit.narrow else 200.0, tmp_path)
    demand, position, speed, current = (
        concatenate_samples(records, name) for name in ("demand_mm", "position_mm", "speed_rad_s", "current_a")
    )
    assert np.all(np.diff(concatenate_samples(records, "tick")) == 1)
    assert np.abs(demand - position).max() < 0.1
    travel = np.cumsum((speed[1:] + speed[:-1]) / 2) * 1e-3 * 20 / (2 * np.pi)
    assert np.abs(travel - (position[1:] - position[0])).max() < 0.3
    cruise = np.abs(speed) > 0.999 * CRUISE_RAD_S
    assert np.median(np.abs(current[cruise])) == pytest.approx(CRUISE_A, rel=0.02)
    assert np.all(np.sign(np.median(current[speed > 150])) == 1)
    if outfit.name == "epos4":
        voltage = concatenate_samples(records, "voltage_v")
        expected = R * CRUISE_A + K * CRUISE_RAD_S
        assert np.median(voltage[speed > 0.999 * CRUISE_RAD_S]) == pytest.approx(expected, rel=0.01)
        assert np.median(voltage[speed < -0.999 * CRUISE_RAD_S]) == pytest.approx(-expected, rel=0.01)


@pytest.mark.parametrize("outfit", IDENTIFIED, ids=lambda outfit: outfit.name)
def test_vendors_drive_is_identified(outfit: VendorDrive, tmp_path: Path) -> None:
    """Also with the voltage as an unsigned duty, speed in rpm and current in 16 bits."""
    config = build_vendor_config(outfit, tmp_path, noise=True)
    records = decode_motion(start_drives(config), 1, 900.0 if outfit.narrow else 300.0, tmp_path)
    pipeline, moves = AxisPipeline("X", config), InferredMoves("X", config)
    outcomes = []
    for record in records:
        outcomes += pipeline.process_record(record)
        for move in moves.detect_moves(record) if isinstance(record, AxisSamples) else ():
            outcomes += pipeline.process_record(move)
    windows = [outcome for outcome in outcomes if isinstance(outcome, WindowOutcome)]
    assert [window.verdict.reasons for window in windows if not window.verdict.accepted] == []
    assert len(windows) == 2
    for window in windows:
        assert window.estimate is not None
        found = dict(zip(window.estimate.names, window.estimate.values, strict=True))
        assert found["Jt"] == pytest.approx(0.075, rel=0.01)
        assert found["Cd"] == pytest.approx(5.0, rel=0.02)
        if outfit.name == "epos4":
            assert (found["R"], found["K"]) == (pytest.approx(R, rel=0.01), pytest.approx(K, rel=0.01))
