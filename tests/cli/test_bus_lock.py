"""One owner per bus, whatever its name, and no interference by other users."""

from __future__ import annotations

import os
import socket
import sys
from pathlib import Path

import pytest

from fdhil.cli import bus_lock
from fdhil.cli.bus_lock import lock_bus, resolve_bus_endpoint
from fdhil.config import CanBus
from fdhil.errors import ConnectError, DeviceError

NOBODY = 65534


@pytest.fixture(autouse=True)
def directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    made = tmp_path / "run"
    made.mkdir(mode=0o755)
    monkeypatch.setattr(bus_lock, "SHARED_DIRECTORY", made)
    return made


def has_ipv6() -> bool:
    try:
        with socket.create_server(("::1", 0), family=socket.AF_INET6):
            return True
    except OSError:
        return False


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1", "127.0.0.2", "0.0.0.0", "::ffff:127.0.0.1", "::1"])
def test_all_names_of_this_computer_are_one_endpoint(host: str) -> None:
    with lock_bus(CanBus(port=47)):
        with pytest.raises(DeviceError, match="BusLocked"):
            lock_bus(CanBus(host=host, port=47))
        lock_bus(CanBus(host=host, port=48)).close()
        lock_bus(CanBus(host=host, port=47, channel="can1")).close()
        lock_bus(CanBus(host="192.0.2.1", port=47)).close()
    lock_bus(CanBus(host=host, port=47)).close()


def test_open_socket_determines_endpoint() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with socket.create_connection(("localhost", port)) as transmit:
            found = resolve_bus_endpoint(CanBus(host="a name that is looked up no more", port=port), transmit)
    assert found == resolve_bus_endpoint(CanBus(host="127.0.0.1", port=port))


def test_interface_is_identified_by_index() -> None:
    lo = socket.if_nametoindex("lo")
    assert resolve_bus_endpoint(CanBus(interface="socketcan", channel="lo")).startswith(f"interface {lo} of")
    with pytest.raises(ConnectError, match="nothing was sent"):
        resolve_bus_endpoint(CanBus(interface="socketcan", channel="none9"))
    with pytest.raises(ConnectError, match="cannot be found"):
        resolve_bus_endpoint(CanBus(host="no.such.host.invalid", port=1))
    assert str(os.getpid()) in resolve_bus_endpoint(CanBus(interface="virtual"))


def test_replugged_adapter_stays_locked(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = CanBus(interface="socketcan", channel="can0")
    monkeypatch.setattr("socket.if_nametoindex", lambda _name: 7)
    with lock_bus(bus):
        monkeypatch.setattr("socket.if_nametoindex", lambda _name: 8)
        with pytest.raises(DeviceError, match="BusLocked"):
            lock_bus(bus)
        lock_bus(CanBus(interface="socketcan", channel="can1")).close()


def test_run_directory_is_locked_for_one_guard(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "run")
    with (
        lock_bus(CanBus(port=47), run_directory=tmp_path / "run"),
        pytest.raises(DeviceError, match="BusLocked"),
    ):
        lock_bus(CanBus(port=48), run_directory=tmp_path / "link")


def test_directory_writable_by_others_is_not_used(
    directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = tmp_path / "home"
    monkeypatch.setattr("pwd.getpwuid", lambda _: type("Entry", (), {"pw_dir": str(home)}))
    directory.chmod(0o777)
    lock_bus(CanBus(port=47)).close()
    assert not (directory / "bus.lock").exists()
    assert (home / ".cache" / "fdhil" / "bus.lock").stat().st_mode & 0o777 == 0o600
    (home / ".cache" / "fdhil").chmod(0o777)
    with pytest.raises(DeviceError, match="nothing was sent"):
        lock_bus(CanBus(port=47))


def test_lock_file_that_is_a_symlink_is_not_followed(directory: Path, tmp_path: Path) -> None:
    (directory / "bus.lock").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(DeviceError, match="nothing was sent"):
        lock_bus(CanBus(port=47))
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.usefixtures("processes")
@pytest.mark.skipif(os.getuid() != 0, reason="needs root, to be somebody else")
def test_other_user_can_neither_lock_nor_block(directory: Path) -> None:
    """The lock file is inaccessible; its former name may be used by anyone."""
    lock_bus(CanBus(port=47)).close()
    squatter = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    squatter.bind("\0fdhil-guard:socketcand:127.0.0.1:47:can0")
    child = os.fork()
    if child == 0:
        os.setgid(NOBODY)
        os.setuid(NOBODY)
        reached = os.access(directory / "bus.lock", os.R_OK) or os.access(directory / "bus.lock", os.W_OK)
        os._exit(int(reached))
    with squatter, lock_bus(CanBus(port=47)):
        assert os.waitpid(child, 0)[1] == 0


@pytest.mark.usefixtures("processes")
def test_lock_survives_exec(directory: Path) -> None:
    """The guard replaces its program by exec; the lock lasts until the process ends."""
    lock = lock_bus(CanBus(port=47))
    os.set_inheritable(lock.fileno(), True)
    read, write = os.pipe()
    child = os.posix_spawn(
        sys.executable, [sys.executable, "-c", f"import os; os.read({read}, 1)"], os.environ,
        file_actions=[(os.POSIX_SPAWN_DUP2, read, read)],
    )  # fmt: skip
    lock.close()
    with pytest.raises(DeviceError, match="BusLocked"):
        lock_bus(CanBus(port=47))
    os.write(write, b"x")
    assert os.waitpid(child, 0)[1] == 0
    lock_bus(CanBus(port=47)).close()
    os.close(read)
    os.close(write)
