"""Output of ``fdhil identify --loops``: the identified and the configured control loops."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from fdhil.records import INTERVAL_95

if TYPE_CHECKING:
    from fdhil.api import FileResult
    from fdhil.config import Axis


def format_loop_status(status: Mapping[str, Any]) -> str:
    """Return the loops of an axis' status as text; empty if they match the configuration."""
    if status["validated"] and not status["warnings"]:
        return ""
    gains = ", ".join(f"{name} {figures['value']:.4g}" for name, figures in status["gains"].items())
    return f"loops {status['structure']}, {gains}; {'; '.join((*status['reasons'], *status['warnings']))}"


def show_loops(result: FileResult, axis: Axis | None, console: Any) -> None:
    """Print the loops of one recording and the following error that they explain."""
    from rich import box
    from rich.table import Table

    from fdhil.api import LOOP_UNITS, get_configured_value, list_equivalent_loops

    found = result.loops
    if found is None:
        console.print("  no loops identified: no rapid with recorded demand, position and current")
        return
    regulators = None if axis is None else axis.regulators
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    status = "" if regulators is None else f" (configured: {regulators.structure})"
    console.print(f"loops: {found.structure}{status}", style="italic")
    for head in ("regulators", "found", "configured", "unit"):
        table.add_column(head, justify="left" if head in ("regulators", "unit") else "right", no_wrap=True)
    for k, (name, value) in enumerate(zip(found.names, found.values.tolist(), strict=True)):
        std = math.sqrt(found.covariance[k, k])
        configured = get_configured_value(regulators, name)
        shown = "-" if configured is None else f"{configured:.5g}"
        table.add_row(name, f"{value:.4g} ± {INTERVAL_95 * std:.2g}", shown, LOOP_UNITS[name])
    console.print(table)
    for same in list_equivalent_loops(found):
        gains = ", ".join(f"{key} {value:.4g}" for key, value in same.items() if not isinstance(value, str))
        console.print(f"  equivalent structure: {same['structure']}, {gains}")
    left = found.verdict.unexplained_um
    text = f"  following error not explained by these loops: {left:.3g} um"
    if found.configured_um is not None:
        text += f", by the configured ones: {found.configured_um:.3g} um"
    console.print(text)
    for reason in (*found.verdict.reasons, *found.verdict.warnings):
        console.print(f"  {reason}; {reason.advice}")
