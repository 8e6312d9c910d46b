"""Work is split into tasks; a task whose worker dies is retried or reported lost."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from typing import Any

import pytest

from fdhil.fleet.task_pool import InProcessExecutor, TaskPool


class WorkerDied(Exception):
    """The error of a lost worker."""


class ThreadExecutor(Executor):
    """Ends tasks with their errors, like another process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        done: Future[Any] = Future()
        try:
            done.set_result(fn(*args))
        except WorkerDied as error:
            done.set_exception(error)
        return done


class SingleWorkerExecutor(ThreadExecutor):
    """When a task kills the worker, the previous task is lost as well if its result was not yet fetched."""

    def __init__(self) -> None:
        self._before: Future[Any] = Future()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        done = super().submit(fn, *args)
        if done.exception() is not None and self._before.done():
            self._before._exception = done.exception()
        self._before = done
        return done


def double_numbers(numbers: Sequence[int]) -> list[int]:
    """Double each number, and die at 5 and 6."""
    if {5, 6} & set(numbers):
        raise WorkerDied
    return [2 * number for number in numbers]


def test_each_item_runs_once_in_tasks_of_given_size() -> None:
    pool: TaskPool[int, int] = TaskPool(InProcessExecutor(), 4, 1)
    tasks = list(pool.run_tasks(lambda numbers: [2 * number for number in numbers], iter(range(10))))
    assert [list(task) for task, _ in tasks] == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9]]
    assert [result for _, results in tasks for result in results] == [2 * k for k in range(10)]
    assert list(pool.run_tasks(double_numbers, [])) == []


def test_only_item_that_kills_worker_is_lost() -> None:
    pool: TaskPool[int, int] = TaskPool(ThreadExecutor(), 8, 3, (WorkerDied,), lambda number: -number)
    results = {
        item: result
        for task, told in pool.run_tasks(double_numbers, range(20))
        for item, result in zip(task, told, strict=True)
    }
    assert results == {k: -k if k in (5, 6) else 2 * k for k in range(20)}


def test_item_on_same_worker_is_not_lost() -> None:
    pool: TaskPool[int, int] = TaskPool(SingleWorkerExecutor(), 1, 3, (WorkerDied,), lambda number: -number)
    results = {task[0]: told[0] for task, told in pool.run_tasks(double_numbers, range(20))}
    assert results == {k: -k if k in (5, 6) else 2 * k for k in range(20)}


def test_pending_tasks_are_limited() -> None:
    taken: list[int] = []

    def count_items() -> Any:
        for k in range(100):
            taken.append(k)
            yield k

    class NeverEndingExecutor(Executor):
        def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
            done: Future[Any] = Future()
            if len(taken) <= 10:
                done.set_result([0] * len(args[0]))
            return done

    pool: TaskPool[int, int] = TaskPool(NeverEndingExecutor(), 5, 3)
    next(pool.run_tasks(double_numbers, count_items()))
    assert len(taken) == 15


def test_other_error_ends_run() -> None:
    pool: TaskPool[int, int] = TaskPool(ThreadExecutor(), 8, 3)
    with pytest.raises(WorkerDied):
        list(pool.run_tasks(double_numbers, range(20)))
