"""Converts MATLAB variables to columns, under their MATLAB names: ``meas.t``, ``data(:,2)``, ``s(3).t``."""

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from fdhil.errors import RecordingError
from fdhil.records import Float
from fdhil.store.recording_table import RecordingTable, check_size

MOST_COLUMNS = 1000
MOST_DEPTH = 8
NO_NUMBERS = "is not a vector of real numbers: save it as one, of type double"
OBJECT = "is an object that only MATLAB can read (timeseries, table, Dataset): save it as a structure or an array"


def convert_variables(variables: Mapping[str, Any], headers: Mapping[str, str], source: str) -> RecordingTable:
    """Return the vectors within variables: scalar structures as mappings, cells and structure arrays as lists.

    A field can also be named by its last part alone, and a signal of a Simulink scope by its label, if they are unique.
    The only ``time`` of a scope is also ``time_s``.
    """
    columns: dict[str, Float] = {}
    doubts: dict[str, str] = {}
    short: list[tuple[str, str]] = []
    for name, alias, value in _walk_variables("", "", variables, 0):
        if len(columns) + len(doubts) > MOST_COLUMNS:
            raise RecordingError(
                f"{source} has more than {MOST_COLUMNS} variables, too many for a recording: save a part"
            )
        if isinstance(value, np.ndarray):
            columns[name] = value
        else:
            doubts[name] = value
        short += [(alias, name)] if alias and alias != name else []
    check_size(max((c.size for c in columns.values()), default=0), len(columns), source)
    many = Counter(alias for alias, _ in short)
    for alias, name in short:
        if alias in columns or alias in doubts:
            continue
        if many[alias] > 1:
            doubts[alias] = (
                f"stands for {' and '.join(n for a, n in short if a == alias)}: give one of these as its name"
            )
        elif name in columns:
            columns[alias] = columns[name]
    times = [name for name in columns if name.endswith(".time")]
    if len(times) == 1:
        columns.setdefault("time_s", columns[times[0]])
    return RecordingTable(headers, columns, frozenset(), doubts)


def extract_headers(headers: Any) -> dict[str, str]:
    """Return the texts and numbers of a structure; nothing for any other value."""
    if not isinstance(headers, dict):
        return {}
    numbers = {key: repr(v.item()) for key, v in headers.items() if isinstance(v, np.ndarray) and v.size == 1}
    return numbers | {key: value for key, value in headers.items() if isinstance(value, str)}


def _walk_variables(name: str, alias: str, value: Any, depth: int) -> Iterator[tuple[str, str, Float | str]]:
    """Yield name, short name, and the vector or the reason why there is none."""
    if depth > MOST_DEPTH:
        return
    if isinstance(value, Mapping):
        label = value.get("label")  # of a signal of a scope
        for field, part in value.items():
            own = label if field == "values" and isinstance(label, str) and label else field
            yield from _walk_variables(f"{name}.{field}" if name else field, own, part, depth + 1)
    elif isinstance(value, list):
        for k, part in enumerate(value[:MOST_COLUMNS], 1):
            yield from _walk_variables(f"{name}({k})", "", part, depth + 1)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        yield from _split_vectors(name, alias, value)
    elif not isinstance(value, (str, bytes, int, float, np.generic)):
        yield name, alias, NO_NUMBERS if isinstance(value, np.ndarray) else OBJECT


def _split_vectors(name: str, alias: str, values: np.ndarray[Any, Any]) -> Iterator[tuple[str, str, Float | str]]:
    values = values.squeeze() if values.ndim > 2 else values
    if values.size == max(values.shape, default=1):
        if values.size > 1:
            yield name, alias, np.asarray(values, dtype=np.float64).ravel()
    elif values.ndim == 2 and min(values.shape) < MOST_COLUMNS:
        is_tall = values.shape[0] >= values.shape[1]
        for k, column in enumerate(values.T if is_tall else values, 1):
            place = f"(:,{k})" if is_tall else f"({k},:)"
            yield f"{name}{place}", f"{alias}{place}" if alias else "", np.array(column, dtype=np.float64)
    else:
        yield name, alias, NO_NUMBERS
