"""Acknowledged rows survive a kill of the writer at any step."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fdhil.store.window_file import WindowStore, list_windows, read_window
from tests.store.sample_records import is_bit_identical, make_window

pytestmark = pytest.mark.usefixtures("processes")

STEPS = 14  # the folder: open and fsync of the one above; each window: open, write, fsync, rename, and the folder again


def write_until_killed(folder: Path, nth: int) -> tuple[int, bool]:
    reported, tell = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reported)
        _kill_at_step(nth)
        store = WindowStore(folder, keep=5, config_digest="d")
        for seed in (1, 2):
            store.append_window(make_window(n=60, seed=seed))
            _write(tell, b"k")
        os._exit(0)
    os.close(tell)
    with os.fdopen(reported, "rb") as acknowledged:
        count = len(acknowledged.read())
    _, status = os.waitpid(child, 0)
    return count, os.WIFSIGNALED(status)


_write, _open, _fsync, _replace = os.write, os.open, os.fsync, Path.rename


def _kill_at_step(nth: int) -> None:
    left = nth

    def killing(call: Callable[..., Any]) -> Callable[..., Any]:
        def step(*args: Any, **options: Any) -> Any:
            nonlocal left
            left -= 1
            if left == 0:
                if call is _write:
                    _write(args[0], bytes(args[1][: len(args[1]) // 2]))
                os.kill(os.getpid(), signal.SIGKILL)
            return call(*args, **options)

        return step

    for name, call in (("write", _write), ("open", _open), ("fsync", _fsync)):
        setattr(os, name, killing(call))  # what the store calls, too
    Path.rename = killing(_replace)  # type: ignore[method-assign] # in a process of its own


@pytest.mark.fault("F1")
def test_acknowledged_rows_survive_kill_at_any_step(tmp_path: Path) -> None:
    killed = 0
    for nth in range(1, STEPS + 2):
        folder = tmp_path / str(nth)
        acknowledged, ended = write_until_killed(folder, nth)
        killed += ended
        found = list_windows(folder).windows if folder.exists() else ()
        assert acknowledged <= len(found) <= acknowledged + 1, nth
        for seed, file in enumerate(found, 1):
            assert is_bit_identical(read_window(file.path), make_window(n=60, seed=seed)), nth
        again = WindowStore(folder, keep=5, config_digest="d")
        assert is_bit_identical(
            read_window(again.append_window(make_window(n=60, seed=9)).path), make_window(n=60, seed=9)
        )
        assert list_windows(folder).strays == ()
        assert [path.name for path in folder.iterdir() if path.suffix == ".part"] == []
        if not ended:
            break
    assert killed >= STEPS - 2
    assert not ended  # the last one was past the end
