"""HTTP clients of the application without a network: a browser, a script, a client without login."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from functools import cache
from pathlib import Path
from typing import Any

import httpx
from fastapi import FastAPI

from fdhil import config as machine_config
from fdhil.config import MachineConfig
from fdhil.config.user_file import Role, User, hash_password, write_users
from fdhil.daemon.daemon_access import ClientProcess
from fdhil.daemon.daemon_socket import SOCKET_NAME, ControlServer
from fdhil.web.application import make_app
from fdhil.web.login import LoginManager
from tests.daemon.simulated_machine import config_of

PASSWORD = "canary-9b1f-password"
OWN = {"X-Fdhil": "1"}


@cache
def make_user(role: Role) -> User:
    return hash_password(PASSWORD, role)


def write_machine(folder: Path, users: bool = True, **web: Any) -> MachineConfig:
    if users:
        write_users(folder / "users.json", {"watcher": make_user("watch"), "operator": make_user("operate")})
        web = {"users_file": "users.json", **web}
    return config_of(folder, web=web)


@asynccontextmanager
async def make_client(app: FastAPI, name: str = "", **headers: str) -> AsyncIterator[httpx.AsyncClient]:
    transport = httpx.ASGITransport(app, raise_app_exceptions=False)
    async with httpx.AsyncClient(transport=transport, base_url="http://localhost", headers=headers) as client:
        if name:
            client.headers["Authorization"] = f"Bearer {log_in_for_token(app, name)}"
        yield client


def log_in_for_token(app: FastAPI, name: str) -> str:
    """Return a token like a login, without the tenth of a second of the password check."""
    access: LoginManager = app.state.context.access
    return access.start_session(name, make_user("operate" if name == "operator" else "watch"))[0]


async def log_in(client: httpx.AsyncClient, name: str, password: str = PASSWORD) -> str:
    answer = await client.post("/api/session", json={"name": name, "password": password}, headers=OWN)
    assert answer.status_code == 200, answer.text
    return str(answer.json()["token"])


@asynccontextmanager
async def serve_daemon(
    config: MachineConfig, answer: Callable[[Mapping[str, Any]], Any], abandon: Callable[[], object] = lambda: None
) -> AsyncIterator[list[Mapping[str, Any]]]:
    asked: list[Mapping[str, Any]] = []

    async def answer_request(request: Mapping[str, Any], peer: ClientProcess) -> Mapping[str, Any]:
        asked.append(request)
        reported = answer(request)
        return await reported if asyncio.iscoroutine(reported) else reported  # type: ignore[no-any-return]

    config.run_directory.mkdir(parents=True, exist_ok=True)
    server = ControlServer(answer_request, lambda: {"checked_s": 1.0}, abandon, machine_config.Access())
    async with server.serve_socket(config.run_directory / SOCKET_NAME):
        yield asked


def make_test_app(folder: Path, **web: Any) -> FastAPI:
    return make_app(write_machine(folder, **web))
