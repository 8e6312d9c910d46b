"""Records the actions of commands in the audit log of the store, in addition to the requests to the daemon.

An action that moves an axis or writes to a drive is recorded first, and refused if the entry cannot be written. An
action that removes an offset is done in any case; a failed entry is reported on the terminal.
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
DISK_S = 5.0  # a hanging disk delays the removal of an offset by no more than this


@contextmanager
def audit_action(machine: MachineConfig, what: str, **details: str) -> Iterator[dict[str, str]]:
    """Record the request ``what``, run the block, then record its result.

    Entries of the yielded dictionary are added to the result. A killed command leaves the request without a result.
    Raises StoreError, before the block runs, if the request cannot be recorded.
    """
    _append_entry(machine, {"asked": what, **details})
    ended = {"result": "Stopped", "text": "interrupted before its end"}
    more: dict[str, str] = {}
    try:
        yield more
        ended = {"result": "done", "text": "", **more}
    except FdhilError as error:
        ended = {"result": type(error).__name__, "text": str(error)}
        raise
    finally:
        _append_or_warn(machine, {"answered": what, **details, **ended}, what)


def record_request(machine: MachineConfig, what: str) -> None:
    """Record the request ``what``, which removes an offset; only warn if the disk refuses or hangs."""
    writing = Thread(target=_append_or_warn, args=(machine, {"asked": what}, what), daemon=True)
    writing.start()
    writing.join(DISK_S)
    if writing.is_alive():
        click.echo(f"{what} is not in the audit: the disk does not answer", err=True)


def record_answer(machine: MachineConfig, what: str, answer: Mapping[str, Any]) -> None:
    """Record the answer to ``what``; only warn if the entry cannot be written."""
    result = "done" if answer["ok"] else str(answer["code"])
    _append_or_warn(machine, {"answered": what, "result": result, "text": str(answer.get("text", ""))}, what)


def _append_or_warn(machine: MachineConfig, entry: dict[str, str], what: str) -> None:
    try:
        _append_entry(machine, entry)
    except StoreError as error:
        click.echo(f"{what} is not in the audit: {error}", err=True)


def _append_entry(machine: MachineConfig, entry: dict[str, str]) -> None:
    from fdhil.store import append_entry, make_store_error

    folder, uid = machine.store.directory, os.getuid()
    entry = {key: value[:MOST_CHARACTERS] for key, value in entry.items()}
    by = {"by": os.environ["SUDO_USER"]} if os.environ.get("SUDO_USER") else {}
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise make_store_error(folder, error) from None
    append_entry(folder, {"who": {"user": _look_up_user(uid), "uid": uid, "pid": os.getpid()}, **by, **entry})


def _look_up_user(uid: int) -> str:
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)
