"""The configured control loops are compared with those identified from the drive's last rapids."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fdhil import config as configuration
from fdhil.cli.loops_view import format_loop_status
from fdhil.commissioning.config_check import compare_loops
from fdhil.daemon.outcome_json import build_loops_document
from fdhil.records import LoopEstimate, Reason, Verdict, freeze_array
from fdhil.store.history_database import History
from fdhil.store.history_rows import TimeStamp
from tests.bench import bench_document

DIFFER = Reason(
    "LoopsDiffer", "the configured regulators leave 34 um", "write the identified values to the configuration"
)


def build_accepted_loops(*warnings: Reason) -> LoopEstimate:
    verdict = Verdict(True, None, (), 0.3, warnings)
    return LoopEstimate(
        "X", "p_pi_pi", ("position_gain_per_s",), freeze_array([55.0]), freeze_array(np.eye(1)), verdict, 34.0
    )


def test_identified_loops_are_compared_with_configuration(tmp_path: Path) -> None:
    config = configuration.parse_config(bench_document() | {"store": {"directory": str(tmp_path)}})
    assert not list(compare_loops(config, "X"))  # before the first identification
    for found, same in ((build_accepted_loops(), True), (build_accepted_loops(DIFFER), False)):
        history = History.open(tmp_path)
        history.add_loops(found, TimeStamp(0.0, "boot-1", 1))
        history.close()
        (finding,) = compare_loops(config, "X")
        assert finding.ok is same
    assert "position_gain_per_s 55" in finding.found
    assert (finding.cause, finding.advice) == (DIFFER.text, DIFFER.advice)


def test_status_reports_loops_that_differ_from_configuration() -> None:
    assert format_loop_status(build_loops_document(build_accepted_loops())) == ""
    assert "LoopsDiffer: the configured regulators leave 34 um" in format_loop_status(
        build_loops_document(build_accepted_loops(DIFFER))
    )
