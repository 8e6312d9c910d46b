"""Who analyses: this process, processes of a Dask cluster on this computer, or a Dask cluster that is there already."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor, Future
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

from fdhil.errors import ConnectError
from fdhil.fleet.spread import Crew, Here
from fdhil.fleet.window_work import Again, Stored, lost

if TYPE_CHECKING:
    from distributed import LocalCluster

PER_TASK = 200  # windows: a task costs milliseconds beside the seconds that they take
TASKS_EACH = 3  # on their way for each worker
CONNECT_S = 30
_SETTINGS: dict[str, object] = {
    "distributed.scheduler.http.routes": [],  # no pages: nobody is asked who he is there
    "distributed.worker.http.routes": [],
    "distributed.comm.timeouts": {"connect": "60s", "tcp": "300s"},  # computers stall
    "distributed.deploy.lost-worker-timeout": "60s",  # so long may the start of one in the place of a dead one take
}
WindowCrew = Crew[Stored, Again]


@contextmanager
def workers(scheduler: str | None, count: int, per_task: int = PER_TASK) -> Iterator[WindowCrew]:
    """Enter a crew: of the cluster behind ``scheduler``, else of ``count`` own processes (0: this process alone).

    The own processes listen on this computer alone and know each other by a certificate that no file holds: a task is
    code, and nobody else may give them any. ConnectError where the scheduler cannot be reached or goes away.
    """
    if scheduler is None and count == 0:
        yield Crew(Here(), per_task, 1)
        return
    from dask import config
    from distributed import Client, KilledWorker

    for name in ("distributed", "distributed.client"):  # a worker that dies is replaced, what else is wrong is raised
        logging.getLogger(name).setLevel(logging.CRITICAL)
    where = f"Dask scheduler {scheduler or 'of this computer'}"
    with config.set(_SETTINGS):
        own = None if scheduler else _own_cluster(count)
        try:
            with Client(own or scheduler, set_as_default=False, timeout=CONNECT_S) as client:
                at_once = TASKS_EACH * max(1, len(client.scheduler_info(n_workers=-1)["workers"]))
                tend = None if own is None else partial(own.scale, count)
                yield Crew(Cluster(client), per_task, at_once, (KilledWorker,), lost, tend)
        except ModuleNotFoundError as error:
            text = f"a worker has no {error.name}: install 'fdhil[fleet]' of the same version on all"
            raise ConnectError(where, text) from None
        except (CancelledError, TimeoutError, OSError) as error:
            text = f"it does not answer ({type(error).__name__}); start it, then this again: what is done stays"
            raise ConnectError(where, text) from None
        finally:
            if own is not None:
                own.close()


class Cluster(Executor):
    """The workers behind a client.

    Dask's own executor never ends a task whose worker died after it was done and before its result was fetched.
    """

    def __init__(self, client: Any) -> None:
        self.client = client

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Return the future of work that is given to some worker."""
        given = self.client.submit(fn, *args, pure=False, **kwargs)

        async def result() -> Any:
            return await given

        return asyncio.run_coroutine_threadsafe(result(), self.client.loop.asyncio_loop)


def _own_cluster(count: int) -> LocalCluster:
    from distributed import LocalCluster

    return LocalCluster(
        n_workers=count,
        threads_per_worker=1,
        security=True,
        dashboard_address="127.0.0.1:0",  # left out it is 8787, which another may have
        scheduler_kwargs={"dashboard": False},
        silence_logs=logging.CRITICAL,
    )
