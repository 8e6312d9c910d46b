"""Analysis of many recordings: identical results from several processes, and progress."""

from __future__ import annotations

import json
import os
import pty
import select
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from fdhil.cli import batch_analysis
from fdhil.cli.main import cli, run_safely
from fdhil.config import Identification
from fdhil.errors import FdhilError
from fdhil.fleet import window_files
from fdhil.fleet.window_reanalysis import reanalyse_batch
from fdhil.identification.rapid_windows import find_moving_range
from fdhil.store.window_file import read_window
from studies import bench
from tests.daemon.machine_rig import fdhil
from tests.fleet import stored_rapids
from tests.identification.bench_recordings import simulate_bench_shuttle

SETTINGS = Identification()


@pytest.fixture
def recordings(tmp_path: Path) -> list[Path]:
    paths = [tmp_path / f"{k}.csv" for k in range(2)]
    for k, path in enumerate(paths):
        path.write_text(bench.format_as_csv(simulate_bench_shuttle(moves=2), 0.003, seed=k))
    return paths


def test_progress_counts_each_window_and_pool_of_a_file(recordings: list[Path]) -> None:
    shares: list[float] = []
    results = list(batch_analysis.analyse_files(recordings, SETTINGS, None, shares.append))
    assert [result.file for result in results] == [str(path) for path in recordings]
    assert shares == pytest.approx([1 / 3] * 6)


@pytest.mark.usefixtures("real_time")
@pytest.mark.parametrize("limit", ["MANY_FILES", "MANY_WINDOWS"])
def test_parallel_analysis_gives_identical_results(
    recordings: list[Path], limit: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    recordings = recordings if limit == "MANY_FILES" else recordings[:1]
    alone = list(batch_analysis.analyse_files(recordings, SETTINGS))
    monkeypatch.setattr(batch_analysis, limit, 1)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    shares: list[float] = []
    together = list(batch_analysis.analyse_files(recordings, SETTINGS, None, shares.append))
    assert sum(shares) == pytest.approx(len(recordings))
    for one, other in zip(alone, together, strict=True):
        assert one.file == other.file
        assert one.pooled is not None
        assert other.pooled is not None
        assert one.pooled.values.tobytes() == other.pooled.values.tobytes()


@pytest.mark.usefixtures("real_time")
def test_killed_worker_is_reported_in_one_sentence(recordings: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch_analysis, "MANY_FILES", 1)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    monkeypatch.setattr(batch_analysis, "_analyse_chunk", kill_worker)
    with pytest.raises(FdhilError, match="was killed"):
        list(batch_analysis.analyse_files(recordings, SETTINGS))


def kill_worker(numbered: Any, **how: Any) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_folder_is_expanded_and_stored_window_keeps_its_bits(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "objects"
    windows = stored_rapids.store_rapids(folder, 1, 3)
    (folder / "notes.txt").write_text("no recording")
    code, out, _ = fdhil("identify", folder, "--method", "least_squares", "--json", capsys=capsys)
    files = {Path(file["file"]).stem: file for file in json.loads(out)["files"]}
    assert (code, sorted(files)) == (0, sorted(window.name for window in windows))
    for again in reanalyse_batch(windows, stored_rapids.create_method(folder)):
        (reported,) = files[again.window.name]["windows"]
        fleet = json.loads(again.text)
        window = read_window(window_files.build_window_path(folder, again.window.name))
        assert reported["start_s"] == round(
            window.start_s + find_moving_range(window)[0] * window.dt_s, 6
        )  # original time
        assert reported["validated"] == fleet["accepted"]
        assert reported["fit_percent"] == fleet["fit_percent"]
        for name, found in fleet["parameters"].items():
            assert (reported["parameters"][name]["value"], reported["parameters"][name]["std"]) == (
                found["value"],
                found["std"],
            )
    (tmp_path / "empty").mkdir()
    assert "has no recordings" in fdhil("identify", tmp_path / "empty", capsys=capsys)[2]


def test_terminal_shows_progress(recordings: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    master, slave = pty.openpty()
    with os.fdopen(slave, "w") as terminal, pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["fdhil", "identify", "--json", *map(str, recordings)])
        patch.setattr(sys, "stderr", terminal)
        assert run_safely(cli) == 0
        seen = ""
        while "identifying" not in seen or "%" not in seen:  # a terminal delivers it in arbitrary parts
            assert select.select([master], [], [], 100)[0], seen
            seen += os.read(master, 65536).decode()
    os.close(master)
    assert capsys.readouterr().out.startswith("{")


ANALYSING = """
import os, sys, time
from fdhil.cli import batch_analysis
def told(_):
    print("up", flush=True)
    time.sleep(600)
if __name__ == "__main__":
    batch_analysis._count_cores = lambda: 2
    with batch_analysis._create_process_pool() as executor:
        list(executor.map(told, range(2)))
"""


@pytest.mark.usefixtures("processes")
def test_worker_processes_end_when_command_is_killed(tmp_path: Path) -> None:
    (tmp_path / "analysing.py").write_text(ANALYSING)
    with subprocess.Popen([sys.executable, tmp_path / "analysing.py"], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"up\n"
        process.kill()
        assert process.stdout.read() in (b"", b"up\n")  # end of file: no process has it open
