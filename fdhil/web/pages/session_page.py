"""Logs in and out, and reports the session to the browser. Open to every client; reveals no secret."""

from typing import Annotated

from fastapi import APIRouter, Request
from pydantic import BaseModel, Field

from fdhil.config import LONGEST_PASSWORD, Role
from fdhil.web.login import LIFE_S
from fdhil.web.request_gate import find_token
from fdhil.web.route_context import LoginDependency

router = APIRouter(prefix="/api/session")


class Login(BaseModel):
    """A name and a password."""

    name: Annotated[str, Field(min_length=1, max_length=64)]
    password: Annotated[str, Field(min_length=1, max_length=LONGEST_PASSWORD)]


class Who(BaseModel):
    """The client, and whether a login is needed: ``role`` is null if nothing may be read yet."""

    name: str
    role: Role | None
    login_needed: bool
    acting: bool


class LoggedIn(Who):
    """A login: the token for every further request, and its longest lifetime."""

    token: str
    life_s: float


@router.get("")
async def who(request: Request, context: LoginDependency) -> Who:
    """Return the client's name and role."""
    principal = context.access.find_principal(find_token(request.headers))
    acting = context.web.acting
    role, name = (principal.role, principal.name) if principal else (None, "")
    return Who(name=name, role=role, login_needed=context.access.needs_login, acting=acting and role == "operate")


@router.post("")
async def log_in(login: Login, request: Request, context: LoginDependency) -> LoggedIn:
    """Log in."""
    address = request.client.host if request.client else ""
    token, session = await context.access.log_in(login.name, login.password, address)
    principal, acting = session.principal, context.web.acting and session.principal.role == "operate"
    return LoggedIn(
        name=principal.name, role=principal.role, login_needed=True, acting=acting, token=token, life_s=LIFE_S
    )


@router.delete("")
async def log_out(request: Request, context: LoginDependency) -> Who:
    """Log out: the token becomes invalid."""
    context.access.log_out(find_token(request.headers))
    return await who(request, context)
