"""A daemon status with every value known, and publishers that run in this process."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from fdhil import tables
from fdhil.config import MachineConfig
from fdhil.records import PARAMETERS, UNITS

NOW_MS = 1_800_000_000_000
VALUES = {"R": 0.5, "L": 0.005, "K": 0.8, "Jt": 0.075, "ft": 0.05, "Cd": 5.0}
ARMED = {
    "program": "/home/operator/part.ngc",
    "method": "inverse",
    "before": {"rms_um": 12.0, "max_um": 30.0},
    "after": {"rms_um": 3.0, "max_um": 9.0, "uncertainty_um": 0.5},
}
PASS = {"pass": 4, "program": "/home/operator/part.ngc", "measured": {"rms_um": 3.2, "max_um": 9.5}, "text": "pass 4"}


def status(axes: str = "XY", **changes: Any) -> dict[str, Any]:
    return {
        "ok": True,
        "schema": "fdhil-status-1",
        "state": "ACTIVE",
        "machine": "bench",
        "config_digest": "0123456789abcdef",
        "uptime_s": 1000.0,
        "source": {"state": "listening", "lost_times": 1, "heard_s_ago": 0.0},
        "sync": {"rate_hz": 999.9, "expected_hz": 1000.0},
        "bus_load_percent": {"can0": 42.0},
        "nc": {
            "motion": "feed", "line": 17, "program": "/nc/part.ngc", "feed_mm_min": 6000.0, "feed_override": 1.0,
            "rapid_override": 0.5, "heard_s_ago": 0.25,
        },
        "troubles": [],
        "unacknowledged": {"count": 3, "MAJOR": 1, "newest": []},
        "axes": {axis: axis_status() for axis in axes},
        "notices": [notice("Armed", 5.0)],
        "frames": {"received": 123456, "lost": 2},
        "counters": {"frames": 123456, "lost": 2, "records_dropped": 0},
        "guard": {
            "state": "ACTIVE", "heard_s_ago": 0.5, "offset_um": dict.fromkeys(axes, 4.5),
            "may_stand_um": dict.fromkeys(axes, 4.6),
        },
        "may_stand": {"nothing": False, "text": "+4.6 um on axis X may still be applied"},
        "armed": ARMED,
        "passes": [PASS],
        "store": {"directory": "/var/lib/fdhil", "fault": None},
        **changes,
    }  # fmt: skip


def axis_status() -> dict[str, Any]:
    parameters = {
        name: {"value": VALUES[name], "low": 0.9 * VALUES[name], "high": 1.1 * VALUES[name], "unit": UNITS[name]}
        for name in PARAMETERS
    }
    return {
        "accepted": 40, "refused": 2, "revision": 7, "windows_used": 31, "temperature_c": 22.5, "slideway_c": 23.5,
        "parameters": parameters, "unexplained_um": 0.7, "warnings": ["Ripple: of the screw"], "samples_s_ago": 0.01,
        "last_window": {"accepted": False, "fit_percent": 98.5, "reasons": ["LowExcitation: too slow"]},
        "skill": {"rms_um": 0.4, "measured_rms_um": 11.0},
    }  # fmt: skip


def notice(code: str, age_s: float, severity: str = "info", text: str = "it was so", axis: str = "") -> dict[str, Any]:
    return {"age_s": age_s, "code": code, "severity": severity, "text": text, "axis": axis, "tick": 0}


def trouble(code: str, axis: str = "", severity: str = "MAJOR", text: str = "it is not so") -> dict[str, Any]:
    return {"code": code, "severity": severity, "axis": axis, "text": text}


@asynccontextmanager
async def publishing(protocol: str, config: MachineConfig) -> AsyncIterator[asyncio.Task[None]]:
    task = asyncio.create_task(tables.load_entry(tables.PUBLISHERS, protocol)(config))
    try:
        yield task
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def said(task: asyncio.Task[None], capsys: Any, words: str) -> str:
    text = ""
    async with asyncio.timeout(120.0):
        while words not in text:
            if task.done():
                task.result()
            await asyncio.sleep(0.01)
            text += capsys.readouterr().err
    return next(line for line in text.splitlines() if words in line)
