"""Rapids of the simulated bench in the form stored by the fleet server, and their repeated analysis."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path

from fdhil.config import Identification
from fdhil.fleet import objects
from fdhil.fleet.window_work import Again, Method, Stored, code_digest
from fdhil.store.windows import encode_window
from tests.identification.recorded import windows


def stored(folder: Path, machines: int, each: int) -> list[Stored]:
    """Store windows of several machines as window files in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    return [Stored(f"mill-{k}", name) for k in range(machines) for name in _kept(folder, each, 100 * k)]


def _kept(folder: Path, count: int, seed: int) -> Iterator[str]:
    for k in range(count):
        content = encode_window(windows(0.003, seed + k, moves=2)[1], "of-the-machine")
        name = hashlib.sha256(content).hexdigest()
        objects.keep(folder, name, content)
        yield name


def method(folder: Path, name: str | None = "least_squares") -> Method:
    """Return a method whose results are fast to compute."""
    return Method(Identification(method=name), {}, folder, code_digest())


def bits(results: Sequence[Again]) -> list[Again]:
    """Return results in the order of their windows, to be compared byte for byte."""
    return sorted(results)
