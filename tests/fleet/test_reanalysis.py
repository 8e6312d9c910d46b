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
from fdhil.fleet import objects, reanalysis
from fdhil.fleet.sets import entered
from fdhil.fleet.window_work import Method, code_digest
from fdhil.fleet.workers import WindowCrew, workers
from fdhil.pipeline import analyse
from fdhil.records import Reason, WindowOutcome
from tests.daemon.machine_rig import fdhil
from tests.fleet.machine import Machine, written
from tests.fleet.servers import Postgres, children, listens, until
from tests.fleet.works import fleet_of, gather, told_by
from tests.identification.recorded import windows
from tests.ports import free_port

pytestmark = pytest.mark.debian
BEFORE = Identification(method="least_squares")
EACH = 6  # windows of a machine
ROWS = "SELECT machine, window_name, digest, result::text FROM fleet.reanalysed_windows ORDER BY 1, 2"


@pytest.fixture
def works(database: Postgres, tmp_path: Path) -> Path:
    """Two machines whose windows are collected, analysed by the old method; the last of each was refused."""
    for k in range(2):
        machine = Machine(written(tmp_path / str(k), f"mill-{k}", windows="all", labels={"type": "V-800"}))
        for seed in range(EACH):
            window = windows(0.003, 100 * k + seed, moves=2)[seed % 2]
            found = analyse(window, BEFORE)
            assert found.verdict.accepted
            assert machine.store.store_outcomes([found if seed < EACH - 1 else refused(found)]) == []
        machine.close()
        asyncio.run(gather(fleet_of(database, tmp_path), told_by(machine, with_windows=True)))
    file = tmp_path / "fleet.toml"
    file.write_text(f'[database]\nconnection = "{database.connection}"\n[objects]\ndirectory = "objects"\n')
    return file


def refused(found: WindowOutcome) -> WindowOutcome:
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


def test_a_new_method_is_a_revision_beside_what_was_found(
    works: Path, database: Postgres, capsys: pytest.CaptureFixture[str]
) -> None:
    before = database.ask("SELECT * FROM fleet.records ORDER BY machine, message")
    same = run_query(capsys, 0, works, "--method", "least_squares")
    assert (same["windows"], same["without_config"], same["unreadable"]) == (12, 12, 0)
    assert {each["change"] for each in same["moved"]} == {0.0}  # the bits of the machine itself
    assert {each["windows"] for each in same["moved"]} == {10}
    assert [(v["label"], v["accepted"], v["reason"], v["windows"]) for v in same["verdicts"]] == [
        ("V-800", True, "Unexplained", 2)
    ]
    assert {each["machine"] for each in same["listed"]} == {"mill-0", "mill-1"}

    part = run_query(capsys, 0, works, "--machine", "mill-1", "--method", "partial_moments")
    assert (part["revision"], part["windows"]) == (2, 6)
    whole = run_query(capsys, 0, works, "--method", "partial_moments")
    assert (whole["revision"], whole["windows"]) == (2, 12)
    of_ft = next(each for each in whole["moved"] if each["parameter"] == "ft")
    assert 0 < of_ft["off"] <= of_ft["most"]
    assert of_ft["unit"] == "N.m.s"
    assert run_query(capsys, 0, works, "--method", "partial_moments")["digest"] == whole["digest"] != same["digest"]
    assert database.ask("SELECT * FROM fleet.records ORDER BY machine, message") == before
    assert database.ask("SELECT revision, count(*) FROM fleet.reanalysed GROUP BY 1 ORDER BY 1") == [(1, 12), (2, 12)]

    code, text, _ = fdhil("fleet", "reanalyse", works, "--workers", "0", "--method", "partial_moments", capsys=capsys)
    assert code == 0
    assert "revision 2: 12 windows analysed again, 12 of them without a configuration" in text
    assert "2 windows newly accepted, was refused for Unexplained" in text


