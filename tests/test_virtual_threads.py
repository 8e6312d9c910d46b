"""Threads on virtual time: one at a time, in the order of their deadlines, without real waiting."""

from __future__ import annotations

import asyncio
import queue
import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.virtual_threads import FIRST_S, VirtualThreads


def test_threads_resume_in_order_of_deadlines(virtual_threads: VirtualThreads) -> None:
    seen: list[tuple[float, str]] = []

    def take_turn(name: str, period_s: float) -> None:
        for _ in range(3):
            time.sleep(period_s)
            seen.append((round(time.monotonic() - FIRST_S, 6), name))

    threads = [threading.Thread(target=take_turn, args=each) for each in (("slow", 3600.0), ("quick", 1500.0))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert seen == [
        (1500.0, "quick"), (3000.0, "quick"), (3600.0, "slow"), (4500.0, "quick"), (7200.0, "slow"), (10800.0, "slow")
    ]  # fmt: skip


def test_queues_events_pools_and_event_loops_wait_on_virtual_time(virtual_threads: VirtualThreads) -> None:
    values: queue.Queue[int] = queue.Queue()
    with pytest.raises(queue.Empty):
        values.get(timeout=60.0)
    event = threading.Event()
    timer = threading.Timer(60.0, event.set)
    timer.start()
    assert not event.wait(59.0)
    assert event.wait(2.0)
    timer.join()
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(time.sleep, 60.0).result() is None
    asyncio.run(asyncio.sleep(60.0))
    assert time.monotonic() - FIRST_S == pytest.approx(240.0, abs=1e-3)


def test_thread_waits_for_socket_while_others_run(virtual_threads: VirtualThreads) -> None:
    near, far = socket.socketpair()
    with near, far:

        def answer_client() -> None:
            time.sleep(60.0)
            far.sendall(b"late")

        thread = threading.Thread(target=answer_client)
        thread.start()
        near.settimeout(30.0)
        with pytest.raises(TimeoutError):
            near.recv(10)
        near.settimeout(None)
        assert near.recv(10) == b"late"
        thread.join()
