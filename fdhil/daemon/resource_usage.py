"""Measures this process' memory, descriptors and threads against their limits (Linux).

The limit is the tightest of systemd's (MemoryMax, TasksMax) and the process' own (LimitNOFILE).
"""

import errno
import os
import resource
from dataclasses import dataclass
from pathlib import Path

from fdhil.records import Notice

HIGH, LOW = 0.8, 0.7  # used share above which a notice is raised, and below which it ends
CGROUPS = Path("/sys/fs/cgroup")


@dataclass(frozen=True, slots=True)
class ResourceUse:
    """Use of one resource and its limit, None where there is none."""

    name: str
    used: int
    allowed: int | None

    @property
    def used_share(self) -> float:
        """Used share of the limit; 0 without a limit."""
        return self.used / self.allowed if self.allowed else 0.0


def measure_usage(process: Path = Path("/proc/self"), cgroups: Path = CGROUPS) -> tuple[ResourceUse, ...]:
    """Return memory in bytes, descriptors and threads of this process; empty where they cannot be read.

    Reading needs a descriptor: when none is left, only that is returned.
    """
    try:
        return _read_usage(process, cgroups)
    except OSError as error:
        most = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        return (ResourceUse("descriptors", most, most),) if error.errno in (errno.EMFILE, errno.ENFILE) else ()


def _read_usage(process: Path, cgroups: Path) -> tuple[ResourceUse, ...]:
    group = cgroups / _read_control_group(process)
    resident = int((process / "statm").read_text("ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")
    descriptors = sum(1 for _ in (process / "fd").iterdir())
    threads = sum(1 for _ in (process / "task").iterdir())
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return (
        ResourceUse("memory_bytes", resident, _read_limit(group / "memory.max")),
        ResourceUse("descriptors", descriptors, most if most != resource.RLIM_INFINITY else None),
        ResourceUse("threads", threads, _read_limit(group / "pids.max")),
    )


def _read_control_group(process: Path) -> str:
    for line in (process / "cgroup").read_text("utf-8").splitlines():
        if line.startswith("0::/"):
            return line[4:]
    return ""


def _read_limit(file: Path) -> int | None:
    try:
        text = file.read_text("ascii").strip()
    except OSError:
        return None
    return int(text) if text.isdecimal() else None


class ResourceWatch:
    """Reports once that a resource is nearly exhausted, and once that it no longer is."""

    def __init__(self) -> None:
        self._high: set[str] = set()

    def check_usage(self, found: tuple[ResourceUse, ...]) -> list[Notice]:
        """Return notices about the measured use."""
        notices: list[Notice] = []
        for use in found:
            if use.used_share >= HIGH and use.name not in self._high:
                self._high.add(use.name)
                notices.append(Notice("ResourceHigh", "minor", f"the daemon uses {_describe_use(use)}"))
            elif use.used_share < LOW and use.name in self._high:
                self._high.discard(use.name)
                notices.append(Notice("ResourceHigh", "info", f"the daemon uses {_describe_use(use)} again"))
        return notices


def _describe_use(use: ResourceUse) -> str:
    if use.name == "memory_bytes":
        return f"{use.used / 1e6:.0f} MB of {(use.allowed or 0) / 1e6:.0f} MB of memory"
    return f"{use.used} of {use.allowed} {use.name}"
