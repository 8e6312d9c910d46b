"""A program armed again applies the offsets learned in its last pass; a disturbed pass is not used."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from fdhil.arming import pass_monitor
from fdhil.arming.standstill_monitor import StandstillMonitor
from fdhil.config import MachineConfig
from fdhil.config.nc_section import Correction as Learning
from fdhil.records import Correction, MoveKind, NcState
from tests.arming.machine_peer import MachinePeer
from tests.arming.test_arm_plan import save_records
from tests.arming.test_armed_ahead_of_check import open_service
from tests.arming.test_pass_monitor import make_samples, measure_pass
from tests.daemon.simulated_machine import config_of

pytestmark = pytest.mark.usefixtures("real_time")

WAVE_MM = 2e-3


@pytest.fixture
def config(tmp_path: Path) -> MachineConfig:
    config = config_of(tmp_path, ("X", "Y")).model_copy(update={"correction": Learning(learning=True)})
    save_records(config)
    return config


async def test_next_pass_applies_learned_offsets(
    config: MachineConfig,
    machine_peer: MachinePeer,
    program: Path,
    planned: Correction,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pass_monitor, "LATE_S", 0.0)
    monkeypatch.setattr(
        StandstillMonitor, "find_standing_axes", lambda _self: {}
    )  # where an axis stands changes the first rows, too
    reference = planned.before.reference
    wave = WAVE_MM * np.sin(2 * np.pi * 3.0 * reference.time_s) * np.hanning(reference.time_s.size)
    off = {"X": planned.after.predicted_mm["X"] + wave, "Y": planned.after.predicted_mm["Y"]}
    slower = {axis: np.interp(reference.time_s * 0.9, reference.time_s, p) for axis, p in reference.position_mm.items()}
    offsets, warnings = [], []
    async with open_service(config, machine_peer) as shop:
        for number, (demand, cause) in enumerate(
            [
                (slower, "Finished"),
                (reference.position_mm, "Disarmed"),
                (reference.position_mm, "Finished"),
                (reference.position_mm, "Finished"),
            ],
            1,
        ):
            answer = await shop.arm(program)
            assert answer["ok"], answer
            warnings.append(answer["warnings"])
            offsets.append(np.array([row[2:] for row in machine_peer.rows]))
            shop.desk.take_nc_state(NcState(0, 0, MoveKind.FEED, 3, feed_override=0.8 if number == 3 else 1.0))
            for block in make_samples(demand, off if demand is not slower else demand):
                shop.desk.take_samples(block)
            machine_peer.state, machine_peer.cause = "OFF", cause
            await shop.wait_until(partial(measure_pass, shop.told, number))
        answer = await shop.arm(program)
        learned = np.array([row[2:] for row in machine_peer.rows])
    assert [told.get("learned") is not None for told in shop.desk.passes] == [False, False, False, True]
    assert shop.desk.passes[2]["text"].endswith(
        "the NC's override was 80 % in line 3: the pass is not used for learning"
    )
    assert shop.desk.passes[-1]["learned"]["passes"] == 1
    # the first arming did not know yet at which current the axes stand
    assert np.array_equal(offsets[1], offsets[3]), "a disturbed pass has taught something"
    assert not any("Learned" in text for told in warnings for text in told)
    assert any("Learned: offsets of 1 passes are added" in text for text in answer["warnings"])
    added_mm = (learned - offsets[3])[: wave.size, 0] * config.axis["X"].screw_pitch_mm / 65536
    assert np.corrcoef(added_mm, -wave)[0, 1] > 0.95
    assert not np.array_equal(learned[:, 0], offsets[3][:, 0])
    assert np.abs((learned - offsets[3])[:, 1]).max() <= 2, "Y had nothing to learn"
