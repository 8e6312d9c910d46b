"""A machine that has identified its drives: created once, copied by each test that arms."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.machine.whole_machine import Machine, shuttle


@pytest.fixture(scope="session")
def identified(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return the folder of a machine that has validated models of both axes, and a copy of its store."""
    folder, kept = tmp_path_factory.mktemp("identified"), tmp_path_factory.mktemp("kept") / "store"
    with Machine(folder=folder) as machine:
        machine.start("daemon")
        machine.nc(on=True)
        machine.play(shuttle())
        machine.run(0.5)
        assert machine.ask("status")["axes"]["X"]["accepted"] == 4
        machine.stop("daemon")
        shutil.copytree(machine.config.store.directory, kept, ignore=shutil.ignore_patterns("run"))
    return folder, kept


@pytest.fixture
def begin(identified: tuple[Path, Path]) -> Iterator[Callable[[], Machine]]:
    """Restart that machine: guard and daemon run, and the NC controls the drives."""
    folder, kept = identified
    begun: list[Machine] = []

    def start() -> Machine:
        for each in begun:
            each.close()
        begun.clear()
        shutil.rmtree(folder)  # a model is of one configuration, and that names the folder
        folder.mkdir()
        machine = Machine(folder=folder, store=kept)
        begun.append(machine)
        machine.start("guard")
        machine.start("daemon")
        machine.nc(on=True)
        machine.run(0.7)
        return machine

    yield start
    for machine in begun:
        machine.close()
