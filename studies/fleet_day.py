"""Machines that have recorded: days of rapids in real stores, each copied to many machines under its own name."""

from __future__ import annotations

import random
import shutil
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from fdhil import config as machine_config
from fdhil.config import MachineConfig
from fdhil.records import Notice, Parameters, Skill
from fdhil.store import HISTORY_FILE
from fdhil.store.history_database import History
from fdhil.store.history_rows import TimeStamp
from fdhil.store.outbox import Outbox
from tests.fleet.recording_machine import write_history
from tests.store.sample_records import BENCH, make_outcome, make_published, make_window

AXES = ("X", "Y", "Z")
DAYS = 5  # that differ
A_DAY = 1440  # rapids of an axis in a day: one a minute, around the clock
EACH_NOTICE = 10  # rapids of all axes to one notice
MIDNIGHT_S = 1_800_000_000.0


def make_machine(folder: Path, name: str, server: str) -> MachineConfig:
    """Return a machine with [uplink] that has recorded nothing."""
    return machine_config.load_config(write_history(folder, name, server=server, windows="none", machine=name))


def record_day(config: MachineConfig, records: int, first: int = 0, seed: int = 1) -> None:
    """Let a machine record through its own store: of each rapid a window, a set and a prediction; at times a notice."""
    assert config.uplink is not None
    outbox = Outbox(config.uplink, config.uplink_directory)
    chance = random.Random(seed + first)
    whole = {axis: make_window(60, axis=axis) for axis in AXES}
    with History.open(config.store.directory, outbox.add_entry) as history:
        history._db.execute("PRAGMA synchronous = OFF")  # how fast a disk is is not asked here
        for number in range(first, first + records):
            rapid, part = divmod(number, 3)
            axis = AXES[rapid % 3]
            stamp = TimeStamp(MIDNIGHT_S + 86400 * rapid / (3 * A_DAY), "boot", rapid)
            if part == 0:
                history.add_window(make_outcome(rapid % 20 != 0, whole[axis]), "", stamp)
            elif part == 1:
                changed = {name: value * chance.gauss(1, 0.01) for name, value in BENCH.as_dict().items()}
                history.add_revision(
                    make_published(rapid + 1, axis, Parameters.from_mapping(changed)), [rapid + 1], stamp
                )
            elif rapid % EACH_NOTICE:
                history.add_skill(Skill(axis, rapid, *(abs(chance.gauss(2, 1)) for _ in range(4))), stamp)
            else:
                history.add_notice(Notice("Drift", "minor", "Friction rises; lubricate.", axis, rapid), stamp)


def copy_machines(days: Sequence[MachineConfig], folder: Path, machines: int, server: str) -> list[MachineConfig]:
    """Return machines that each have recorded one of ``days``, in a history of its own."""
    made = [make_machine(folder / f"mill-{k:03d}", f"mill-{k:03d}", server) for k in range(machines)]
    for k, config in enumerate(made):
        config.store.directory.mkdir(parents=True)
        file = config.store.directory / HISTORY_FILE
        shutil.copy(days[k % len(days)].store.directory / HISTORY_FILE, file)
        with closing(sqlite3.connect(file)) as db, db:
            db.execute("UPDATE outbox_of SET store = lower(hex(randomblob(16)))")
    return made


def list_expected_records(config: MachineConfig) -> list[tuple[int, str]]:
    """Return number and digest of each record that a machine should send."""
    with closing(sqlite3.connect(config.store.directory / HISTORY_FILE)) as db:
        return db.execute("SELECT id, message FROM outbox ORDER BY id").fetchall()
