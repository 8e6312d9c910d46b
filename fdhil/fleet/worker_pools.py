"""Provides the workers: this process, processes of a local Dask cluster, or an existing Dask cluster."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor, Future
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

from fdhil.errors import ConnectError
from fdhil.fleet.task_pool import InProcessExecutor, TaskPool
from fdhil.fleet.window_reanalysis import ReanalysedWindow, WindowReference, create_lost_result

if TYPE_CHECKING:
    from distributed import LocalCluster

PER_TASK = 200  # windows; their analysis takes seconds, the overhead of a task milliseconds
TASKS_EACH = 3  # pending tasks per worker
CONNECT_S = 30
_SETTINGS: dict[str, object] = {
    "distributed.scheduler.http.routes": [],  # no pages: they have no login
    "distributed.worker.http.routes": [],
    "distributed.comm.timeouts": {"connect": "60s", "tcp": "300s"},  # computers stall
    "distributed.deploy.lost-worker-timeout": "60s",  # time for the start of a replacement
}
WindowCrew = TaskPool[WindowReference, ReanalysedWindow]


@contextmanager
def open_worker_pool(scheduler: str | None, count: int, per_task: int = PER_TASK) -> Iterator[WindowCrew]:
    """Open a pool: of the cluster behind ``scheduler``, else of ``count`` local processes (0: this process alone).

    Local processes listen on this computer alone and authenticate each other by a certificate kept in memory: a task is
    code, and nobody else may submit any. ConnectError where the scheduler cannot be reached or is lost.
    """
    if scheduler is None and count == 0:
        yield TaskPool(InProcessExecutor(), per_task, 1)
        return
    from dask import config
    from distributed import Client, KilledWorker

    for name in ("distributed", "distributed.client"):  # a dead worker is replaced, other errors are raised
        logging.getLogger(name).setLevel(logging.CRITICAL)
    where = f"Dask scheduler {scheduler or 'of this computer'}"
    with config.set(_SETTINGS):
        own = None if scheduler else _start_local_cluster(count)
        try:
            with Client(own or scheduler, set_as_default=False, timeout=CONNECT_S) as client:
                at_once = TASKS_EACH * max(1, len(client.scheduler_info(n_workers=-1)["workers"]))
                tend = None if own is None else partial(own.scale, count)
                yield TaskPool(DaskExecutor(client), per_task, at_once, (KilledWorker,), create_lost_result, tend)
        except ModuleNotFoundError as error:
            text = f"a worker lacks {error.name}; install the same version of 'fdhil[fleet]' everywhere"
            raise ConnectError(where, text) from None
        except (CancelledError, TimeoutError, OSError) as error:
            text = f"it does not respond ({type(error).__name__}); start it and try again: completed windows are kept"
            raise ConnectError(where, text) from None
        finally:
            if own is not None:
                own.close()


class DaskExecutor(Executor):
    """Runs work on the workers behind a client.

    Dask's own executor never ends a task whose worker died after completion and before its result was fetched.
    """

    def __init__(self, client: Any) -> None:
        self.client = client

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        given = self.client.submit(fn, *args, pure=False, **kwargs)

        async def await_result() -> Any:
            return await given

        return asyncio.run_coroutine_threadsafe(await_result(), self.client.loop.asyncio_loop)


def _start_local_cluster(count: int) -> LocalCluster:
    from distributed import LocalCluster

    return LocalCluster(
        n_workers=count,
        threads_per_worker=1,
        security=True,
        dashboard_address="127.0.0.1:0",  # the default 8787 may be in use
        scheduler_kwargs={"dashboard": False},
        silence_logs=logging.CRITICAL,
    )
