"""Has what a command does to the machine in the audit of the store, beside what the daemon is asked for.

What moves an axis or writes to a drive is written down before it is done, and refused where that cannot be. What takes
an offset away is done whatever the disk does, and told to the terminal where it could not be written.
"""

from __future__ import annotations

import os
import pwd
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from threading import Thread
from typing import TYPE_CHECKING, Any

import click

from fdhil.errors import FdhilError, StoreError

if TYPE_CHECKING:
    from fdhil.config import MachineConfig

MOST_CHARACTERS = 500
DISK_S = 5.0  # how long an offset stands at most because a disk hangs


@contextmanager
def audited(machine: MachineConfig, what: str, **told: str) -> Iterator[dict[str, str]]:
    """Write who does ``what``, do it, write how it ended. StoreError where the first cannot be written: it is not done.

    What the block puts into the dictionary is in the last line too. Of a command that was killed the first line stays
    alone.
    """
    _append(machine, {"asked": what, **told})
    ended = {"result": "Stopped", "text": "it did not come to its end"}
    more: dict[str, str] = {}
    try:
        yield more
        ended = {"result": "done", "text": "", **more}
    except FdhilError as error:
        ended = {"result": type(error).__name__, "text": str(error)}
        raise
    finally:
        _try(machine, {"answered": what, **told, **ended}, what)


def write_before(machine: MachineConfig, what: str) -> None:
    """Write that ``what`` takes an offset away: where the disk refuses, or hangs, it is told and done all the same."""
    writing = Thread(target=_try, args=(machine, {"asked": what}, what), daemon=True)
    writing.start()
    writing.join(DISK_S)
    if writing.is_alive():
        click.echo(f"{what} is not in the audit: the disk does not answer", err=True)


def write_after(machine: MachineConfig, what: str, answer: Mapping[str, Any]) -> None:
    """Write how ``what`` was answered; where that cannot be written it is told."""
    result = "done" if answer["ok"] else str(answer["code"])
    _try(machine, {"answered": what, "result": result, "text": str(answer.get("text", ""))}, what)


def _try(machine: MachineConfig, entry: dict[str, str], what: str) -> None:
    try:
        _append(machine, entry)
    except StoreError as error:
        click.echo(f"{what} is not in the audit: {error}", err=True)


def _append(machine: MachineConfig, entry: dict[str, str]) -> None:
    from fdhil.store import audit
    from fdhil.store.atomic import store_error

    folder, uid = machine.store.directory, os.getuid()
    entry = {key: value[:MOST_CHARACTERS] for key, value in entry.items()}
    by = {"by": os.environ["SUDO_USER"]} if os.environ.get("SUDO_USER") else {}
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise store_error(folder, error) from None
    audit.append(folder, {"who": {"user": _name(uid), "uid": uid, "pid": os.getpid()}, **by, **entry})


def _name(uid: int) -> str:
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)
