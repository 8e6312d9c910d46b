"""The files of a forecast, written by its process: a JSON document, and its rows as arrays."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fdhil.records import Correction, Float, Int

DOCUMENT = "forecast.json"
ADVICE = "advice.json"
BEFORE, AFTER = 0, 1


@dataclass(frozen=True, slots=True)
class StoredForecast:
    """The rows of a program, one per SYNC period: without correction (``BEFORE``) and with it (``AFTER``).

    ``path_mm`` (n, d) is the NC's demand, ``error_um`` (2, n, d) predicted less demanded position of each axis,
    ``contour_um`` (2, n) the contour error, ``line`` (n,) the program's line, 0 without one.
    """

    document: dict[str, Any]
    path_mm: Float
    error_um: Float
    contour_um: Float
    line: Int

    @property
    def axes(self) -> tuple[str, ...]:
        return tuple(self.document["axes"])

    @property
    def dt_s(self) -> float:
        return float(self.document["sync_period_s"])

    def compute_table_mm(self, case: int, rows: slice) -> Float:
        """Return the predicted table position (m, d)."""
        return np.asarray(self.path_mm[rows] + self.error_um[case, rows] * 1e-3)

    def compute_feed_mm_min(self, rows: slice) -> Float:
        """Return the demanded speed along the path (m,), from each row to the next."""
        first, last, _ = rows.indices(len(self.path_mm))
        return np.asarray(np.linalg.norm(_compute_steps(self.path_mm, first, last), axis=1) / self.dt_s * 60.0)

    @staticmethod
    def read_folder(folder: Path) -> StoredForecast:
        """Map the files in a folder. Raises OSError or ValueError if they are incomplete."""
        document = json.loads((folder / DOCUMENT).read_text("utf-8"))
        arrays = (np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False) for name in _NAMES)
        return StoredForecast(document, *arrays)


_NAMES = ("path_mm", "error_um", "contour_um", "line")


def _compute_steps(path_mm: Float, first: int, last: int) -> Float:
    """Return the way from each row to the next (last - first, d); 0 for the last row of all."""
    part = path_mm[first : last + 1]
    steps = np.diff(part, axis=0)
    return steps if len(steps) == last - first else np.vstack([steps, np.zeros((1, part.shape[1]))])


def write_forecast(folder: Path, document: dict[str, Any], planned: Correction) -> None:
    """Write a forecast into a folder, its document last. Raises OSError."""
    cases = (planned.before, planned.after)
    reference = planned.before.reference
    arrays = {
        "path_mm": reference.path_mm,
        "error_um": np.stack([reference.compute_table_mm(case.predicted_mm) - reference.path_mm for case in cases])
        * 1e3,
        "contour_um": np.stack([case.contour_um for case in cases]),
        "line": reference.line,
    }
    kinds = {"error_um": "<f4", "contour_um": "<f4", "line": "<i4", "path_mm": "<f8"}
    for name, values in arrays.items():
        np.save(folder / f"{name}.npy", np.ascontiguousarray(values, dtype=kinds[name]), allow_pickle=False)
    (folder / DOCUMENT).write_text(json.dumps(document, allow_nan=False), "utf-8")


def write_advice(folder: Path, tolerance_um: float, lines: list[dict[str, Any]]) -> None:
    """Write the feeds that keep a tolerance next to the forecast. Raises OSError."""
    (folder / ADVICE).write_text(json.dumps({"tolerance_um": tolerance_um, "lines": lines}, allow_nan=False), "utf-8")


def read_advice(folder: Path) -> list[dict[str, Any]]:
    """Return the stored feeds. Raises OSError or ValueError if they are incomplete."""
    lines: list[dict[str, Any]] = json.loads((folder / ADVICE).read_text("utf-8"))["lines"]
    return lines
