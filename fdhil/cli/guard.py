"""``fdhil-guard CONFIG``: opens the transmit descriptor of the machine's bus and becomes the guard's process."""

from __future__ import annotations

import hashlib
import json
import math
import os
import pwd
import socket
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil import config as machine_config
from fdhil.cia402 import PdoEntry
from fdhil.cli.bus_lock import lock_bus
from fdhil.cli.main import run_safely
from fdhil.config import Axis, CanBus, MachineConfig, share_fault
from fdhil.errors import ConfigError, ConfigFault, ConnectError, DeviceError, ProtocolError, StoreError
from fdhil.guard.feedforward import FeedforwardLimits
from fdhil.guard.limits import OffsetLimits
from fdhil.guard.protocol import SETTINGS_NAME
from fdhil.guard.settings import AxisSettings, Feedforward, Layout, Pdo, Settings, from_json, to_json

if TYPE_CHECKING:
    from fdhil.commissioning.record import CommissioningRecord
    from fdhil.drivers.cia402.profile import DriveProfile, PdoSpec


CONNECT_S = 5.0
SPEED_STEPS = 2.0  # times the motor's power: room for the load's own inertia and for the sensor's noise
HEARTBEATS_AWAITED = 2.0  # periods of the drive's heartbeat until it counts as lost


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.argument("config", type=click.Path(path_type=Path))
@click.option("--check", is_flag=True, help="Write the settings and stop: opens no bus.")
def guard(config: Path, check: bool) -> None:
    """Run the guard of the machine in CONFIG: the only process of fdhil that may send an offset to a drive.

    It sends no frame until the daemon arms a correction, checks every interlock at each SYNC, and ramps to zero when
    anything is not as it must be: also when the daemon dies, and before it stops itself. Events are JSON lines on
    stdout. Exit codes: 0 stopped with nothing applied, 2 wrong config, 3 bus trouble, or an offset may be left.
    """
    machine = _with_given_key(machine_config.load(config))
    name = corrected_bus(machine, str(config))
    daemons = machine.store.run_directory or machine.store.directory / "run"
    token, run_directory = operator_token(daemons), machine.guard.run_directory or daemons
    _make(run_directory)
    text = to_json(settings_of(machine, name, run_directory, hashlib.sha256(token.encode()).hexdigest()))
    from_json(text, str(config))  # what the guard would refuse is refused before it is started
    file, bus = run_directory / SETTINGS_NAME, machine.bus[name]
    if check:
        _write(file, text)
        click.echo(f"{file}: what the guard would be told of {name}")
        return
    with connect_bus(name, bus) as transmit, lock_bus(bus, transmit, run_directory) as lock:
        _compare_again(machine, name)
        text = to_json(settings_of(machine, name, run_directory, hashlib.sha256(token.encode()).hexdigest()))
        _write(file, text)
        greet(name, bus, transmit)
        os.set_inheritable(lock.fileno(), True)
        transmit.set_inheritable(True)
        arguments = ["-m", "fdhil.guard", "--settings", str(file), "--descriptor", str(transmit.fileno())]
        sys.stdout.flush()
        os.execv(sys.executable, [sys.executable, *arguments])


def _compare_again(machine: MachineConfig, bus: str) -> None:
    """Where no NC runs the bus, ask the commissioned drives whether they still are what was signed off."""
    from fdhil.commissioning.compare import compare_again  # late, as below

    def tell(text: str) -> None:
        click.echo(json.dumps({"event": "record_void", "text": text}))

    compare_again(machine, bus, tell)


def corrected_bus(machine: MachineConfig, source: str) -> str:
    """Return the one bus with axes that may be corrected; ConfigError when there is none, or more than one."""
    buses = {axis.drive.bus for axis in machine.axis.values() if axis.correction is not None}
    if not buses:
        fault = ConfigFault(
            "axis.*.correction", "no axis has this section, so that writing is off", "add it to an axis"
        )
        raise ConfigError(source, [fault])
    if len(buses) > 1:
        fault = ConfigFault("axis.*.drive.bus", f"corrected axes are on {', '.join(sorted(buses))}", "use one bus")
        raise ConfigError(source, [fault])
    return buses.pop()


