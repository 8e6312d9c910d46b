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
from fdhil.fleet.window_work import Again, Method, Stored, analyse_again
from fdhil.fleet.workers import Cluster, WindowCrew, workers
from tests.fleet import rapids
from tests.fleet.servers import children, listening
from tests.ports import free_port

Work = Callable[[Sequence[Stored]], list[Again]]


def analysed(windows: Sequence[Stored], work: Work, count: int) -> list[Again]:
    """Return the results of windows from this number of processes; a task has two windows."""
    with workers(None, count, per_task=2) as crew:
        assert not count or is_closed_to_foreigners(crew)
        return rapids.bits([again for _, results in crew.spread(work, windows) for again in results])


def is_closed_to_foreigners(crew: WindowCrew) -> bool:
    """Whether all listen on this computer alone, and the scheduler rejects clients without its certificate."""
    assert isinstance(crew.executor, Cluster)
    scheduler = crew.executor.client.cluster.scheduler.address
    host, port = scheduler.removeprefix("tls://").split(":")
    assert listening(os.getpid(), *children(os.getpid())) == {"127.0.0.1"}
    foreign = ssl.create_default_context()
    foreign.check_hostname, foreign.verify_mode = False, ssl.CERT_NONE
    with socket.create_connection((host, int(port)), timeout=60) as bare:
        try:
            with foreign.wrap_socket(bare) as talk:
                return talk.recv(1) == b""
        except (ssl.SSLError, ConnectionError):
            return True


def killing(windows: Sequence[Stored], method: Method, victim: Stored, flag: Path) -> list[Again]:
    """Analyse; the first process that meets a window dies, or, where the flag is a folder, every one."""
    if victim in windows and not flag.is_file():
        if not flag.is_dir():
            flag.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return analyse_again(windows, method)


@pytest.fixture
def windows(tmp_path: Path) -> list[Stored]:
    """Ten windows of two machines: one is missing, one is corrupted."""
    folder = tmp_path / "objects"
    kept = rapids.stored(folder, 2, 5)
    (folder / kept[2].name[:2] / f"{kept[2].name}.parquet").unlink()
    damaged, other = (folder / kept[k].name[:2] / f"{kept[k].name}.parquet" for k in (6, 5))
    damaged.write_bytes(other.read_bytes())  # a sound window, and not the one that its name says
    return kept


@pytest.mark.usefixtures("long_computation")
def test_any_number_of_workers_gives_the_same_bytes_also_when_one_is_killed(
    windows: list[Stored], tmp_path: Path
) -> None:
    method = rapids.method(tmp_path / "objects")
    alone = rapids.bits(analyse_again(windows, method))
    assert len(alone) == 10
    assert sum('"error"' in again.text for again in alone) == 2
    assert "cannot be read" in alone[[again.window for again in alone].index(windows[2])].text
    assert "damaged" in alone[[again.window for again in alone].index(windows[6])].text
    assert analysed(windows, partial(analyse_again, method=method), 0) == alone
    work = partial(killing, method=method, victim=windows[4], flag=tmp_path / "died")
    assert analysed(windows, work, 2) == alone
    assert (tmp_path / "died").is_file()


@pytest.mark.debian
@pytest.mark.parametrize("count", [1, 3])
def test_one_worker_or_three_give_the_same_bytes_as_none(count: int, windows: list[Stored], tmp_path: Path) -> None:
    method = rapids.method(tmp_path / "objects", None)
    work = partial(analyse_again, method=method)
    assert analysed(windows, work, count) == rapids.bits(work(windows))


@pytest.mark.debian
def test_a_window_that_kills_every_worker_is_one_row_with_its_error(windows: list[Stored], tmp_path: Path) -> None:
    method = rapids.method(tmp_path / "objects")
    (tmp_path / "always").mkdir()
    work = partial(killing, method=method, victim=windows[0], flag=tmp_path / "always")
    with config.set({"distributed.scheduler.allowed-failures": 0}):
        results = analysed(windows[:4], work, 1)
    assert len(results) == 4
    (lost,) = [again for again in results if "WorkerDied" in again.text]
    assert lost.window == windows[0]
    sound = rapids.bits(analyse_again(windows[1:4], method))
    assert [again for again in results if again is not lost] == sound


def test_a_worker_with_other_code_or_without_the_windows_is_refused(windows: list[Stored], tmp_path: Path) -> None:
    method = rapids.method(tmp_path / "objects")
    with pytest.raises(FdhilError, match="has another fdhil"):
        analyse_again(windows, Method(method.settings, {}, method.folder, "of another"))
    with pytest.raises(FdhilError, match="cannot read"):
        analyse_again(windows, rapids.method(tmp_path / "elsewhere"))


@pytest.mark.usefixtures("processes")
def test_a_scheduler_that_is_not_there_is_told(tmp_path: Path) -> None:
    """In a separate process: the library leaves a thread behind when it finds no scheduler."""
    (tmp_path / "fleet.toml").write_text("")
    quick = f"from fdhil.cli.main import main; import {workers.__module__} as pools; pools.CONNECT_S = 2; main()"
    command = [sys.executable, "-c", quick, "fleet", "reanalyse", str(tmp_path / "fleet.toml")]
    told = subprocess.run([*command, "--scheduler", f"tcp://127.0.0.1:{free_port()}"], capture_output=True, text=True)
    assert (told.returncode, told.stdout) == (3, "")
    assert "does not respond" in told.stderr
    assert len(told.stderr.splitlines()) == 1
