"""Real Dask workers: identical results from any number, also when one is killed; strangers cannot submit work."""

from __future__ import annotations

import os
import signal
import socket
import ssl
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import pytest
from dask import config

from fdhil.errors import FdhilError
from fdhil.fleet.window_reanalysis import AnalysisMethod, ReanalysedWindow, WindowReference, reanalyse_batch
from fdhil.fleet.worker_pools import DaskExecutor, WindowCrew, open_worker_pool
from tests.fleet import stored_rapids
from tests.fleet.servers import list_children, list_listening_addresses
from tests.free_ports import find_free_port

Work = Callable[[Sequence[WindowReference]], list[ReanalysedWindow]]


def analyse_windows(windows: Sequence[WindowReference], work: Work, count: int) -> list[ReanalysedWindow]:
    """Return the results of windows from this number of processes; a task has two windows."""
    with open_worker_pool(None, count, per_task=2) as pool:
        assert not count or is_closed_to_strangers(pool)
        return stored_rapids.list_results([again for _, results in pool.run_tasks(work, windows) for again in results])


def is_closed_to_strangers(pool: WindowCrew) -> bool:
    """Whether all listen on this computer alone, and the scheduler rejects clients without its certificate."""
    assert isinstance(pool.executor, DaskExecutor)
    scheduler = pool.executor.client.cluster.scheduler.address
    host, port = scheduler.removeprefix("tls://").split(":")
    assert list_listening_addresses(os.getpid(), *list_children(os.getpid())) == {"127.0.0.1"}
    foreign = ssl.create_default_context()
    foreign.check_hostname, foreign.verify_mode = False, ssl.CERT_NONE
    with socket.create_connection((host, int(port)), timeout=60) as bare:
        try:
            with foreign.wrap_socket(bare) as talk:
                return talk.recv(1) == b""
        except (ssl.SSLError, ConnectionError):
            return True


def kill_worker(
    windows: Sequence[WindowReference], method: AnalysisMethod, victim: WindowReference, flag: Path
) -> list[ReanalysedWindow]:
    """Analyse; the first process that meets a window dies, or, where the flag is a folder, every one."""
    if victim in windows and not flag.is_file():
        if not flag.is_dir():
            flag.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return reanalyse_batch(windows, method)


@pytest.fixture
def windows(tmp_path: Path) -> list[WindowReference]:
    """Ten windows of two machines: one is missing, one is corrupted."""
    folder = tmp_path / "objects"
    kept = stored_rapids.store_rapids(folder, 2, 5)
    (folder / kept[2].name[:2] / f"{kept[2].name}.parquet").unlink()
    damaged, other = (folder / kept[k].name[:2] / f"{kept[k].name}.parquet" for k in (6, 5))
    damaged.write_bytes(other.read_bytes())  # a sound window, and not the one that its name says
    return kept


@pytest.mark.usefixtures("long_computation")
def test_results_are_identical_for_any_number_of_workers_and_kills(
    windows: list[WindowReference], tmp_path: Path
) -> None:
    method = stored_rapids.create_method(tmp_path / "objects")
    alone = stored_rapids.list_results(reanalyse_batch(windows, method))
    assert len(alone) == 10
    assert sum('"error"' in again.text for again in alone) == 2
    assert "cannot be read" in alone[[again.window for again in alone].index(windows[2])].text
    assert "damaged" in alone[[again.window for again in alone].index(windows[6])].text
    assert analyse_windows(windows, partial(reanalyse_batch, method=method), 0) == alone
    work = partial(kill_worker, method=method, victim=windows[4], flag=tmp_path / "died")
    assert analyse_windows(windows, work, 2) == alone
    assert (tmp_path / "died").is_file()


@pytest.mark.debian
@pytest.mark.parametrize("count", [1, 3])
def test_results_are_identical_for_one_or_three_workers(
    count: int, windows: list[WindowReference], tmp_path: Path
) -> None:
    method = stored_rapids.create_method(tmp_path / "objects", None)
    work = partial(reanalyse_batch, method=method)
    assert analyse_windows(windows, work, count) == stored_rapids.list_results(work(windows))


@pytest.mark.debian
def test_window_that_kills_every_worker_gets_error_result(windows: list[WindowReference], tmp_path: Path) -> None:
    method = stored_rapids.create_method(tmp_path / "objects")
    (tmp_path / "always").mkdir()
    work = partial(kill_worker, method=method, victim=windows[0], flag=tmp_path / "always")
    with config.set({"distributed.scheduler.allowed-failures": 0}):
        results = analyse_windows(windows[:4], work, 1)
    assert len(results) == 4
    (lost,) = [again for again in results if "WorkerDied" in again.text]
    assert lost.window == windows[0]
    sound = stored_rapids.list_results(reanalyse_batch(windows[1:4], method))
    assert [again for again in results if again is not lost] == sound


def test_worker_with_other_code_or_without_windows_is_refused(windows: list[WindowReference], tmp_path: Path) -> None:
    method = stored_rapids.create_method(tmp_path / "objects")
    with pytest.raises(FdhilError, match="has another fdhil"):
        reanalyse_batch(windows, AnalysisMethod(method.settings, {}, method.folder, "of another"))
    with pytest.raises(FdhilError, match="cannot read"):
        reanalyse_batch(windows, stored_rapids.create_method(tmp_path / "elsewhere"))


@pytest.mark.usefixtures("processes")
def test_unavailable_scheduler_is_reported(tmp_path: Path) -> None:
    """In a separate process: the library leaves a thread behind when it finds no scheduler."""
    (tmp_path / "fleet.toml").write_text("")
    quick = (
        f"from fdhil.cli.main import main; import {open_worker_pool.__module__} as pools; pools.CONNECT_S = 2; main()"
    )
    command = [sys.executable, "-c", quick, "fleet", "reanalyse", str(tmp_path / "fleet.toml")]
    reported = subprocess.run(
        [*command, "--scheduler", f"tcp://127.0.0.1:{find_free_port()}"], capture_output=True, text=True
    )
    assert (reported.returncode, reported.stdout) == (3, "")
    assert "does not respond" in reported.stderr
    assert len(reported.stderr.splitlines()) == 1
