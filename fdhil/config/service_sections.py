"""[store], [guard], [access], [play], [maintenance]: settings of the daemon, the guard and fdhil play."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from fdhil.config.section import Positive, Section


class Store(Section):
    """[store]: recordings and history."""

    directory: Path = Field(Path("fdhil-data"), description="recordings and history; relative to the config's folder")
    run_directory: Path | None = Field(None, description="sockets and token; left out: <directory>/run")
    commissioning_key: Path | None = Field(
        None, description="key that seals the commissioning records, mode 0600; left out: <directory>/commissioning.key"
    )
    keep_windows: int = Field(10_000, ge=1, le=10_000_000, description="recorded windows kept; the oldest go first")


class Guard(Section):
    """[guard]: the process that owns the transmit socket."""

    node_id: int = Field(100, ge=1, le=127, description="node-ID of the guard's heartbeat")
    heartbeat_s: Positive = Field(0.020, ge=0.001, le=1.0, description="period of that heartbeat while armed")
    clock: Literal["monotonic", "sync"] = Field(
        "monotonic",
        description="sync: time is SYNC count x period, for a simulated machine that does not run in real time",
    )
    run_directory: Path | None = Field(None, description="the guard's socket and settings; left out: that of [store]")
    daemon_user: str | None = Field(None, description="the daemon's user, where the guard runs as another one")


class Access(Section):
    """[access]: which users of this computer may talk to daemon and guard, besides their own users and root."""

    watch: tuple[str, ...] = Field((), description="users who may read, subscribe and disarm, also at the guard")
    operate: tuple[str, ...] = Field(
        (),
        description="users who may also acknowledge, and arm by the operator's token; fdhil-web: to act from a browser",
    )


class Play(Section):
    """[play]: fdhil in place of an NC on a test bench (fdhil play)."""

    node_id: int = Field(101, ge=1, le=127, description="node-ID of its heartbeat, which the drives monitor")
    heartbeat_s: Positive = Field(0.020, ge=0.001, le=1.0, description="its period; a drive that misses three stops")


class Maintenance(Section):
    """[maintenance]: relative change of a parameter since its first published value that raises an alarm."""

    R: Positive = Field(0.3, ge=1e-3, le=100, description="relative change")
    L: Positive = Field(0.3, ge=1e-3, le=100, description="relative change")
    K: Positive = Field(0.1, ge=1e-3, le=100, description="relative change")
    Jt: Positive = Field(0.3, ge=1e-3, le=100, description="relative change")
    ft: Positive = Field(1.0, ge=1e-3, le=100, description="relative change")
    Cd: Positive = Field(1.0, ge=1e-3, le=100, description="relative change")