def test_the_time_and_the_axis_bound_it(works: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_query(capsys, 0, works, "--until", "2020-01-01", "--method", "least_squares")["windows"] == 0
    assert run_query(capsys, 0, works, "--axis", "Y", "--method", "least_squares")["windows"] == 0
    assert run_query(capsys, 0, works, "--since", "2020-01-01", "--method", "least_squares")["windows"] == 12


def test_with_the_configuration_of_its_machine_a_window_is_weighed(
    works: Path, tmp_path: Path, database: Postgres, capsys: pytest.CaptureFixture[str]
) -> None:
    told = run_query(capsys, 0, works, "--method", "least_squares", "--config", tmp_path / "1" / "machine.toml")
    assert (told["windows"], told["without_config"]) == (12, 6)
    query = "SELECT DISTINCT machine, unexplained_um IS NULL FROM fleet.reanalysed ORDER BY 1"
    assert database.ask(query) == [("mill-0", True), ("mill-1", False)]


def test_what_cannot_be_read_is_told_and_tried_again(
    works: Path, tmp_path: Path, database: Postgres, capsys: pytest.CaptureFixture[str]
) -> None:
    ((name,),) = database.ask(
        "SELECT window_name FROM fleet.windows WHERE window_name > '' ORDER BY machine, number LIMIT 1"
    )
    path = objects.path_of(tmp_path / "objects", name)
    content = path.read_bytes()
    path.write_bytes(content[:-100])
    told = run_query(capsys, 3, works, "--method", "least_squares")
    assert (told["windows"], told["unreadable"]) == (12, 1)
    assert ["damaged" in (each["error"] or "") for each in told["listed"]].count(True) == 1
    assert run_query(capsys, 3, works, "--method", "least_squares")["digest"] == told["digest"]
    path.write_bytes(content)
    again = run_query(capsys, 0, works, "--method", "least_squares")
    assert (again["windows"], again["unreadable"]) == (12, 0)


def test_killed_in_the_middle_it_goes_on_where_it_was_to_the_same_bytes(
    works: Path, database: Postgres, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = run_query(capsys, 0, works, "--method", "least_squares")
    alone = database.ask(ROWS)
    database.ask("TRUNCATE fleet.reanalyses RESTART IDENTITY CASCADE")
    code = f"""
from tests.fleet.test_reanalysis import slowly
slowly({str(works)!r})
"""
    process = subprocess.Popen([sys.executable, "-c", code])
    until(lambda: len(database.ask(ROWS)) >= 4, "some windows are done")
    helpers = children(process.pid)
    assert len(helpers) >= 2
    process.send_signal(signal.SIGKILL)
    process.wait()
    until(lambda: not any(map(runs, helpers)), "its workers have ended with it")
    held = "SELECT 1 FROM pg_locks WHERE locktype = 'advisory'"
    until(lambda: database.ask(held) == [], "the database has seen that it is gone")
    done = len(database.ask(ROWS))
    assert done == 4
    told: list[tuple[int, int]] = []
    with workers(None, 0, per_task=1) as crew:
        resumed(works, crew, lambda *far: told.append(far))
    assert told == [(k, 12 - done) for k in range(13 - done)]  # what was done is not done again
    assert database.ask(ROWS) == alone
    assert run_query(capsys, 0, works, "--method", "least_squares")["digest"] == whole["digest"]


def runs(pid: int) -> bool:
    """Whether a process runs; zombies do not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@contextmanager
def cluster() -> Iterator[tuple[str, subprocess.Popen[bytes], subprocess.Popen[bytes]]]:
    """Run a Dask scheduler and a worker as a user starts them; yield the address and the two processes."""
    address = f"tcp://127.0.0.1:{free_port()}"
    place = ["--host", "127.0.0.1", "--no-dashboard"]
    words = [
        ["scheduler", "--port", address.rpartition(":")[2], *place],
        ["worker", address, "--nthreads", "1", "--no-nanny", *place],
    ]
    dask = [sys.executable, "-m", "dask"]
    processes = [subprocess.Popen([*dask, *told], stderr=subprocess.DEVNULL) for told in words]
    try:
        until(lambda: listens(int(words[0][2])), "the scheduler listens")
        yield address, processes[0], processes[1]
    finally:
        for process in processes:
            process.kill()
            process.wait()


def test_on_a_cluster_that_is_there_and_goes_away(
    works: Path, database: Postgres, capsys: pytest.CaptureFixture[str]
) -> None:
    alone = run_query(capsys, 0, works, "--method", "least_squares")
    database.ask("TRUNCATE fleet.reanalyses RESTART IDENTITY CASCADE")
    with cluster() as (address, scheduler, worker):
        command = [sys.executable, "-m", "fdhil.cli.main", "fleet", "reanalyse", str(works), "--scheduler", address]
        told = subprocess.run([*command, "--method", "least_squares", "--json"], capture_output=True, check=True)
        assert json.loads(told.stdout)["digest"] == alone["digest"]
        worker.send_signal(signal.SIGSTOP)  # nothing gets done
        again = subprocess.Popen([*command, "--method", "partial_moments"], stderr=subprocess.PIPE, text=True)
        until(lambda: len(database.ask("SELECT 1 FROM fleet.reanalyses")) == 2, "it is at work")
        scheduler.kill()
        _, err = again.communicate(timeout=180)
    assert again.returncode == 3
    assert "completed windows are kept" in err
    assert len(err.splitlines()) == 1


def slowly(file: str) -> None:
    """Reanalyse with two workers, one window per task, in a process to be killed: the fourth task never ends."""
    with workers(None, 2, per_task=1) as crew:
        resumed(Path(file), crew, lambda done, total: time.sleep(600 if done == 4 else 0))


def resumed(file: Path, crew: WindowCrew, progress: reanalysis.Progress) -> None:
    """Complete the revision of the old method."""
    fleet = load_fleet_config(file)
    method = Method(BEFORE, {}, fleet.objects.directory.resolve(), code_digest())
    reanalysis.reanalyse(fleet, method, reanalysis.Scope(), crew, progress)


def test_one_alone_makes_a_revision(works: Path, database: Postgres, tmp_path: Path) -> None:
    fleet = fleet_of(database, tmp_path)
    method = Method(BEFORE, {}, fleet.objects.directory, code_digest())
    with workers(None, 0) as crew:
        revision = reanalysis.reanalyse(fleet, method, reanalysis.Scope(axis="Y"), crew)
    with entered(fleet) as other, workers(None, 0) as crew:
        other.execute("SELECT pg_advisory_lock(%s, %s)", (reanalysis._LOCK, revision))
        with pytest.raises(StoreError, match="another fdhil fleet reanalyse"):
            reanalysis.reanalyse(fleet, method, reanalysis.Scope(), crew)


def test_what_a_machine_told_that_is_no_number_spoils_no_report(
    works: Path, database: Postgres, capsys: pytest.CaptureFixture[str]
) -> None:
    odd = [
        '{"ft": {"value": "x"}}',
        '{"ft": {"value": 1' + "0" * 400 + "}}",
        "[1]",
        '{"ft": {"value": 1e-308}}',
        "null",
    ]
    for k, text in enumerate(odd):
        database.ask(
            f"""UPDATE fleet.records SET record = jsonb_set(record, '{{parameters}}', '{text}') || '{{"reasons": 7}}'
            WHERE kind = 'window' AND machine = 'mill-0' AND (record->>'number')::int = {k + 1}"""
        )
    told = run_query(capsys, 0, works, "--method", "least_squares")
    assert {each["windows"] for each in told["moved"]} == {5}
