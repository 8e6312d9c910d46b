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

from fdhil.config import MachineConfig, Web
from fdhil.store import History
from fdhil.web.daemon_client import DaemonClient
from fdhil.web.login import LoginManager, Principal


@dataclass(frozen=True, slots=True)
class MachineContext:
    """One machine, as the pages see it."""

    config: MachineConfig
    daemon: DaemonClient
    access: LoginManager
    checked: set[tuple[int, int]] = field(default_factory=set)
    """Intact histories by device and inode: checking a large one takes a second."""

    @contextmanager
    def open_history(self) -> Iterator[History]:
        """Open the history for reading (blocking: for routes that are plain functions). StoreError."""
        with History.open_read_only(self.config.store.directory, checked=self.checked) as history:
            yield history


@dataclass(frozen=True, slots=True)
class LoginContext:
    """The login data, the same for the pages of one machine and of many."""

    web: Web
    access: LoginManager


async def _get_login_context(connection: HTTPConnection) -> LoginContext:
    entry = connection.app.state.entry
    assert isinstance(entry, LoginContext)
    return entry


async def _get_machine_context(connection: HTTPConnection) -> MachineContext:
    context = connection.app.state.context
    assert isinstance(context, MachineContext)
    return context


async def _get_principal(connection: HTTPConnection) -> Principal:
    principal = connection.scope["fdhil.principal"]  # set by the gate
    assert isinstance(principal, Principal)
    return principal


LoginDependency = Annotated[LoginContext, Depends(_get_login_context)]
"""Route parameter: the login data."""
MachineDependency = Annotated[MachineContext, Depends(_get_machine_context)]
"""Route parameter: the machine, as in ``def windows(context: MachineDependency) -> ...``."""
PrincipalDependency = Annotated[Principal, Depends(_get_principal)]
"""Route parameter: the client's name and role."""
