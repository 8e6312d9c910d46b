"""``fdhil web`` and ``fdhil web-user``: serve the machine pages, and manage their users."""

import json
import re
import sys
from pathlib import Path

import click

from fdhil import config as machine_config
from fdhil.cli.options import AS_JSON, CONFIG, ConfigFirstCommand
from fdhil.config import Role, Web
from fdhil.errors import ConfigError, ConfigFault


@click.command()
@CONFIG
@click.option("--host", help="Address to listen on (default: web.host of CONFIG).")
@click.option("--port", type=click.IntRange(0, 65535), help="TCP port, 0 for a free one (default: web.port of CONFIG).")
@click.option("--json", "as_json", is_flag=True, help="Print the address as a JSON object on stdout.")
def web(config: Path, host: str | None, port: int | None, as_json: bool) -> None:
    """Serve the pages of CONFIG's machine for a browser, from its daemon and store.

    The server is a client of the daemon and opens no bus, so a browser cannot disturb the machine. By default only this
    computer can connect; others need TLS and users. Arming, disarming and acknowledging need a login with the role
    operate, and web.acting = true. Stops on SIGTERM or Ctrl-C.
    """
    machine = machine_config.load_config(config)
    machine = machine.model_copy(update={"web": override_address(machine.web, host, port)})
    from fdhil.web import serve_machine  # late: --help imports nothing heavy

    serve_machine(machine, lambda url: print_address(machine.machine.name, url, as_json))


def print_address(name: str, url: str, as_json: bool) -> None:
    """Print the address to open."""
    click.echo(json.dumps({"event": "ready", "url": url})) if as_json else click.echo(f"{name}: open {url}", err=True)
    sys.stdout.flush()


def override_address(web: Web, host: str | None, port: int | None) -> Web:
    """Return the settings with the given host or port."""
    given = {name: value for name, value in (("host", host), ("port", port)) if value is not None}
    return web.model_copy(update=given)


@click.command("web-user", cls=ConfigFirstCommand)
@CONFIG
@click.argument("name")
@click.option(
    "--role", type=click.Choice(["watch", "operate"]), default="watch", show_default=True, help="Role of the user."
)
@click.option("--remove", is_flag=True, help="Remove the user.")
@AS_JSON
def web_user(config: Path, name: str, role: Role, remove: bool, as_json: bool) -> None:
    """Add, change or remove the web user NAME in the users file of CONFIG.

    watch can read; operate can also disarm and, with web.acting = true, arm and acknowledge. Prompts for the password,
    or reads it as the first line of standard input if that is not a terminal. Only a scrypt hash is stored.
    """
    set_web_user(machine_config.load_config(config).web, config, name, role, remove, as_json)


def set_web_user(web: Web, config: Path, name: str, role: Role, remove: bool, as_json: bool) -> None:
    """Add, change or remove a user in the users file. Raises ConfigError if ``config`` names no such file."""
    path = web.users_file
    if path is None:
        fault = ConfigFault("web.users_file", "is missing", 'add users_file = "web-users.json" to [web]')
        raise ConfigError(str(config), [fault])
    from fdhil.config import (
        LONGEST_PASSWORD,
        SHORTEST_PASSWORD,
        USER_NAME_PATTERN,
        hash_password,
        read_users,
        write_users,
    )

    if re.fullmatch(USER_NAME_PATTERN, name) is None:
        raise click.BadParameter("a name may contain letters, digits, . _ @ and -, at most 64 characters")
    users_by_name = dict(read_users(path)) if path.exists() else {}
    if remove:
        if users_by_name.pop(name, None) is None:
            raise click.BadParameter(f"there is no user {name}")
    else:
        users_by_name[name] = hash_password(_ask_password(SHORTEST_PASSWORD, LONGEST_PASSWORD), role)
    write_users(path, users_by_name)
    if as_json:
        document = {"schema": "fdhil-web-user-1", "user": name, "role": None if remove else role, "file": str(path)}
        click.echo(json.dumps(document))
    else:
        click.echo(f"{name} removed" if remove else f"{name} can log in with the role {role} ({path})")


def _ask_password(shortest: int, longest: int) -> str:
    if sys.stdin.isatty():
        given = str(click.prompt("Password", hide_input=True, confirmation_prompt=True, err=True))
    else:
        given = sys.stdin.readline().rstrip("\r\n")
    if not shortest <= len(given) <= longest:
        raise click.BadParameter(f"a password needs {shortest} to {longest} characters")
    return given
