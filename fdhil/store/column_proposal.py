"""Proposes a column map for another program's file: by headings, units, sizes, and the physics of the signals.

Voltage, current and speed obey u = R i + L di/dt + K w with positive R, L and K, and torque accelerates an inertia: of
the columns that headings and units leave open, those that fit both equations best are proposed.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from types import MappingProxyType

import numpy as np

from fdhil.csv_text import quote_cell
from fdhil.errors import RecordingError
from fdhil.records import Float
from fdhil.store.column_map import FACTORS, complete_heading, find_heading_units
from fdhil.store.recording_file import read_raw
from fdhil.store.recording_table import PATH, RecordingTable

HEADINGS: Mapping[str, str] = {  # in this order: a "position demand" is a demand, a "speed voltage" a speed
    "time_s": r"^t$|time|zeit|temps|^x-axis$|second|sekunde|timestamp",
    "demand_m": r"demand|set.?p|soll|target|command.*pos|pos.*(cmd|command|ref)|ref.*pos",
    "torque_Nm": r"torque|moment|couple",
    "current_A": r"curr|strom|courant|amp[eè]re|^i$|^i[_ ]|_i$",
    "speed_rad_per_s": r"speed|velo|drehzahl|vitesse|omega|rpm|tacho|n_act|^w$|^w[_ ]",
    "position_m": r"pos|lage|weg|encoder|angle|winkel|theta",
    "voltage_V": r"volt|spannung|tension|^u$|^u[_ ]|_u$|^v$",
}
KEPT_ROWS = 4000  # tested against the equations
LEVELS = 20  # distinct values of a signal; a column with fewer is a state
EXPLAINED = 0.5  # least product of both equations' shares for columns to be taken as u, i and w
RPM_FROM = 700.0  # a larger speed without a unit is assumed to be in rpm


@dataclass(frozen=True)
class ProposedColumn:
    """One signal's column: its heading, the unit of its numbers, and the reason."""

    signal: str
    heading: str
    unit: str
    why: str


@dataclass(frozen=True)
class ColumnProposal:
    """A proposed column map: its columns, headers, and the ``faults`` that prevent its use.

    ``aside`` are columns that need a pitch, which no file contains.
    """

    columns: Sequence[ProposedColumn]
    headers: Mapping[str, str | float]
    faults: Sequence[str]
    aside: Sequence[ProposedColumn] = ()

    @property
    def toml(self) -> str:
        lines = ["# proposed by fdhil: check every line", "[headers]"]
        lines += [f"{key} = {json.dumps(value)}" for key, value in self.headers.items()]
        if self.aside:
            lines.append("# pitch_m_per_rev = 0.01  # required by the columns that are commented out below")
        lines += ["", "[columns]"]
        for mark, each in [*(("", c) for c in self.columns), *(("# ", c) for c in self.aside)]:
            name, unit = json.dumps(each.heading), json.dumps(each.unit)
            lines.append(f"{mark}{each.signal} = {{ name = {name}, unit = {unit} }}  # {each.why}")
        return "\n".join(lines) + "\n"

    def format_lines(self) -> Iterator[str]:
        for each in (*self.columns, *self.aside):
            yield f"  {each.signal:16} {each.heading!r} in {each.unit}: {each.why}"


def propose_columns(path: Path) -> ColumnProposal:
    """Return the column map that a file suggests. Raises RecordingError if it cannot be read."""
    return propose_for_table(read_raw(path))


