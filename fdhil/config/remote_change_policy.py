"""Policy for configuration changes proposed by a fleet server: allowed keys, forbidden keys, changes that loosen a
limit.

A key that is in neither table is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# key, or all keys of a table -> whether a larger value loosens a limit
FROM_AFAR: Mapping[str, bool] = {
    "axis.*.nominal.*": False,
    "axis.*.regulators.*": False,
    "axis.*.resonance_hz": False,
    "axis.*.resonance_damping": False,
    "axis.*.max_jerk_mm_s3": False,
    # the offset's own limits are also a share of these two
    "axis.*.rapid_speed_mm_s": True,
    "axis.*.max_acceleration_mm_s2": True,
    "axis.*.correction.*": True,
    "axis.*.feedforward.*": True,
    "correction.*": True,
    "identification.*": False,
    "identification.tolerance_um": True,
    "maintenance.*": True,
    "nc.profile": False,
    "nc.smoothing_s": False,
    "nc.corner": False,
    "nc.rapid_stop": False,
    "nc.settle_s": False,
    "nc.end_rest_s": False,
}
_BUILT = "the construction and wiring of this machine are configured at the machine only"
_SENDING = "senders of set-points and heartbeats are configured at the machine only"
_TRUST = "access and trust are configured at the machine only"
_FILES = "files, sockets and limits of this computer are configured at the machine only"
NEVER: Mapping[str, str] = {
    "machine": _BUILT,
    "axis": _BUILT,
    "axis.*.setpoints": _SENDING,
    "bus": _BUILT,
    "g0": _BUILT,
    "nc_source": _BUILT,
    "nc": _FILES,
    "store": _FILES,
    "guard": _SENDING,
    "play": _SENDING,
    "access": _TRUST,
    "web": _TRUST,
    "publish": _TRUST,
    "uplink": _TRUST,
    "offers": _TRUST,
    "sim": "the simulated machine is configured where it is simulated",
}


def explain_refusal(path: str) -> str:
    """Explain why a key, as ``axis.X.drive.sign``, cannot be changed remotely; empty where it can."""
    if _find_rule(path) is not None:
        return ""
    parts = _replace_axis_name(path).split(".")
    tables = (".".join(parts[:count]) for count in range(len(parts), 0, -1))
    return next((NEVER[table] for table in tables if table in NEVER), "no remote change of it is allowed")


def is_loosening(path: str, old: Any, new: Any) -> bool:
    """Return whether a change loosens a limit, or may do so."""
    if not _find_rule(path) or old == new:
        return False
    return old is None or new is None or new > old


def _find_rule(path: str) -> bool | None:
    pattern = _replace_axis_name(path)
    table, _, _ = pattern.rpartition(".")
    return FROM_AFAR.get(pattern, FROM_AFAR.get(f"{table}.*"))


def _replace_axis_name(path: str) -> str:
    top, *rest = path.split(".")
    return ".".join([top, "*", *rest[1:]]) if top == "axis" and rest else path
