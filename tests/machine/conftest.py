"""A machine that has identified its drives: created once, copied by each test that arms."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.machine.complete_machine import CompleteMachine, build_shuttle_program


@pytest.fixture(scope="session")
def identified_model(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return the folder of a machine that has validated models of both axes, and a copy of its store."""
    folder, kept = tmp_path_factory.mktemp("identified"), tmp_path_factory.mktemp("kept") / "store"
    with CompleteMachine(folder=folder) as machine:
        machine.start_processes("daemon")
        machine.switch_nc(on=True)
        machine.play_program(build_shuttle_program())
        machine.run_for(0.5)
        assert machine.request_daemon("status")["axes"]["X"]["accepted"] == 4
        machine.stop_processes("daemon")
        shutil.copytree(machine.config.store.directory, kept, ignore=shutil.ignore_patterns("run"))
    return folder, kept


@pytest.fixture
def start_machine(identified_model: tuple[Path, Path]) -> Iterator[Callable[[], CompleteMachine]]:
    """Restart that machine: guard and daemon run, and the NC controls the drives."""
    folder, kept = identified_model
    begun: list[CompleteMachine] = []

    def start() -> CompleteMachine:
        for each in begun:
            each.close_machine()
        begun.clear()
        shutil.rmtree(folder)  # a model is of one configuration, and that names the folder
        folder.mkdir()
        machine = CompleteMachine(folder=folder, store=kept)
        begun.append(machine)
        machine.start_processes("guard")
        machine.start_processes("daemon")
        machine.switch_nc(on=True)
        machine.run_for(0.7)
        return machine

    yield start
    for machine in begun:
        machine.close_machine()
