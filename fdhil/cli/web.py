"""``fdhil web`` and ``fdhil web-user``: the pages in a browser, and who may log in."""

import json
import re
import sys
from pathlib import Path

import click

from fdhil import config as machine_config
from fdhil.cli.options import AS_JSON, CONFIG, ConfigFirst
from fdhil.config.users import Role
from fdhil.config.web import Web
from fdhil.errors import ConfigError, ConfigFault


@click.command()
@CONFIG
@click.option("--host", help="Address to listen at; left out: web.host of CONFIG, else 127.0.0.1.")
@click.option("--port", type=click.IntRange(0, 65535), help="TCP port; 0 takes a free one. Left out: web.port.")
@click.option("--json", "as_json", is_flag=True, help="Tell the address as a JSON object on stdout.")
def web(config: Path, host: str | None, port: int | None, as_json: bool) -> None:
    """Serve the pages that show CONFIG's machine in a browser, from its daemon and store.

    It is a client of the daemon and opens no bus, so that a browser cannot disturb the machine. It listens on this
    computer alone; beyond it only with TLS and users. Acting needs a login with the role operate and web.acting = true.
    Stops on SIGTERM or Ctrl-C.
    """
    machine = machine_config.load(config)
    machine = machine.model_copy(update={"web": placed(machine.web, host, port)})
    from fdhil.web import serving  # late: --help imports nothing heavy

    serving.run(machine, lambda url: tell_ready(machine.machine.name, url, as_json))


def tell_ready(name: str, url: str, as_json: bool) -> None:
    """Tell the address that is to be opened."""
    told = {"event": "ready", "url": url}
    click.echo(json.dumps(told)) if as_json else click.echo(f"{name}: open {url}", err=True)
    sys.stdout.flush()


def placed(web: Web, host: str | None, port: int | None) -> Web:
    """Return the settings with another host or port."""
    given = {name: value for name, value in (("host", host), ("port", port)) if value is not None}
    return web.model_copy(update=given)


@click.command("web-user", cls=ConfigFirst)
@CONFIG
@click.argument("name")
@click.option("--role", type=click.Choice(["watch", "operate"]), default="watch", show_default=True)
@click.option("--remove", is_flag=True, help="Take the user out.")
@AS_JSON
def web_user(config: Path, name: str, role: Role, remove: bool, as_json: bool) -> None:
    """Give the user NAME a password and a role in the users file of CONFIG, or take the user out.

    watch reads; operate may also disarm, and arm and acknowledge where web.acting = true. The password is asked for, or
    is the first line of standard input where that is no terminal. What is kept of it is a scrypt hash.
    """
    set_user(machine_config.load(config).web, config, name, role, remove, as_json)


def set_user(web: Web, config: Path, name: str, role: Role, remove: bool, as_json: bool) -> None:
    """Write a user into the users file, or take one out; ConfigError where ``config`` names none."""
    path = web.users_file
    if path is None:
        fault = ConfigFault("web.users_file", "is missing", 'add users_file = "web-users.json" to [web]')
        raise ConfigError(str(config), [fault])
    from fdhil.config import users

    if re.fullmatch(users.NAME, name) is None:
        raise click.BadParameter("a name has letters, digits, . _ @ and -, at most 64 of them")
    known = dict(users.read_users(path)) if path.exists() else {}
    if remove:
        if known.pop(name, None) is None:
            raise click.BadParameter(f"there is no user {name}")
    else:
        known[name] = users.hashed(_password(users.SHORTEST_PASSWORD, users.LONGEST_PASSWORD), role)
    users.write_users(path, known)
    if as_json:
        document = {"schema": "fdhil-web-user-1", "user": name, "role": None if remove else role, "file": str(path)}
        click.echo(json.dumps(document))
    else:
        click.echo(f"{name} may no longer log in" if remove else f"{name} may log in, with the role {role} ({path})")


def _password(shortest: int, longest: int) -> str:
    """Return a password that was asked for twice, or the first line that was piped in; click.BadParameter."""
    if sys.stdin.isatty():
        given = str(click.prompt("Password", hide_input=True, confirmation_prompt=True, err=True))
    else:
        given = sys.stdin.readline().rstrip("\r\n")
    if not shortest <= len(given) <= longest:
        raise click.BadParameter(f"a password has from {shortest} to {longest} characters")
    return given