def settings_of(machine: MachineConfig, bus: str, run_directory: Path, token_sha256: str) -> Settings:
    """Return what the guard needs of the config and the drives' profiles; ConfigError when a profile cannot do it."""
    axes = [_axis(machine, name, axis) for name, axis in machine.axis.items() if axis.correction is not None]
    return Settings(
        bus=bus,
        transport="can_raw" if machine.bus[bus].interface == "socketcan" else "socketcand",
        sync_period_s=machine.machine.sync_period_s,
        clock=machine.guard.clock,
        heartbeat_s=machine.guard.heartbeat_s,
        node_id=machine.guard.node_id,
        token_sha256=token_sha256,
        run_directory=str(run_directory),
        axes=tuple(axes),
        daemon_uid=_user_id(machine.guard.daemon_user),
    )


def _user_id(name: str | None) -> int | None:
    if name is None:
        return None
    try:
        return pwd.getpwnam(name).pw_uid
    except KeyError:
        fault = ConfigFault("guard.daemon_user", f"there is no user {name!r}", "the user of fdhil.service")
        raise ConfigError("config", [fault]) from None


def limits_of(axis: Axis, sync_period_s: float) -> OffsetLimits:
    """Return the limits in whole increments per SYNC cycle, as the planner has them, rounded down. ConfigError."""
    if fault := share_fault(axis, sync_period_s):
        raise ConfigError("config", [ConfigFault("axis.*.correction", fault, "leave this axis uncorrected")])
    return OffsetLimits(*machine_config.OffsetLimits.of(axis, sync_period_s).whole)


def _axis(machine: MachineConfig, name: str, axis: Axis) -> AxisSettings:
    from fdhil.drivers.cia402.profile import load_profile  # late: the drivers' room is heavy, --help is not

    profile = load_profile(axis.drive.profile)
    node_id, period_s = machine.node_id(name), machine.machine.sync_period_s
    per_rad = axis.drive.increments_per_rev / (2 * math.pi)
    target, offset = _rpdo(profile, profile.target, name), _rpdo(profile, profile.offset, name)
    if len(offset.entries) != 1:
        fault = ConfigFault(
            f"axis.{name}.drive.profile", "its offset RPDO maps more than 0x60B0", "give it its own RPDO"
        )
        raise ConfigError(profile.name, [fault])
    record = _record(machine, name)
    return AxisSettings(
        name=name,
        node_id=node_id,
        target=_pdo(target, node_id),
        offset=_pdo(offset, node_id),
        tpdos=tuple(_pdo(spec, node_id) for spec in profile.tpdos if spec.valid),
        increments_per_mm=axis.scaling.increments_per_mm,
        max_speed_mm_s=axis.top_speed_mm_s,
        max_acceleration_mm_s2=axis.max_acceleration_mm_s2,
        sign=axis.drive.sign,
        limits=limits_of(axis, period_s),
        window=round(axis.drive.following_error_window_mm * axis.scaling.increments_per_mm),
        setpoint_delay_cycles=axis.drive.setpoint_delay_cycles,
        heartbeat_timeout_s=heartbeat_timeout_s(machine, name),
        feedforward=_feedforward(profile, machine, name, axis),
        speed_count=abs(profile.speed_rad_s_per_count(axis)) * per_rad * period_s,
        speed_step=SPEED_STEPS * _largest_acceleration_rad_s2(axis) * per_rad * period_s**2,
        travel=None if record is None else record.travel,
        **_commissioned(machine, name, record),
    )


def _commissioned(machine: MachineConfig, name: str, record: CommissioningRecord | None) -> dict[str, Any]:
    """The fingerprint of the drive as it was signed off, and whether something against that was seen since."""
    from fdhil.commissioning.record import holds  # late, as above
    from fdhil.commissioning.void import is_void

    if record is None or not holds(record, machine, name):
        return {}
    return {"record": record.fingerprint, "record_void": is_void(machine.store.directory, name)}


def _largest_acceleration_rad_s2(axis: Axis) -> float:
    """What the motor can do at its current limit, or what the NC asks for where that is more."""
    of_the_motor = axis.regulators.current_limit_a * axis.nominal.K / axis.nominal.Jt
    return max(of_the_motor, axis.max_acceleration_mm_s2 * 2 * math.pi / axis.screw_pitch_mm)


