"""The guard runs for months without a garbage collector: it must create neither cycles nor growing memory."""

from __future__ import annotations

import gc
import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.guard.guard_rig import GuardRig

WARM, LIVES = 16, 6
BLOCKS_A_LIFE = 40  # that a life may leave: the rings are not full yet; one object for each of its SYNC would be 350


@contextmanager
def without_a_collector() -> Iterator[None]:
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def life(shop: GuardRig) -> None:
    shop.playing, shop.row = False, 0
    client = shop.arm()
    shop.playing = True
    shop.run(120)
    with shop.connect() as rude:
        for nonsense in (b"{", b"[]", b'{"request": "what"}', b'{"request": "arm", "token": "wrong"}'):
            assert not shop.ask(rude, nonsense)["ok"]
        rude.send(b'{"request": "sta')
    for cob_id, data in ((0x081, b"\x10\x81\x11"), (0x581, bytes(8)), (0x601, b"\x40"), (0x7FF, b""), (0x181, b"\x01")):
        shop.wire.feed([(cob_id, data, 0.0)])
        shop.run(3)
    assert shop.ask(client, {"request": "disarm"})["ok"]
    shop.run(60)
    assert shop.state == "OFF"
    client.close()
    shop.run(3)


def forget(shop: GuardRig) -> None:
    shop.guard._journal.recent.clear()
    shop.wire.sent.clear()
    shop.taken = 0
    shop._clients.clear()
    for drive in shop.drives:
        drive.queue = drive.queue[-2:]


@pytest.mark.fault("F10")
def test_guard_creates_no_reference_cycles(tmp_path: Path) -> None:
    shop = GuardRig(tmp_path)
    try:
        life(shop)
        forget(shop)
        with without_a_collector():
            life(shop)
            forget(shop)
            assert gc.collect() == 0
    finally:
        shop.close()


@pytest.mark.usefixtures("processes")
@pytest.mark.fault("F10")
def test_repeated_runs_leak_no_memory_and_no_descriptors(tmp_path: Path) -> None:
    """Runs in its own process, where nothing else allocates."""
    output = subprocess.run([sys.executable, "-m", __name__, tmp_path], stdout=subprocess.PIPE, check=True).stdout
    blocks, containers, descriptors = zip(*json.loads(output), strict=True)
    assert blocks[-1] - blocks[0] < BLOCKS_A_LIFE * LIVES, blocks
    assert containers[-1] - containers[0] < LIVES, containers
    assert descriptors[-1] - descriptors[0] < LIVES - 2, descriptors  # a thread closes them, a moment later


def lives(folder: Path) -> list[list[int]]:
    shop = GuardRig(folder)
    used: list[int] = []  # plain numbers: to note them makes no object that holds others
    try:
        with without_a_collector():
            for _ in range(WARM + LIVES):
                life(shop)
                forget(shop)
                used += sys.getallocatedblocks(), len(gc.get_objects()), len(list(Path("/proc/self/fd").iterdir()))
    finally:
        shop.close()
    return [used[k : k + 3] for k in range(3 * WARM, len(used), 3)]


if __name__ == "__main__":
    json.dump(lives(Path(sys.argv[1])), sys.stdout)
