"""A compilation of the kernels is announced before it delays a command, and only then."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from fdhil.api import compilation_notice
from fdhil.correction import offset_kernels


def test_cold_cache_is_announced_once_with_duration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    compilation_notice.announce_compilation.cache_clear()
    for _ in range(2):
        compilation_notice.announce_compilation("predict", "correct")
    compilation_notice.announce_compilation.cache_clear()
    message = capsys.readouterr()
    assert message.out == ""
    assert message.err == "compiling the numerics, once, about 15 s\n"


def test_cached_kernels_of_numba_are_detected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The cache of a kernel of this process is the one that is examined."""
    source = Path(offset_kernels.__file__)
    cache = offset_kernels._compute_differences.stats.cache_path  # type: ignore[attr-defined]
    assert Path(cache) in list(compilation_notice._list_cache_folders(source))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    folder = tmp_path / f"{source.parent.name}_0"
    folder.mkdir()
    version = f"py{sys.version_info.major}{sys.version_info.minor}"
    made = folder / f"{source.stem}._solve_plain-51.{version}.nbi"
    made.touch()
    assert compilation_notice.is_compiled("fdhil.correction.offset_kernels")
    os.utime(made, (0, 0))  # older than the source: numba recompiles
    assert not compilation_notice.is_compiled("fdhil.correction.offset_kernels")
