"""Re-analysis of stored windows: the command line with a real database and real workers."""

from __future__ import annotations

import asyncio
import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fdhil.config import Identification
from fdhil.config.fleet_config import load_fleet_config
from fdhil.errors import StoreError
from fdhil.fleet import reanalysis, window_files
from fdhil.fleet.parameter_sets import open_database
from fdhil.fleet.window_reanalysis import AnalysisMethod, compute_code_digest
from fdhil.fleet.worker_pools import WindowCrew, open_worker_pool
from fdhil.pipeline import analyse_window
from fdhil.records import Reason, WindowOutcome
from tests.daemon.machine_rig import fdhil
from tests.fleet.fleet_database import build_fleet, collect_messages, list_messages
from tests.fleet.recording_machine import RecordingMachine, write_history
from tests.fleet.servers import Postgres, is_listening, list_children, wait_until
from tests.free_ports import find_free_port
from tests.identification.bench_recordings import find_noisy_windows

pytestmark = pytest.mark.debian
BEFORE = Identification(method="least_squares")
EACH = 6  # windows of a machine
ROWS = "SELECT machine, window_name, digest, result::text FROM fleet.reanalysed_windows ORDER BY 1, 2"


@pytest.fixture
def fleet_settings(database: Postgres, tmp_path: Path) -> Path:
    """Two machines whose windows are collected, analysed by the old method; the last of each was refused."""
    for k in range(2):
        machine = RecordingMachine(
            write_history(tmp_path / str(k), f"mill-{k}", windows="all", labels={"type": "V-800"})
        )
        for seed in range(EACH):
            window = find_noisy_windows(0.003, 100 * k + seed, moves=2)[seed % 2]
            found = analyse_window(window, BEFORE)
            assert found.verdict.accepted
            assert machine.store.store_outcomes([found if seed < EACH - 1 else run_refused(found)]) == []
        machine.close_store()
        asyncio.run(collect_messages(build_fleet(database, tmp_path), list_messages(machine, with_windows=True)))
    file = tmp_path / "fleet.toml"
    file.write_text(f'[database]\nconnection = "{database.connection}"\n[objects]\ndirectory = "objects"\n')
    return file


def run_refused(found: WindowOutcome) -> WindowOutcome:
    """Return an outcome as an older fdhil may have refused it."""
    return replace(
        found, verdict=replace(found.verdict, accepted=False, reasons=(Reason("Unexplained", "12 um left"),))
    )


def run_query(capsys: pytest.CaptureFixture[str], code: int, *words: object) -> dict[str, Any]:
    """Reanalyse without further processes, and return the document."""
    found, out, err = fdhil("fleet", "reanalyse", *map(str, words), "--workers", "0", "--json", capsys=capsys)
    assert (found, err) == (code, "")
    document: dict[str, Any] = json.loads(out)
    assert document["schema"] == "fdhil-fleet-reanalyse-1"
    return document


def test_new_method_creates_revision_next_to_results(
    fleet_settings: Path, database: Postgres, capsys: pytest.CaptureFixture[str]
) -> None:
    before = database.execute_query("SELECT * FROM fleet.records ORDER BY machine, message")
    same = run_query(capsys, 0, fleet_settings, "--method", "least_squares")
    assert (same["windows"], same["without_config"], same["unreadable"]) == (12, 12, 0)
    assert {each["change"] for each in same["moved"]} == {0.0}  # the bits of the machine itself
    assert {each["windows"] for each in same["moved"]} == {10}
    assert [(v["label"], v["accepted"], v["reason"], v["windows"]) for v in same["verdicts"]] == [
        ("V-800", True, "Unexplained", 2)
    ]
    assert {each["machine"] for each in same["listed"]} == {"mill-0", "mill-1"}

    part = run_query(capsys, 0, fleet_settings, "--machine", "mill-1", "--method", "partial_moments")
    assert (part["revision"], part["windows"]) == (2, 6)
    whole = run_query(capsys, 0, fleet_settings, "--method", "partial_moments")
    assert (whole["revision"], whole["windows"]) == (2, 12)
    of_ft = next(each for each in whole["moved"] if each["parameter"] == "ft")
    assert 0 < of_ft["off"] <= of_ft["most"]
    assert of_ft["unit"] == "N.m.s"
    assert (
        run_query(capsys, 0, fleet_settings, "--method", "partial_moments")["digest"]
        == whole["digest"]
        != same["digest"]
    )
    assert database.execute_query("SELECT * FROM fleet.records ORDER BY machine, message") == before
    assert database.execute_query("SELECT revision, count(*) FROM fleet.reanalysed GROUP BY 1 ORDER BY 1") == [
        (1, 12),
        (2, 12),
    ]

    code, text, _ = fdhil(
        "fleet", "reanalyse", fleet_settings, "--workers", "0", "--method", "partial_moments", capsys=capsys
    )
    assert code == 0
    assert "revision 2: 12 windows analysed again, 12 of them without a configuration" in text
    assert "2 windows newly accepted, was refused for Unexplained" in text


