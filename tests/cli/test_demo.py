"""The realistic machine of the demonstration: configuration, page, and refused corrections."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fdhil import config as machine_config
from fdhil.cli.demo import _describe_realistic, realistic_machine, realistic_page
from fdhil.cli.demo.demo_page import CutPass, Published
from fdhil.cli.demo.machines import REAL, load_machine_document
from fdhil.cli.demo.realistic_machine import AxisOutcome, RealisticResult, run_realistic_in_process
from fdhil.config import Reality
from fdhil.errors import ConnectError, DeviceTimeout, FdhilError
from fdhil.records import PARAMETERS, Parameters
from fdhil.report import Page, write_page

SHIPPED = Path(__file__).parents[2] / "configs" / "realistic.toml"
TRUE = Parameters(0.5, 0.005, 0.8, 0.075, 0.05, 5.0)
WAY = np.column_stack([np.linspace(0, 10, 50), np.zeros(50)])


def load_machine() -> machine_config.MachineConfig:
    return machine_config.parse_config(load_machine_document(REAL))


def make_passes(*labels: str) -> list[CutPass]:
    return [CutPass(label, 20.0, WAY, WAY, np.full(50, 8.0 / 4.0**n), 0) for n, label in enumerate(labels)]


def make_published_set() -> Published:
    names = (*PARAMETERS, "load")
    return Published(TRUE.replace_values(Jt=0.0751, load=2.5), dict.fromkeys(names, 1e-3), 20.0)


def test_shipped_configuration_equals_demo_machine() -> None:
    shipped, shown = machine_config.load_config(SHIPPED), load_machine()
    assert {axis: twin.reality for axis, twin in shipped.sim.axis.items()} == {
        axis: twin.reality for axis, twin in shown.sim.axis.items()
    }
    assert {axis: section.resonance_hz for axis, section in shipped.axis.items()} == {"X": 120.0, "Y": 120.0}
    assert {axis: section.resonance_hz for axis, section in shown.axis.items()} == {"X": 120.0, "Y": 120.0}
    assert Reality() not in [twin.reality for twin in shown.sim.axis.values()]


def test_refusal_is_reported_with_reasons(tmp_path: Path) -> None:
    refused = RealisticResult(
        load_machine(),
        dict.fromkeys("XY", TRUE),
        dict.fromkeys("XY", AxisOutcome(None, 0, 4, {"Implausible": 4})),
        None,
        make_passes("uncorrected"),
        "the daemon refuses the request arm: ModelNotValidated",
    )
    section = realistic_page.build_section(refused)
    assert "ModelNotValidated" in section.text
    assert realistic_page.build_headline(refused)[1] == "refused"
    assert realistic_page.list_verdict_rows(refused)[0] == ["X", "0 of 4", "none published", "4 x Implausible"]
    assert realistic_page.list_parameter_rows(refused) == []
    assert ["load_nm", "", "2.5"] in realistic_page.list_effect_rows(refused)
    write_page(Page("title", "subtitle", [realistic_page.build_headline(refused)], [section]), tmp_path / "report.html")
    assert "0 of 4" in (tmp_path / "report.html").read_text("utf-8")
    reported = _describe_realistic(refused)
    assert reported["axes"]["X"]["parameters"] is None
    assert reported["refused"]


def test_report_shows_identified_next_to_true_parameters() -> None:
    verdict = AxisOutcome(make_published_set(), 4, 4, {})
    accepted = RealisticResult(
        load_machine(), {"X": TRUE}, {"X": verdict}, None, make_passes("uncorrected", "inverse"), ""
    )
    assert realistic_page.build_headline(accepted) == ("on a realistic machine reduced by", "4.0 x")
    rows = realistic_page.list_parameter_rows(accepted)
    assert [row[1] for row in rows] == [*PARAMETERS, "load"]
    assert rows[-1][3] == "2.500 ±0.002 N.m"
    assert realistic_page.list_verdict_rows(accepted)[0] == ["X", "4 of 4", "six parameters and load", ""]
    reported = _describe_realistic(accepted)
    assert reported["axes"]["X"]["terms"] == {"load": 2.5}
    assert [cut["label"] for cut in reported["cuts"]] == ["uncorrected", "inverse"]


def ignore_progress(text: str) -> None:
    """Print nothing."""


@pytest.mark.usefixtures("processes")
def test_realistic_result_is_returned_from_its_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = RealisticResult(load_machine(), {"X": TRUE}, {}, None, make_passes("uncorrected"), "refused")
    monkeypatch.setattr(realistic_machine, "run_realistic", lambda *_: found)
    with run_realistic_in_process(tmp_path, False, ignore_progress) as result:
        reported = result()
    assert (reported.config, reported.truth, reported.refused) == (found.config, found.truth, found.refused)
    np.testing.assert_array_equal(reported.cuts[0].contour_um, found.cuts[0].contour_um)


def time_out(*_: object) -> RealisticResult:
    raise DeviceTimeout("simulated machine", "no event")


def end_early(*_: object) -> RealisticResult:
    os._exit(1)


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize(
    ("run", "kind", "text"),
    [(time_out, DeviceTimeout, "simulated machine: no event"), (end_early, ConnectError, "its process ended early")],
)
def test_failure_of_realistic_process_fails_the_demo(
    run: Callable[..., RealisticResult],
    kind: type[FdhilError],
    text: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(realistic_machine, "run_realistic", run)
    with run_realistic_in_process(tmp_path, False, ignore_progress) as result, pytest.raises(kind, match=text):
        result()


@pytest.mark.usefixtures("processes")
def test_realistic_process_stops_in_order_when_demo_ends_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(out: Path, *_: object) -> RealisticResult:
        try:
            (out / "runs").touch()
            signal.pause()
        finally:
            (out / "stopped").touch()
        raise AssertionError

    monkeypatch.setattr(realistic_machine, "run_realistic", run)
    with run_realistic_in_process(tmp_path, False, ignore_progress):
        while not (tmp_path / "runs").exists():
            time.sleep(0.01)
    assert (tmp_path / "stopped").exists()


RUNNING = """
import sys
from pathlib import Path
from fdhil.child_process import interrupt_on_stop_signals
from fdhil.cli.demo import loop
from fdhil.cli.demo.machines import load_machine_document
loop._commission_axes = lambda stage: None  # arming is not needed here
with (
    interrupt_on_stop_signals(),
    loop.start_machine(Path(sys.argv[1]), False, lambda text: None, load_machine_document()) as stage,
):
    is_known = lambda: stage.ask_daemon("status")["may_stand"]["nothing"]
    loop._wait_until(is_known, "the guard did not read the drives", stage)
    print(stage.simulator.pid, *(process.pid for process in stage.others), flush=True)
    sys.stdin.read()
"""


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_all_processes_end_with_the_demo(number: signal.Signals, tmp_path: Path) -> None:
    command = [sys.executable, "-c", RUNNING, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as demo:
        assert demo.stdout is not None
        children = [os.pidfd_open(int(pid)) for pid in demo.stdout.readline().split()]
        assert len(children) == 3
        demo.send_signal(number)
        for child in children:
            select.select([child], (), ())
            os.close(child)
        demo.communicate()
    assert (tmp_path / "daemon.log").read_text().splitlines()[-1].endswith("stopped, offset 0")
