"""Dependencies of the routes: configuration, daemon, store, and the client.

Dependencies are coroutines here and on every page: a plain function would wait for one of the forty threads of plain
routes, and clients that occupy those could keep an operator from disarming.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Annotated

from fastapi import Depends
from starlette.requests import HTTPConnection

from fdhil.config import MachineConfig
from fdhil.config.web_section import Web
from fdhil.store.history import History
from fdhil.web.access import Access, Asker
from fdhil.web.daemon import Daemon


@dataclass(frozen=True, slots=True)
class Context:
    """One machine, as the pages see it."""

    config: MachineConfig
    daemon: Daemon
    access: Access
    checked: set[tuple[int, int]] = field(default_factory=set)
    """Intact histories by device and inode: checking a large one takes a second."""

    @contextmanager
    def history(self) -> Iterator[History]:
        """Open the history for reading (blocking: for routes that are plain functions). StoreError."""
        with History.read(self.config.store.directory, checked=self.checked) as history:
            yield history


@dataclass(frozen=True, slots=True)
class Entry:
    """The login data, the same for the pages of one machine and of many."""

    web: Web
    access: Access


async def _entry(connection: HTTPConnection) -> Entry:
    entry = connection.app.state.entry
    assert isinstance(entry, Entry)
    return entry


async def _context(connection: HTTPConnection) -> Context:
    context = connection.app.state.context
    assert isinstance(context, Context)
    return context


async def _asker(connection: HTTPConnection) -> Asker:
    principal = connection.scope["fdhil.principal"]  # set by the gate
    assert isinstance(principal, Asker)
    return principal


LoginDependency = Annotated[Entry, Depends(_entry)]
"""Route parameter: the login data."""
MachineDependency = Annotated[Context, Depends(_context)]
"""Route parameter: the machine, as in ``def windows(context: MachineDependency) -> ...``."""
PrincipalDependency = Annotated[Asker, Depends(_asker)]
"""Route parameter: the client's name and role."""
