"""Announces that the numerics must be compiled, which happens once and takes several seconds."""

import functools
import os
import sys
from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path

import click

# what a command needs -> its compiled modules, and about how many seconds each takes
NEEDS: Mapping[str, Mapping[str, float]] = {
    "predict": {"fdhil.model.closed_loop_kernels": 4, "fdhil.prediction.contour_kernels": 1},
    "correct": {"fdhil.correction.offset_kernels": 10},
    "identify": {
        "fdhil.identification.kalman": 12,
        "fdhil.model.feed_drive": 2,
    },
}


@functools.cache
def announce_compilation(*needs: str) -> None:
    """Announce on stderr, once, how long the kernels for ``needs`` will compile; silent when they are compiled."""
    seconds = sum(s for need in needs for module, s in NEEDS[need].items() if not is_compiled(module))
    if seconds:
        click.echo(f"compiling the numerics, once, about {seconds:.0f} s", err=True)


def is_compiled(module: str) -> bool:
    """Whether numba's cache has an index of a module newer than its source; checked without importing numba."""
    spec = find_spec(module)
    assert spec is not None
    assert spec.origin is not None
    source = Path(spec.origin)
    changed_s = source.stat().st_mtime
    pattern = f"{source.stem}.*.py{sys.version_info.major}{sys.version_info.minor}.nbi"
    return any(
        index.stat().st_mtime >= changed_s for folder in _list_cache_folders(source) for index in folder.glob(pattern)
    )


def _list_cache_folders(source: Path) -> Iterator[Path]:
    if own := os.environ.get("NUMBA_CACHE_DIR"):
        yield from Path(own).glob(f"{source.parent.name}_*")
        return
    yield source.parent / "__pycache__"
    yield from (Path.home() / ".cache" / "numba").glob(f"{source.parent.name}_*")
