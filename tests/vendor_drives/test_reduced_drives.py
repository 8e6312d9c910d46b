"""A cut on drives of every vendor: corrected on line by the offset, or by a corrected demand given to the NC."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fdhil import correction
from fdhil.arming.guard_configuration import make_guard_settings
from fdhil.cia402 import pack_pdo
from fdhil.prediction.contour_error import compute_contour_error_um
from fdhil.records import Float, Parameters, Trajectory, compute_rms, freeze_array
from tests.sim.bench_simulator import PERIOD_S, SteppedSimulator, build_corner_rows, build_trajectory
from tests.vendor_drives.vendor_machines import LED, OUTFITS, VendorDrive, build_vendor_config, start_drives

DELAY = 2


def play_demand(
    twin: SteppedSimulator, demand: Trajectory, path: Float, offset_um: dict[str, Float] | None = None
) -> float:
    """Run a demand on the NC with the offsets of each cycle; return the contour error (RMS, um) to the path (n, 2)."""
    table: list[list[float]] = []
    senders = []
    if offset_um:
        settings = make_guard_settings(twin.machine.config, "can0", Path(), "")
        senders = [(axis.offset, offset_um[axis.name] * 1e-3 * axis.increments_per_mm) for axis in settings.axes]

    def each_cycle() -> None:
        row = twin.machine.nc.in_force
        if row is None or not row.playing:
            return
        table.append([unit.drive.table_mm for unit in twin.machine.units.values()])
        following = len(table) + DELAY  # the row whose target has just been sent
        for pdo, increments in senders:
            value = round(increments[following]) if following < increments.size else 0
            twin.machine.receive_frame("can0", (pdo.cob_id, pack_pdo(pdo.entries, [value])))

    twin.each_cycle = each_cycle
    twin.machine.nc.play_demand("cut", demand)
    twin.run_until("finished")
    actual = np.array(table)[: len(path)]
    return compute_rms(compute_contour_error_um(path, actual, PERIOD_S))


@pytest.mark.usefixtures("long_computation")
@LED
def test_corrected_cut_has_smaller_error(outfit: VendorDrive, tmp_path: Path) -> None:
    config = build_vendor_config(outfit, tmp_path, "XY")
    twin = start_drives(config)
    path = np.vstack([np.zeros((40, 2)), build_corner_rows(), np.tile(build_corner_rows()[-1:], (100, 1))])
    demand = build_trajectory(path)
    models = {axis: Parameters(**settings.nominal.model_dump()) for axis, settings in config.axis.items()}
    planned = correction.plan_correction(demand, models, config, "inverse")
    before = play_demand(twin, demand, path)
    if outfit.on_line:
        after = play_demand(twin, demand, path, dict(planned.offset_um))
    else:
        moved = {axis: freeze_array(demand.position_mm[axis] + planned.offset_um[axis] * 1e-3) for axis in demand.axes}
        after = play_demand(twin, Trajectory(PERIOD_S, demand.time_s, moved, demand.rapid, demand.line), path)
    assert before > 20
    assert after < before / 10


@pytest.mark.parametrize("outfit", [o for o in OUTFITS if not o.led], ids=lambda outfit: outfit.name)
def test_drive_without_cyclic_set_points_cannot_be_commanded(outfit: VendorDrive, tmp_path: Path) -> None:
    twin = start_drives(build_vendor_config(outfit, tmp_path))
    twin.run_cycles(20)
    (text,) = [event["text"] for event in twin.events if event["event"] == "error"]
    assert text.startswith("drive X refuses 6060 = 8 with SDO abort 06090030")