def propose_for_table(
    raw: RecordingTable, given: Mapping[str, str | Sequence[str]] = MappingProxyType({}), source: str = "recording"
) -> ColumnProposal:
    """Return the column map that the columns of a file suggest.

    ``given`` maps signals to a heading, a part of one, or heading and unit; then no other signals are searched.
    """
    if given:
        return _use_given_columns(raw, given, source)
    columns = _select_distinct_columns(raw)
    by_name: dict[str, list[str]] = {}
    for heading in columns:
        if (signal := _classify_heading(heading, raw)) is not None:
            by_name.setdefault(signal, []).append(heading)
    found = {s: (headings[0], "by its heading") for s, headings in by_name.items() if len(headings) == 1}
    headers: dict[str, str | float] = {"axis": "X"}
    time = found.get("time_s") or _find_time_column(columns)
    if time is not None:
        found["time_s"] = time
    _assign_by_physics(columns, found, by_name)
    if "voltage_V" in found:
        headers["voltage_sampling"] = _determine_voltage_sampling(columns, found)
    faults = []
    if "time_s" not in found:
        faults.append("no column rises evenly like a time: give sample_rate_hz under [headers]")
    if not found.keys() & {"current_A", "torque_Nm"}:
        faults.append("no current recognised")
    if not found.keys() & {"speed_rad_per_s", "angle_rad"}:
        faults.append("no speed recognised")
    if "current_A" in found:
        found.pop("torque_Nm", None)
    proposed = [_add_unit(signal, *found[signal], columns, raw) for signal in FACTORS if signal in found]
    aside = [each for each in proposed if each.signal in PATH]
    return ColumnProposal([each for each in proposed if each not in aside], headers, faults, aside)


def _use_given_columns(raw: RecordingTable, given: Mapping[str, str | Sequence[str]], source: str) -> ColumnProposal:
    proposed, found = [], {}
    for signal, name_and_unit in given.items():
        if signal not in FACTORS:
            raise RecordingError(f"{source}: unknown signal {signal!r}; signals are {', '.join(FACTORS)}")
        part, *unit = (name_and_unit,) if isinstance(name_and_unit, str) else name_and_unit
        heading = complete_heading(raw, part, source)
        if heading not in raw.columns:
            listed = ", ".join(map(quote_cell, _select_distinct_columns(raw)))
            raise RecordingError(f"{source} has no column {quote_cell(part)}; it has {listed}: correct columns")
        found[signal] = (heading, "given")
        known = unit[0] if unit else _find_unit(heading, raw, signal) or next(iter(FACTORS[signal]))  # SI
        proposed.append(ProposedColumn(signal, heading, known, "given"))
    headers: dict[str, str | float] = {"axis": "X"}
    if "voltage_V" in found:
        headers["voltage_sampling"] = _determine_voltage_sampling(raw.columns, found)
    return ColumnProposal(proposed, headers, [])


def _select_distinct_columns(raw: RecordingTable) -> dict[str, Float]:
    found: dict[int, str] = {}
    for name, values in raw.columns.items():
        known = found.get(id(values))
        if known is None or (known.startswith("#") and not name.startswith("#")):
            found[id(values)] = name
    usable = {name: raw.columns[name] for name in found.values() if name not in raw.doubts}
    sizes = Counter(values.size for values in usable.values()).most_common(1)
    return {name: values for name, values in usable.items() if values.size == sizes[0][0]}


def _classify_heading(heading: str, raw: RecordingTable) -> str | None:
    text = heading.strip().lower()
    if any("%" in unit for unit in find_heading_units(raw, heading)):
        return None
    for signal, pattern in HEADINGS.items():
        if re.search(pattern, text):
            return "angle_rad" if signal == "position_m" and _find_unit(heading, raw, "angle_rad") else signal
    fitting = [signal for signal in HEADINGS if _find_unit(heading, raw, signal)]
    return fitting[0] if len(fitting) == 1 else None


def _find_unit(heading: str, raw: RecordingTable, signal: str) -> str | None:
    return next((u for u in find_heading_units(raw, heading) if u in FACTORS[signal]), None)


def _find_time_column(columns: Mapping[str, Float]) -> tuple[str, str] | None:
    for heading, values in columns.items():
        steps = np.diff(values)
        if steps.size and np.isfinite(steps).all() and (steps > 0).all() and np.ptp(steps) < 0.1 * np.median(steps):
            return heading, "rises evenly"
    return None


