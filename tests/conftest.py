"""Rules for every test: warnings are errors (pyproject), and no thread, descriptor or handler may be left behind."""

from __future__ import annotations

import gc
import os
import signal
import threading
import time
from collections.abc import Iterator

import pytest
from hypothesis import Phase, settings

from fdhil.guard.stop_signals import KEPT

pytest_plugins = ["tests.tiers", "tests.virtual_threads"]
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported; as the command line does
gc.disable()  # until all tests are collected
# in the background of a shell it is ignored, by all that tests start too: but they send it
signal.signal(signal.SIGINT, signal.default_int_handler)

# the same examples in every run; --hypothesis-profile=thorough looks for others, and for more of them;
# quick (make mutants) does not ask which is the smallest example that fails
settings.register_profile("fixed", derandomize=True, deadline=None)
settings.register_profile("thorough", derandomize=False, deadline=None, max_examples=1000, print_blob=True)
settings.register_profile("quick", derandomize=True, deadline=None, phases=(Phase.explicit, Phase.generate))
settings.load_profile("fixed")


def pytest_collection_finish() -> None:
    """Exclude the imported modules from garbage collection, which would scan them thousands of times."""
    gc.collect()
    gc.freeze()
    gc.enable()


@pytest.fixture(autouse=True)
def no_thread_left() -> Iterator[None]:
    """Fail a test that leaves a thread behind; pools of the numeric libraries keep theirs."""
    before = set(threading.enumerate())
    yield
    deadline = time.monotonic() + 30.0
    while (left := _list_own_handlers(set(threading.enumerate()) - before)) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not left, f"threads left behind: {[thread.name for thread in left]}"


@pytest.fixture(autouse=True)
def no_signal_caught() -> Iterator[None]:
    """Fail a test that leaves a signal wake-up descriptor behind: a later signal would break a pipe."""
    yield
    assert signal.set_wakeup_fd(-1) == -1, "signals are still told to a descriptor"


@pytest.fixture
def handlers() -> Iterator[None]:
    """Restore what a guard started in this process changes: signal handlers and the garbage collector."""
    before = {number: signal.getsignal(number) for number in signal.valid_signals()}
    yield
    descriptor = signal.set_wakeup_fd(-1)
    if descriptor >= 0:
        os.close(descriptor)
    for number, handler in before.items():
        if number not in KEPT and handler is not None:
            signal.signal(number, handler)
    gc.unfreeze()
    gc.enable()


def _list_own_handlers(threads: set[threading.Thread]) -> list[threading.Thread]:
    pools = ("asyncio_", "ThreadPoolExecutor", "pyarrow", "Dask-Offload")
    return [t for t in threads if t.is_alive() and not t.name.startswith(pools)]