def _feedforward(profile: DriveProfile, machine: MachineConfig, name: str, axis: Axis) -> Feedforward | None:
    """Return what the on-line feed-forward of an axis may send; None without [axis.X.feedforward]."""
    limits = axis.feedforward
    if limits is None:
        return None
    found = profile.find_rpdo(profile.speed_offset)
    if found is None or [(e.index, e.sub) for e in found[0].entries] != [profile.speed_offset, profile.torque_offset]:
        text = f"{profile.name} maps no RPDO with 60B1 and 60B2 alone"
        fault = ConfigFault(f"axis.{name}.feedforward", text, "leave the section out, or give the profile such an RPDO")
        raise ConfigError(profile.name, [fault])
    period = machine.machine.sync_period_s
    speed = axis.drive.increments_per_rev / (2 * math.pi)
    torque = 1e3 / (axis.nominal.K * axis.drive.rated_current_a)
    return Feedforward(
        _pdo(found[0], machine.node_id(name)),
        FeedforwardLimits(
            speed=max(1, math.floor(limits.max_speed_rad_s * speed)),
            speed_rate=max(1, math.floor(limits.max_speed_rate_rad_s2 * speed * period)),
            torque=min(0x7FFF, max(1, math.floor(limits.max_torque_nm * torque))),
            torque_rate=max(1, math.floor(limits.max_torque_rate_nm_s * torque * period)),
        ),
    )


def heartbeat_timeout_s(machine: MachineConfig, axis: str) -> float:
    """How long the drive's heartbeat may be missing, from the 0x1017 that the axis was commissioned with.

    0, never: without a record that can be read (nothing is armed then), for a drive that sends none, and where time is
    the count of SYNC, which says nothing about heartbeats of the wall clock.
    """
    record = _record(machine, axis)
    if record is None or machine.guard.clock == "sync":
        return 0.0
    return HEARTBEATS_AWAITED * record.options.get("1017", 0) * 1e-3


def _record(machine: MachineConfig, axis: str) -> CommissioningRecord | None:
    """The axis' commissioning; None without one that can be read."""
    from fdhil.commissioning.record import load_record  # late, as above

    try:
        return load_record(machine.store.directory, axis, machine.store.commissioning_key)
    except StoreError:
        return None


def _rpdo(profile: DriveProfile, key: tuple[int, int], axis: str) -> PdoSpec:
    found = profile.find_rpdo(key)
    if found is None or not found[0].valid:
        fault = ConfigFault(f"axis.{axis}.drive.profile", f"{profile.name} maps no {key[0]:04X} into an RPDO", "map it")
        raise ConfigError(profile.name, [fault])
    return found[0]


def _pdo(spec: PdoSpec, node_id: int) -> Pdo:
    return Pdo(spec.cob_base + node_id, _layout(spec.entries), spec.every_sync)


def _layout(entries: tuple[PdoEntry, ...]) -> Layout:
    return tuple((entry.index, entry.sub, entry.bits, entry.signed) for entry in entries)


def operator_token(run_directory: Path) -> str:
    """Return the token that arming needs, made at the first start of guard or daemon. DeviceError.

    Under a user of its own the guard is given it by systemd (LoadCredential=token:...).
    """
    from fdhil.arming.token import TOKEN_NAME, ensure_token, read_token  # late, as above

    given = _given(TOKEN_NAME)
    if given is not None:
        return read_token(given.parent)
    _make(run_directory)
    return ensure_token(run_directory)


def _with_given_key(machine: MachineConfig) -> MachineConfig:
    """Take the key of the commissioning records from systemd, where it gives one (LoadCredential)."""
    from fdhil.commissioning.record import KEY_NAME  # late, as above

    given = _given(KEY_NAME)
    if given is None:
        return machine
    return machine.model_copy(update={"store": machine.store.model_copy(update={"commissioning_key": given})})


def _given(name: str) -> Path | None:
    """The credential of that name, None where systemd gives none."""
    folder = os.environ.get("CREDENTIALS_DIRECTORY")
    return Path(folder) / name if folder and (Path(folder) / name).exists() else None


def _make(directory: Path) -> None:
    try:
        directory.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        text = f"cannot be made ({error.strerror}), and nothing is sent; check run_directory and its rights"
        raise DeviceError(str(directory), text) from None


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