def _assign_by_physics(
    columns: Mapping[str, Float], found: dict[str, tuple[str, str]], by_name: Mapping[str, Sequence[str]]
) -> None:
    wanted = ("voltage_V", "current_A", "speed_rad_per_s")
    if all(signal in found for signal in wanted):
        return
    taken = {heading for signal, (heading, _) in found.items() if signal not in wanted}
    free = [h for h, v in columns.items() if h not in taken and np.isfinite(v).all() and np.unique(v).size >= LEVELS]
    choices = []
    for triple in permutations(free, 3):
        fits = all(s not in found or found[s][0] == h for s, h in zip(wanted, triple, strict=True))
        fits = fits and all(s not in by_name or h in by_name[s] for s, h in zip(wanted, triple, strict=True))
        fits = fits and not any(_has_other_unit(h, s) for s, h in zip(wanted, triple, strict=True))
        if fits:
            choices.append((compute_explained_share(*(columns[h][:KEPT_ROWS] for h in triple)), triple))
    if choices and (best := max(choices))[0] > EXPLAINED:
        for signal, heading in zip(wanted, best[1], strict=True):
            found.setdefault(signal, (heading, f"fits the equations by {best[0]:.0%}"))


def _has_other_unit(heading: str, signal: str) -> bool:
    found = re.search(r"[\[(]([^\[\]():,]*[^\[\]():,\d\s][^\[\]():,]*)[\])]$", heading.strip())
    return found is not None and found[1] not in FACTORS[signal]


def compute_explained_share(voltage: Float, current: Float, speed: Float) -> float:
    """Return the share of [1] and [2] that voltage, current and speed (n,) explain; 0 for negative parameters."""
    middle = [(v[1:] + v[:-1]) / 2 for v in (current, speed)]
    electrical = _explain_variance(voltage[:-1], [middle[0], np.diff(current), middle[1]])
    mechanical = _explain_variance(middle[0], [np.diff(speed), middle[1], np.sign(middle[1])])
    if electrical is None or mechanical is None or min(electrical[1][0], electrical[1][2], mechanical[1][0]) <= 0.0:
        return 0.0
    return electrical[0] * mechanical[0]


def _determine_voltage_sampling(columns: Mapping[str, Float], found: Mapping[str, tuple[str, str]]) -> str:
    if not found.keys() >= {"current_A", "speed_rad_per_s"}:
        return "instant"
    u, i, w = (columns[found[s][0]][:KEPT_ROWS] for s in ("voltage_V", "current_A", "speed_rad_per_s"))
    instant = np.append((u[1:] + u[:-1]) / 2, u[-1])
    return "interval_mean" if compute_explained_share(u, i, w) > compute_explained_share(instant, i, w) else "instant"


def _explain_variance(values: Float, regressors: Sequence[Float]) -> tuple[float, Float] | None:
    table = np.column_stack([*regressors, np.ones(values.size)])
    size = np.abs(table).max(axis=0)
    variance = float(np.var(values))
    if not variance > 0.0 or not (size > 0.0).all():
        return None
    weights = np.linalg.lstsq(table / size, values, rcond=None)[0]
    return 1.0 - float(np.var(values - table / size @ weights)) / variance, weights


def _add_unit(signal: str, heading: str, why: str, columns: Mapping[str, Float], raw: RecordingTable) -> ProposedColumn:
    if (unit := _find_unit(heading, raw, signal)) is not None:
        return ProposedColumn(signal, heading, unit, why)
    values = columns[heading]
    unit = next(iter(FACTORS[signal]))
    if signal == "time_s" and float(np.median(np.diff(values))) >= 0.05:
        unit = "ms"
    elif signal == "speed_rad_per_s" and float(np.nanmax(np.abs(values))) > RPM_FROM:
        unit = "rpm"
    elif signal in ("position_m", "demand_m") and float(np.ptp(values)) > math.tau:
        unit = "mm"
    return ProposedColumn(signal, heading, unit, f"{why}; unit guessed by size")
