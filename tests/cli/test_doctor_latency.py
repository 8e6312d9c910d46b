"""``fdhil doctor --latency``: wake-up latency of a PC as a histogram; a slow PC is a problem."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from fdhil.cli.doctor.latency import examine_latency, format_histogram, format_latency, measure_latency, read_latency
from fdhil.config import MachineConfig
from tests.daemon.machine_rig import BENCH, fdhil
from tests.daemon.simulated_machine import config_of


class SleepyPc:
    def __init__(self, *late_s: float) -> None:
        self._late_s, self._count, self._now_s = late_s, 0, 100.0

    def read_clock(self) -> float:
        return self._now_s

    def sleep(self, seconds: float) -> None:
        self._now_s += seconds + self._late_s[self._count % len(self._late_s)]
        self._count += 1


@pytest.fixture
def machine(tmp_path: Path) -> MachineConfig:
    (tmp_path / "machine.toml").write_text(BENCH)
    return config_of(tmp_path, ("X", "Y"))


def measure_on_sleepy_pc(machine: MachineConfig, *late_s: float, seconds: float = 1.0) -> dict[str, Any]:
    pc = SleepyPc(*late_s)
    return measure_latency(machine, seconds, pc.read_clock, pc.sleep)


def test_wake_ups_are_counted_by_latency(machine: MachineConfig) -> None:
    found = measure_on_sleepy_pc(machine, *[30e-6] * 9, 150e-6)
    assert (found["turns"], found["late"]) == (pytest.approx(1000, abs=2), 0)
    assert {top: count for top, count in found["histogram_us"] if count} == {
        50: pytest.approx(900, abs=2),
        200: pytest.approx(100, abs=2),
    }
    assert found["worst_us"] == pytest.approx(150, abs=2)
    assert list(examine_latency(found)) == []
    assert "up to 50 us" in next(format_histogram(found["histogram_us"]))


def test_slow_pc_is_reported_with_remedy(machine: MachineConfig) -> None:
    found = measure_on_sleepy_pc(machine, *[30e-6] * 99, 9e-3)
    (trouble,) = examine_latency(found)
    assert (trouble.code, trouble.grave) == ("PcLate", True)
    assert "worst 9000 us" in trouble.what
    assert found["late"] == pytest.approx(found["turns"] / 100, abs=1)
    assert format_latency(found) in trouble.what


def test_doctor_measures_stores_and_reports_latency(machine: MachineConfig, tmp_path: Path, capsys: Any) -> None:
    _, out, err = fdhil("doctor", tmp_path / "machine.toml", "--offline", "--latency", "1", capsys=capsys)
    assert "wake-ups every 1 ms: median latency" in out
    kept = read_latency(machine)
    assert kept is not None
    assert f"{kept['turns']} wake-ups" in out
    assert f"wrote {machine.store.directory / 'latency.json'}" in err
    _, out, _ = fdhil("doctor", tmp_path / "machine.toml", "--offline", "--latency", "1", "--json", capsys=capsys)
    assert json.loads(out)["latency"]["schema"] == "fdhil-latency-1"
    (machine.store.directory / "latency.json").write_text("[]")
    assert read_latency(machine) is None
