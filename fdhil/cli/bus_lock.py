"""Locks a bus for one owner by its physical endpoint, whatever its name, in a file that other users cannot reach.

The lock covers all processes of one user, and root together with the guard's user. It cannot recognise one bus behind
two endpoints: two addresses of a remote hub, a tunnel, two interfaces on one cable, another computer. There the guards
detect each other's heartbeat on the bus (``BusLocked``).
"""

import fcntl
import hashlib
import ipaddress
import os
import pwd
import socket
import stat
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from fdhil.config import CanBus
from fdhil.errors import ConnectError, DeviceError

SHARED_DIRECTORY = Path("/run/fdhil-guard")
LOCK_NAME = "bus.lock"


def lock_bus(bus: CanBus, transmit: socket.socket | None = None, run_directory: Path | None = None) -> IO[bytes]:
    """Lock a bus and a run directory until the returned file is closed or the process ends.

    ``transmit`` is the open socket; without it the host of the configuration is resolved. Raises DeviceError
    (``BusLocked``) if another process owns the bus, ConnectError if the bus is not found.
    """
    places = [resolve_bus_endpoint(bus, transmit)]
    if bus.interface == "socketcan":  # a replugged adapter has a new index and the same name
        places.append(f"interface {bus.channel} of {_describe_this_computer()}")
    if run_directory is not None:
        places.append(f"directory {run_directory.resolve()}")
    return _lock_endpoints(places)


def _lock_endpoints(places: Sequence[str]) -> IO[bytes]:
    try:
        file = os.fdopen(_open_lock_file(_find_lock_directory()), "rb")
    except (OSError, KeyError) as error:
        text = f"the lock of the bus cannot be created ({error}), and nothing was sent; give this user a home directory"
        raise DeviceError(str(SHARED_DIRECTORY), text) from None
    try:
        for place in places:
            _lock_byte_range(file, place)
    except DeviceError:
        file.close()
        raise
    return file


def lock_bus_part(bus: CanBus, what: str) -> IO[bytes]:
    """Lock one function of a bus, in addition to the guard's lock. Raises DeviceError (``BusLocked``), ConnectError."""
    return _lock_endpoints([f"{what} of {resolve_bus_endpoint(bus)}"])


def resolve_bus_endpoint(bus: CanBus, transmit: socket.socket | None = None) -> str:
    """Return the endpoint of a bus: an interface of this network namespace, or a channel behind a hub's port.

    All addresses of this computer count as one.
    """
    here = _describe_this_computer()
    try:
        if bus.interface == "socketcan":
            index = socket.if_nametoindex(transmit.getsockname()[0] if transmit else bus.channel)
            return f"interface {index} of {here}"
        if bus.interface == "virtual":
            return f"{bus.channel} in process {os.getpid()}"
        if transmit is not None:
            address = transmit.getpeername()[0]
        else:
            address = socket.getaddrinfo(bus.host, bus.port, type=socket.SOCK_STREAM)[0][4][0]
    except OSError as error:
        name = bus.channel if bus.interface == "socketcan" else bus.host
        text = f"cannot be found ({error.strerror}), and nothing was sent; check [bus] channel and host"
        raise ConnectError(name, text) from None
    place = here if _is_local_address(str(address)) else address
    return f"{bus.channel} behind port {bus.port} of {place}"


def _describe_this_computer() -> str:
    return f"this computer (network {Path('/proc/self/ns/net').stat().st_ino})"


def _is_local_address(address: str) -> bool:
    # the source address of a packet to a local address is that address
    found = ipaddress.ip_address(address.partition("%")[0])
    if isinstance(found, ipaddress.IPv6Address) and found.ipv4_mapped is not None:
        found = found.ipv4_mapped
    if found.is_loopback or found.is_unspecified:
        return True
    with socket.socket(socket.AF_INET if found.version == 4 else socket.AF_INET6, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((str(found), 9))  # sends nothing, only looks up the route
        except OSError:
            return False
        return ipaddress.ip_address(probe.getsockname()[0].partition("%")[0]) == found


def _find_lock_directory() -> Path:
    """Return the directory of the guard's unit if this user owns it (root: in any case), else one in the user's home.

    Neither $HOME nor /tmp are used: all processes of a user must agree, and no other user may create it.
    """
    user = os.getuid()
    if user == 0:
        SHARED_DIRECTORY.mkdir(mode=0o755, exist_ok=True)
    if _is_owned_by_user(SHARED_DIRECTORY, user):
        return SHARED_DIRECTORY
    home = Path(pwd.getpwuid(user).pw_dir) / ".cache" / "fdhil"
    home.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not _is_owned_by_user(home, user):
        raise PermissionError(1, "others can write there", str(home))
    return home


def _is_owned_by_user(directory: Path, user: int) -> bool:
    try:
        found = directory.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and user in (0, found.st_uid) and not found.st_mode & 0o022


def _open_lock_file(directory: Path) -> int:
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    descriptor = os.open(directory / LOCK_NAME, flags, 0o600)
    if os.getuid() == 0:  # a file created by root must not lock out the guard's user
        os.fchown(descriptor, directory.stat().st_uid, -1)
    return descriptor


def _lock_byte_range(file: IO[bytes], place: str) -> None:
    """Lock the byte of the file that represents an endpoint, as an open-file lock, which survives exec."""
    byte = int.from_bytes(hashlib.sha256(place.encode()).digest()[:8], "big") >> 2
    try:
        fcntl.fcntl(file, fcntl.F_OFD_SETLK, struct.pack("hhqqi", fcntl.F_WRLCK, os.SEEK_SET, byte, 1, 0))
    except OSError:
        text = "BusLocked: another guard, commissioning or play owns it, and nothing was sent; stop that one first"
        raise DeviceError(place, text) from None
