"""``fdhil-guard CONFIG``: locks the machine's bus, then becomes the guard process."""

import hashlib
import json
import os
import sys
from pathlib import Path

import click

from fdhil import config as machine_config
from fdhil.cli.bus_lock import lock_bus
from fdhil.cli.cli_errors import prepare_streams, run_safely
from fdhil.cli.epilogs import read_epilog
from fdhil.cli.options import CONFIG
from fdhil.errors import DeviceError
from fdhil.guard import SETTINGS_NAME, decode_settings, encode_settings, greet_hub, open_transmit_socket


@click.command(epilog=read_epilog("guard"), context_settings={"help_option_names": ["-h", "--help"]})
@CONFIG
@click.option("--check", is_flag=True, help="Write the settings file and exit, without opening a bus.")
def guard(config: Path, check: bool) -> None:
    """Run the guard of CONFIG's machine, the only process that sends offsets to the drives.

    The guard sends no frame until the daemon arms a correction. It checks every interlock at each SYNC, and ramps the
    offsets to zero on any violation, when the daemon fails, and before it stops. Events are JSON lines on stdout.
    """
    from fdhil.arming import (
        find_corrected_bus,
        get_operator_token,
        make_guard_settings,
        make_run_directory,
        use_systemd_key,
    )
    from fdhil.commissioning import verify_commissioned_drives

    machine = use_systemd_key(machine_config.load_config(config))
    name = find_corrected_bus(machine, str(config))
    token_sha256 = hashlib.sha256(get_operator_token(machine.run_directory).encode()).hexdigest()
    run_directory = machine.guard_directory
    make_run_directory(run_directory)
    text = encode_settings(make_guard_settings(machine, name, run_directory, token_sha256))
    decode_settings(text, str(config))  # settings that the guard would refuse are refused before it starts
    file, bus = run_directory / SETTINGS_NAME, machine.bus[name]
    if check:
        _write_settings(file, text)
        click.echo(f"{file}: settings of the guard for {name}")
        return
    with open_transmit_socket(name, bus) as transmit, lock_bus(bus, transmit, run_directory) as lock:
        # if no NC runs the bus, the drives are compared with their commissioning records
        verify_commissioned_drives(
            machine, name, lambda text: click.echo(json.dumps({"event": "record_void", "text": text}))
        )
        _write_settings(file, encode_settings(make_guard_settings(machine, name, run_directory, token_sha256)))
        greet_hub(name, bus, transmit)
        os.set_inheritable(lock.fileno(), True)
        transmit.set_inheritable(True)
        arguments = ["-m", "fdhil.guard", "--settings", str(file), "--descriptor", str(transmit.fileno())]
        sys.stdout.flush()
        os.execv(sys.executable, [sys.executable, *arguments])


def _write_settings(file: Path, text: str) -> None:
    temporary = file.with_suffix(".new")
    try:
        temporary.unlink(missing_ok=True)
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        with os.fdopen(descriptor, "w", encoding="utf-8") as written:
            written.write(text)
        temporary.replace(file)
    except OSError as error:
        raise DeviceError(str(file), f"cannot be written ({error.strerror}); check the run directory") from None


def main() -> None:
    """Run the command. An error becomes one sentence on stderr and its exit code."""
    prepare_streams()
    sys.exit(run_safely(guard))


if __name__ == "__main__":
    main()
