"""The TCP ports at which a process listens, from the kernel's tables."""

from __future__ import annotations

from pathlib import Path

LISTEN = "0A"


def list_tcp_ports(pid: int) -> set[int]:
    sockets = set()
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        try:
            sockets.add(str(descriptor.readlink()))
        except FileNotFoundError:
            continue
    return {port for port, inode in _list_listeners(pid) if f"socket:[{inode}]" in sockets}


def _list_listeners(pid: int) -> list[tuple[int, str]]:
    lines = [
        line.split() for name in ("tcp", "tcp6") for line in Path(f"/proc/{pid}/net/{name}").read_text().splitlines()
    ]
    return [(int(line[1].rpartition(":")[2], 16), line[9]) for line in lines if line[3] == LISTEN]
