"""Many recordings at once: the same answers from other processes, and how far the work is."""

from __future__ import annotations

import os
import pty
import sys
from pathlib import Path

import numpy as np
import pytest

from fdhil.cli import batch
from fdhil.cli.main import cli, run_safely
from fdhil.config import Identification
from studies import bench
from tests.identification.recorded import signals

SETTINGS = Identification()


@pytest.fixture
def recordings(tmp_path: Path) -> list[Path]:
    """Two recordings of two rapids each."""
    paths = [tmp_path / f"{k}.csv" for k in range(2)]
    for k, path in enumerate(paths):
        path.write_text(bench.as_csv(signals(moves=2), 0.003, seed=k))
    return paths


def test_each_window_and_each_pool_is_a_step_of_its_file(recordings: list[Path]) -> None:
    shares: list[float] = []
    results = list(batch.analyse_files(recordings, SETTINGS, None, shares.append))
    assert [result.file for result in results] == [str(path) for path in recordings]
    assert shares == pytest.approx([1 / 3] * 6)


@pytest.mark.parametrize("limit", ["MANY_FILES", "MANY_WINDOWS"])
def test_other_processes_give_the_same(recordings: list[Path], limit: str, monkeypatch: pytest.MonkeyPatch) -> None:
    recordings = recordings if limit == "MANY_FILES" else recordings[:1]
    alone = list(batch.analyse_files(recordings, SETTINGS))
    monkeypatch.setattr(batch, limit, 1)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    shares: list[float] = []
    together = list(batch.analyse_files(recordings, SETTINGS, None, shares.append))
    assert sum(shares) == pytest.approx(len(recordings))
    for one, other in zip(alone, together, strict=True):
        assert one.file == other.file
        assert one.pooled is not None
        assert other.pooled is not None
        np.testing.assert_allclose(one.pooled.values, other.pooled.values, rtol=1e-6)


def test_a_terminal_sees_how_far_the_work_is(recordings: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    master, slave = pty.openpty()
    with os.fdopen(slave, "w") as terminal, pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["fdhil", "identify", "--json", *map(str, recordings)])
        patch.setattr(sys, "stderr", terminal)
        assert run_safely(cli) == 0
        seen = os.read(master, 65536).decode()
    os.close(master)
    assert capsys.readouterr().out.startswith("{")
    assert "identifying" in seen
    assert "%" in seen
