"""Rapids of the simulated bench in the form stored by the fleet server, and their repeated analysis."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path

from fdhil.config import Identification
from fdhil.fleet import window_files
from fdhil.fleet.window_reanalysis import AnalysisMethod, ReanalysedWindow, WindowReference, compute_code_digest
from fdhil.store.window_file import encode_window
from tests.identification.bench_recordings import find_noisy_windows


def store_rapids(folder: Path, machines: int, each: int) -> list[WindowReference]:
    """Store windows of several machines as window files in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    return [
        WindowReference(f"mill-{k}", name) for k in range(machines) for name in _store_window(folder, each, 100 * k)
    ]


def _store_window(folder: Path, count: int, seed: int) -> Iterator[str]:
    for k in range(count):
        content = encode_window(find_noisy_windows(0.003, seed + k, moves=2)[1], "of-the-machine")
        name = hashlib.sha256(content).hexdigest()
        window_files.store_window(folder, name, content)
        yield name


def create_method(folder: Path, name: str | None = "least_squares") -> AnalysisMethod:
    """Return a method whose results are fast to compute."""
    return AnalysisMethod(Identification(method=name), {}, folder, compute_code_digest())


def list_results(results: Sequence[ReanalysedWindow]) -> list[ReanalysedWindow]:
    """Return results in the order of their windows, to be compared byte for byte."""
    return sorted(results)
