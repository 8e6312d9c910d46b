"""The daemon measures its resources and reports them before they are exhausted."""

from __future__ import annotations

import asyncio
import errno
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from fdhil.daemon.daemon_socket import ask_daemon
from fdhil.daemon.resource_usage import ResourceUse, ResourceWatch, measure_usage
from tests.daemon.simulated_machine import SimulatedMachine, config_of, rapids
from tests.daemon.test_daemon_service import serving, status_when


def used() -> dict[str, int]:
    return {use.name: use.used for use in measure_usage()}


FREED = """
import numpy as np
from fdhil.daemon.malloc_tuning import limit_heap_growth
from fdhil.daemon.resource_usage import measure_usage
limit_heap_growth()
for _ in range(3):
    np.ones(3 << 20)  # by itself glibc would lay blocks of up to this size among the small ones from now on
before = measure_usage()[0].used
large, small = [], []
for _ in range(40):
    large.append(np.ones(1 << 17))
    small.append(np.ones(100))
del large
print(measure_usage()[0].used - before)
"""


@pytest.mark.usefixtures("processes")
def test_freed_large_block_is_returned_to_the_system() -> None:
    output = subprocess.run([sys.executable, "-c", FREED], capture_output=True, text=True, check=True)
    assert int(output.stdout) < 5e6  # of 42 MB


BETWEEN = """
from fdhil.daemon.malloc_tuning import trim_heap
from fdhil.daemon.resource_usage import measure_usage
small = [bytes(1000) for _ in range(40_000)]
small = small[::200]  # a used one in every 200 kB
before = measure_usage()[0].used
trim_heap()
print(before - measure_usage()[0].used)
"""


@pytest.mark.usefixtures("processes")
def test_free_pages_between_used_blocks_are_returned() -> None:
    output = subprocess.run([sys.executable, "-c", BETWEEN], capture_output=True, text=True, check=True)
    assert int(output.stdout) > 30e6  # of 40 MB


GROW = """
import os, threading
from fdhil.daemon.resource_usage import measure_usage
used = lambda: [use.used for use in measure_usage()]
before = used()
block, pipe, ended = bytearray(os.urandom(1) * 20_000_000), os.pipe(), threading.Event()
threading.Thread(target=ended.wait).start()
after = used()
ended.set()
print(*(b - a for a, b in zip(before, after)))
"""


@pytest.mark.usefixtures("processes")
@pytest.mark.fault("F10")
def test_growing_usage_is_measured() -> None:
    """Runs in its own process: what other tests left behind may end at that moment."""
    result = subprocess.run([sys.executable, "-c", GROW], capture_output=True, text=True, check=True)
    memory, descriptors, threads = map(int, result.stdout.split())
    assert 15e6 < memory < 40e6
    assert (descriptors, threads) == (2, 1)


@pytest.mark.parametrize(
    ("group", "expected"), [("0::/system.slice/fdhil.service\n", (1 << 30, 64)), ("", (None, None))]
)
def test_limits_are_those_of_the_unit(group: str, expected: tuple[int | None, int | None], tmp_path: Path) -> None:
    process, groups = tmp_path / "self", tmp_path / "cgroup"
    mine = groups / "system.slice" / "fdhil.service"
    for folder in (process / "fd", process / "task" / "1", mine):
        folder.mkdir(parents=True)
    (process / "statm").write_text("900 100 5\n")
    (process / "cgroup").write_text(group)
    (mine / "memory.max").write_text(f"{1 << 30}\n")
    (mine / "pids.max").write_text("64\n")
    memory, _, threads = measure_usage(process, groups)
    assert (memory.allowed, threads.allowed) == expected
    assert (memory.used, threads.used) == (100 * os.sysconf("SC_PAGE_SIZE"), 1)
    (mine / "memory.max").write_text("max\n")
    assert measure_usage(process, groups)[0].allowed is None


@pytest.mark.fault("F10")
def test_high_usage_is_reported_once_and_its_end_once() -> None:
    watch = ResourceWatch()
    result = [
        watch.check_usage((ResourceUse("memory_bytes", used, 1000), ResourceUse("threads", used, None)))
        for used in range(700, 950, 50)
    ]
    result += [watch.check_usage((ResourceUse("memory_bytes", used, 1000),)) for used in (750, 690, 500)]
    assert [[(notice.code, notice.severity) for notice in notices] for notices in result if notices] == [
        [("ResourceHigh", "minor")],
        [("ResourceHigh", "info")],
    ]


async def test_status_shows_resource_usage(tmp_path: Path) -> None:
    async with serving(config_of(tmp_path), SimulatedMachine()) as path:
        status = await status_when(path, lambda result: result["resources"])
    assert {name: result["used"] > 0 for name, result in status["resources"].items()} == dict.fromkeys(used(), True)


async def fill_the_pool() -> None:
    most = min(32, (os.cpu_count() or 1) + 4)  # as of ThreadPoolExecutor
    met = threading.Barrier(most)
    await asyncio.gather(*(asyncio.to_thread(met.wait, 60.0) for _ in range(most)))


@pytest.mark.usefixtures("real_time")
@pytest.mark.fault("F10")
async def test_disconnected_clients_leak_no_descriptors_and_no_threads(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    machine = SimulatedMachine(rapids(config, count=2))
    async with serving(config, machine) as path:
        await status_when(path, lambda result: result["axes"]["X"]["accepted"] == 2)
        await fill_the_pool()
        before = used()
        for _ in range(100):
            assert (await asyncio.to_thread(ask_daemon, path, {"request": "status"}))["ok"]
            _, writer = await asyncio.open_unix_connection(str(path))
            writer.close()
        looks: list[dict[str, int]] = []

        def as_before(_: object) -> bool:
            looks.append(used())
            return looks[-1]["descriptors"] <= before["descriptors"]

        await status_when(path, as_before)
        after = looks[-1]
    assert after["threads"] <= before["threads"]


@pytest.mark.parametrize(("number", "expected"), [(errno.EMFILE, ["descriptors"]), (errno.EIO, [])])
@pytest.mark.fault("F10")
def test_unreadable_usage_is_ignored(number: int, expected: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def refuses(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Path, "iterdir", refuses)
    found = measure_usage()
    assert [use.name for use in found] == expected
    assert all(use.used_share == 1.0 for use in found)