def test_time_and_axis_limit_reanalysis(fleet_settings: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_query(capsys, 0, fleet_settings, "--until", "2020-01-01", "--method", "least_squares")["windows"] == 0
    assert run_query(capsys, 0, fleet_settings, "--axis", "Y", "--method", "least_squares")["windows"] == 0
    assert run_query(capsys, 0, fleet_settings, "--since", "2020-01-01", "--method", "least_squares")["windows"] == 12


def test_window_is_assessed_with_machine_configuration(
    fleet_settings: Path, tmp_path: Path, database: Postgres, capsys: pytest.CaptureFixture[str]
) -> None:
    reported = run_query(
        capsys, 0, fleet_settings, "--method", "least_squares", "--config", tmp_path / "1" / "machine.toml"
    )
    assert (reported["windows"], reported["without_config"]) == (12, 6)
    query = "SELECT DISTINCT machine, unexplained_um IS NULL FROM fleet.reanalysed ORDER BY 1"
    assert database.execute_query(query) == [("mill-0", True), ("mill-1", False)]


def test_unreadable_window_is_reported_and_retried(
    fleet_settings: Path, tmp_path: Path, database: Postgres, capsys: pytest.CaptureFixture[str]
) -> None:
    ((name,),) = database.execute_query(
        "SELECT window_name FROM fleet.windows WHERE window_name > '' ORDER BY machine, number LIMIT 1"
    )
    path = window_files.build_window_path(tmp_path / "objects", name)
    content = path.read_bytes()
    path.write_bytes(content[:-100])
    reported = run_query(capsys, 3, fleet_settings, "--method", "least_squares")
    assert (reported["windows"], reported["unreadable"]) == (12, 1)
    assert ["damaged" in (each["error"] or "") for each in reported["listed"]].count(True) == 1
    assert run_query(capsys, 3, fleet_settings, "--method", "least_squares")["digest"] == reported["digest"]
    path.write_bytes(content)
    again = run_query(capsys, 0, fleet_settings, "--method", "least_squares")
    assert (again["windows"], again["unreadable"]) == (12, 0)


def test_killed_reanalysis_resumes_to_identical_results(
    fleet_settings: Path, database: Postgres, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = run_query(capsys, 0, fleet_settings, "--method", "least_squares")
    alone = database.execute_query(ROWS)
    database.execute_query("TRUNCATE fleet.reanalyses RESTART IDENTITY CASCADE")
    code = f"""
from tests.fleet.test_reanalysis import analyse_slowly
analyse_slowly({str(fleet_settings)!r})
"""
    process = subprocess.Popen([sys.executable, "-c", code])
    wait_until(lambda: len(database.execute_query(ROWS)) >= 4, "some windows are done")
    helpers = list_children(process.pid)
    assert len(helpers) >= 2
    process.send_signal(signal.SIGKILL)
    process.wait()
    wait_until(lambda: not any(map(count_runs, helpers)), "its workers have ended with it")
    held = "SELECT 1 FROM pg_locks WHERE locktype = 'advisory'"
    wait_until(lambda: database.execute_query(held) == [], "the database has seen that it is gone")
    done = len(database.execute_query(ROWS))
    assert done == 4
    reported: list[tuple[int, int]] = []
    with open_worker_pool(None, 0, per_task=1) as pool:
        resume_run(fleet_settings, pool, lambda *far: reported.append(far))
    assert reported == [(k, 12 - done) for k in range(13 - done)]  # what was done is not done again
    assert database.execute_query(ROWS) == alone
    assert run_query(capsys, 0, fleet_settings, "--method", "least_squares")["digest"] == whole["digest"]


def count_runs(pid: int) -> bool:
    """Whether a process runs; zombies do not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@contextmanager
def start_cluster() -> Iterator[tuple[str, subprocess.Popen[bytes], subprocess.Popen[bytes]]]:
    """Run a Dask scheduler and a worker as a user starts them; yield the address and the two processes."""
    address = f"tcp://127.0.0.1:{find_free_port()}"
    place = ["--host", "127.0.0.1", "--no-dashboard"]
    words = [
        ["scheduler", "--port", address.rpartition(":")[2], *place],
        ["worker", address, "--nthreads", "1", "--no-nanny", *place],
    ]
    dask = [sys.executable, "-m", "dask"]
    processes = [subprocess.Popen([*dask, *told], stderr=subprocess.DEVNULL) for told in words]
    try:
        wait_until(lambda: is_listening(int(words[0][2])), "the scheduler listens")
        yield address, processes[0], processes[1]
    finally:
        for process in processes:
            process.kill()
            process.wait()


def test_reanalysis_survives_lost_cluster(
    fleet_settings: Path, database: Postgres, capsys: pytest.CaptureFixture[str]
) -> None:
    alone = run_query(capsys, 0, fleet_settings, "--method", "least_squares")
    database.execute_query("TRUNCATE fleet.reanalyses RESTART IDENTITY CASCADE")
    with start_cluster() as (address, scheduler, worker):
        command = [
            sys.executable,
            "-m",
            "fdhil.cli.main",
            "fleet",
            "reanalyse",
            str(fleet_settings),
            "--scheduler",
            address,
        ]
        reported = subprocess.run([*command, "--method", "least_squares", "--json"], capture_output=True, check=True)
        assert json.loads(reported.stdout)["digest"] == alone["digest"]
        worker.send_signal(signal.SIGSTOP)  # nothing gets done
        again = subprocess.Popen([*command, "--method", "partial_moments"], stderr=subprocess.PIPE, text=True)
        wait_until(lambda: len(database.execute_query("SELECT 1 FROM fleet.reanalyses")) == 2, "it is at work")
        scheduler.kill()
        _, err = again.communicate(timeout=180)
    assert again.returncode == 3
    assert "completed windows are kept" in err
    assert len(err.splitlines()) == 1


def analyse_slowly(file: str) -> None:
    """Reanalyse with two workers, one window per task, in a process to be killed: the fourth task never ends."""
    with open_worker_pool(None, 2, per_task=1) as pool:
        resume_run(Path(file), pool, lambda done, total: time.sleep(600 if done == 4 else 0))


def resume_run(file: Path, pool: WindowCrew, progress: reanalysis.Progress) -> None:
    """Complete the revision of the old method."""
    fleet = load_fleet_config(file)
    method = AnalysisMethod(BEFORE, {}, fleet.objects.directory.resolve(), compute_code_digest())
    reanalysis.reanalyse_windows(fleet, method, reanalysis.WindowScope(), pool, progress)


def test_only_one_process_works_on_a_revision(fleet_settings: Path, database: Postgres, tmp_path: Path) -> None:
    fleet = build_fleet(database, tmp_path)
    method = AnalysisMethod(BEFORE, {}, fleet.objects.directory, compute_code_digest())
    with open_worker_pool(None, 0) as pool:
        revision = reanalysis.reanalyse_windows(fleet, method, reanalysis.WindowScope(axis="Y"), pool)
    with open_database(fleet) as other, open_worker_pool(None, 0) as pool:
        other.execute("SELECT pg_advisory_lock(%s, %s)", (reanalysis._LOCK, revision))
        with pytest.raises(StoreError, match="another fdhil fleet reanalyse"):
            reanalysis.reanalyse_windows(fleet, method, reanalysis.WindowScope(), pool)


def test_non_numeric_value_does_not_break_report(
    fleet_settings: Path, database: Postgres, capsys: pytest.CaptureFixture[str]
) -> None:
    odd = [
        '{"ft": {"value": "x"}}',
        '{"ft": {"value": 1' + "0" * 400 + "}}",
        "[1]",
        '{"ft": {"value": 1e-308}}',
        "null",
    ]
    for k, text in enumerate(odd):
        database.execute_query(
            f"""UPDATE fleet.records SET record = jsonb_set(record, '{{parameters}}', '{text}') || '{{"reasons": 7}}'
            WHERE kind = 'window' AND machine = 'mill-0' AND (record->>'number')::int = {k + 1}"""
        )
    reported = run_query(capsys, 0, fleet_settings, "--method", "least_squares")
    assert {each["windows"] for each in reported["moved"]} == {5}
