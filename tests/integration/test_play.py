"""fdhil play instead of the NC, with a guard that corrects the played program."""

from __future__ import annotations

import struct
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.arming.operator_token import read_token
from tests.bench import bench_document
from tests.integration.conftest import Bench
from tests.integration.test_guard import DIGEST, arm, guarded, missed_until_it_is_waited_for

pytestmark = pytest.mark.socketcan
QUICK = """
from fdhil.commissioning import sync_cycle, commissioning_steps, drive_survey
from fdhil.drivers.can import sdo_channel
drive_survey.LISTEN_S, commissioning_steps.SETTLE_CYCLES = 0.3, 50
sdo_channel.RESPONSE_TIMEOUT_S, sdo_channel.DEADLINE_S = 5.0, 30.0
# a guard on a virtual machine's one processor may sleep for longer than it has a limit for
sync_cycle.GUARD_WAIT_S = 8.0
from fdhil.cli.main import main
main()
"""


@pytest.fixture
def transport() -> str:
    return "socketcan"


@pytest.fixture
def sections() -> dict[str, Any]:
    limits = {"setpoints": {"travel_mm": [-1.0, 20.0]}}
    axes = {name: axis | limits for name, axis in bench_document()["axis"].items()}
    return {
        "sim": {"pace": "lockstep", "modbus": False},
        "guard": {"clock": "sync"},
        "play": {"heartbeat_s": 1.0},
        "axis": axes,
    }


def test_correction_works_with_the_played_program(bench: Bench, tmp_path: Path) -> None:
    way = np.concatenate([np.zeros(20), 2.5 * (1 - np.cos(np.linspace(0, np.pi, 500))), np.full(100, 5.0)])
    demand = tmp_path / "demand.csv"
    rows = [f"{k * 0.001:.3f},{x:.6f},{x:.6f}" for k, x in enumerate(way)]
    demand.write_text("time_s,X_mm,Y_mm\n" + "\n".join(rows) + "\n", "utf-8")
    bump = np.round(100 * np.sin(np.linspace(0, np.pi, way.size)) ** 2).astype(int).tolist()
    increments = np.round(way * 65536 / 20).astype(int).tolist()
    with guarded(bench, tmp_path) as guard:
        command = ["play", demand, "--config", tmp_path / "machine.toml", "--yes", "--hold"]
        with subprocess.Popen(
            [sys.executable, "-c", QUICK, *map(str, command)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as play:
            assert play.stderr is not None
            result = []
            for line in play.stderr:
                result.append(line)
                if "press Enter" in line:
                    break
            else:
                pytest.fail("".join(result))
            loaded = guard.load_table(("X", "Y"), {"X": increments, "Y": increments}, {"X": bump, "Y": bump}, DIGEST)
            assert loaded["ok"], loaded
            run = bench.config.store.run_directory
            assert run is not None
            assert arm(guard, read_token(run))["state"] == "ARMED"
            missed_until_it_is_waited_for(guard)
            with bench.join() as bus:
                assert play.stdin is not None
                play.stdin.write("\n")
                play.stdin.flush()
                bus.set_filters([{"can_id": 0x301, "can_mask": 0x7FF, "extended": False}])
                offsets = []
                while play.poll() is None:
                    guard.send_alive()
                    time.sleep(0.02)
                    while (frame := bus.recv(0)) is not None:
                        if frame.arbitration_id == 0x301:
                            offsets.append(struct.unpack("<i", frame.data)[0])
            output, err = play.communicate()
        assert play.returncode == 0, output + err
        assert max(offsets) == 100, guard.read_status()
        assert offsets[-1] == 0
        assert guard.read_status()["state"] == "OFF"
        # what play wrote to the drives and gave back does not void their records
        assert not any(axis["record_void"] for axis in guard.read_status().get("axes", {}).values())
