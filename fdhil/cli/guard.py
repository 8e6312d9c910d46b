"""``fdhil-guard CONFIG``: opens the transmit descriptor of the machine's bus and becomes the guard's process."""

from __future__ import annotations

import hashlib
import json
import os
import socket
import sys
import time
from pathlib import Path

import click

from fdhil import config as machine_config
from fdhil.cli.bus_lock import lock_bus
from fdhil.cli.main import run_safely
from fdhil.config import CanBus
from fdhil.errors import ConnectError, DeviceError, ProtocolError
from fdhil.guard.settings import from_json, to_json

SETTINGS_NAME = "guard.json"
CONNECT_S = 5.0


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.argument("config", type=click.Path(path_type=Path))
@click.option("--check", is_flag=True, help="Write the settings and stop: opens no bus.")
def guard(config: Path, check: bool) -> None:
    """Run the guard of the machine in CONFIG: the only process of fdhil that may send an offset to a drive.

    It sends no frame until the daemon arms a correction, checks every interlock at each SYNC, and ramps to zero when
    anything is not as it must be: also when the daemon dies, and before it stops itself. Events are JSON lines on
    stdout. Exit codes: 0 stopped with nothing applied, 2 wrong config, 3 bus trouble, or an offset may be left.
    """
    from fdhil.arming import guard_settings  # late: the rooms behind it are heavy, --help is not
    from fdhil.arming.token import make_directory, operator_token
    from fdhil.commissioning.compare import compare_again

    machine = guard_settings.with_given_key(machine_config.load(config))
    name = guard_settings.corrected_bus(machine, str(config))
    token_sha256 = hashlib.sha256(operator_token(machine.run_directory).encode()).hexdigest()
    run_directory = machine.guard_directory
    make_directory(run_directory)
    text = to_json(guard_settings.settings_of(machine, name, run_directory, token_sha256))
    from_json(text, str(config))  # what the guard would refuse is refused before it is started
    file, bus = run_directory / SETTINGS_NAME, machine.bus[name]
    if check:
        _write(file, text)
        click.echo(f"{file}: what the guard would be told of {name}")
        return
    with connect_bus(name, bus) as transmit, lock_bus(bus, transmit, run_directory) as lock:
        # where no NC runs the bus, the drives are asked whether they still are what was signed off
        compare_again(machine, name, _tell_void)
        _write(file, to_json(guard_settings.settings_of(machine, name, run_directory, token_sha256)))
        greet(name, bus, transmit)
        os.set_inheritable(lock.fileno(), True)
        transmit.set_inheritable(True)
        arguments = ["-m", "fdhil.guard", "--settings", str(file), "--descriptor", str(transmit.fileno())]
        sys.stdout.flush()
        os.execv(sys.executable, [sys.executable, *arguments])


def _tell_void(text: str) -> None:
    click.echo(json.dumps({"event": "record_void", "text": text}))


def _write(file: Path, text: str) -> None:
    temporary = file.with_suffix(".new")
    try:
        temporary.unlink(missing_ok=True)
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        with os.fdopen(descriptor, "w", encoding="utf-8") as written:
            written.write(text)
        temporary.replace(file)
    except OSError as error:
        raise DeviceError(str(file), f"cannot be written ({error.strerror}); check the run directory") from None


def open_bus(name: str, bus: CanBus) -> socket.socket:
    """Return a descriptor on which frames can be sent; ConnectError when the bus cannot be had."""
    transmit = connect_bus(name, bus)
    greet(name, bus, transmit)
    return transmit


def connect_bus(name: str, bus: CanBus) -> socket.socket:
    """Open the transmit descriptor; a hub still has to be greeted. ConnectError when the bus cannot be had."""
    if bus.interface == "socketcan":
        return _open_raw(name, bus.channel)
    if bus.interface == "socketcand":
        try:
            return socket.create_connection((bus.host, bus.port), timeout=CONNECT_S)
        except OSError as error:
            text = f"no hub answers at {bus.host} port {bus.port} ({error.strerror or error}); start the hub first"
            raise ConnectError(f"bus {name}", text) from None
    text = f"the interface {bus.interface!r} lives inside one process; set socketcan or socketcand"
    raise ConnectError(f"bus {name}", text)


def _open_raw(name: str, channel: str) -> socket.socket:
    raw = None
    try:
        raw = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        raw.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")  # what comes before the guard listens is old
        raw.bind((channel,))
    except OSError as error:
        if raw is not None:
            raw.close()
        text = f"the CAN interface {channel} cannot be opened ({error.strerror}); bring it up with ip link"
        raise ConnectError(f"bus {name}", text) from None
    return raw


def greet(name: str, bus: CanBus, hub: socket.socket) -> None:
    """Go through the greeting of a hub, byte by byte, so that no frame is swallowed."""
    if bus.interface != "socketcand":
        return
    deadline_s = time.monotonic() + CONNECT_S
    hub.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    try:
        _expect(hub, "hi", deadline_s)
        for command in (f"open {bus.channel}", "rawmode"):
            hub.sendall(f"< {command} >".encode("ascii"))
            _expect(hub, "ok", deadline_s)
    except OSError as error:
        hub.close()
        text = f"the hub at {bus.host} port {bus.port} broke off its greeting ({error}); check that it is a socketcand"
        raise ConnectError(f"bus {name}", text) from None


def _expect(hub: socket.socket, word: str, deadline_s: float) -> None:
    answer = b""
    while not answer.endswith(b">"):
        hub.settimeout(max(0.001, deadline_s - time.monotonic()))
        byte = hub.recv(1)
        if not byte or len(answer) > 200:
            raise ConnectionError("connection closed")
        answer += byte
    if answer.split() != [b"<", word.encode(), b">"]:
        hub.close()
        shown = answer.decode("ascii", "replace")
        raise ProtocolError("hub", f"answered {shown!r} where '< {word} >' belongs; check [bus] channel and port")


def main() -> None:
    """Run the command; an error is one sentence on stderr and its exit code."""
    sys.exit(run_safely(guard))


if __name__ == "__main__":
    main()
