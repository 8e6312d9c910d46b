"""Distributes work over an executor: this process, further processes, or a cluster; yields results as tasks end."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import dataclass
from itertools import islice
from typing import Any, Generic, TypeVar

TEND_S = 10.0
Item = TypeVar("Item")
Result = TypeVar("Result")


class InProcessExecutor(Executor):
    """Runs submitted work in this process, before ``submit`` returns."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Return the completed future of the work; exceptions of the work are raised here."""
        done: Future[Any] = Future()
        done.set_result(fn(*args, **kwargs))
        return done


@dataclass(frozen=True)
class TaskPool(Generic[Item, Result]):
    """A pool of workers: an executor, the items per task, the number of pending tasks.

    A task that ends with one of the errors ``deadly`` (its worker died repeatedly) is retried in halves; a single such
    item is retried once more alone, at the end, and then gets the result ``lost``. ``tend`` replaces missing workers;
    it is called while no task ends.
    """

    executor: Executor
    per_task: int
    at_once: int
    fatal_errors: tuple[type[BaseException], ...] = ()
    lost: Callable[[Item], Result] | None = None
    tend: Callable[[], object] | None = None

    def run_tasks(
        self, work: Callable[[Sequence[Item]], Sequence[Result]], items: Iterable[Item]
    ) -> Iterator[tuple[Sequence[Item], Sequence[Result]]]:
        """Yield the items of each task and their results, in the order in which tasks end."""
        left, halves, suspects = iter(items), list[list[Item]](), list[list[Item]]()
        running: dict[Future[Sequence[Result]], list[Item]] = {}
        while True:
            while len(running) < self.at_once and (
                task := halves.pop() if halves else list(islice(left, self.per_task))
            ):
                running[self.executor.submit(work, task)] = task
            if not running:
                break
            for future in self._wait_for_ended(running):
                task = running.pop(future)
                try:
                    results = future.result()
                except self.fatal_errors:
                    middle = len(task) // 2
                    if middle:
                        halves += [task[:middle], task[middle:]]
                    else:
                        suspects.append(task)
                    continue
                yield task, results
        for task in suspects:  # alone: another task on the same worker may have killed it
            yield task, self._run_alone(work, task)

    def _run_alone(self, work: Callable[[Sequence[Item]], Sequence[Result]], task: list[Item]) -> Sequence[Result]:
        future = self.executor.submit(work, task)
        self._wait_for_ended([future])
        try:
            return future.result()
        except self.fatal_errors:
            if self.lost is None:
                raise
            return [self.lost(task[0])]

    def _wait_for_ended(self, running: Iterable[Future[Sequence[Result]]]) -> set[Future[Sequence[Result]]]:
        while not (ended := wait(running, TEND_S, FIRST_COMPLETED).done):
            if self.tend is not None:
                self.tend()
        return ended
