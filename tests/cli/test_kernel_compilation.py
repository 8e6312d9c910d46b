"""Compilation of all kernels, by concurrent processes, in any cache folder."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import fdhil

pytestmark = pytest.mark.usefixtures("processes")

ROOT = Path(fdhil.__file__).parent
# entries are kernels that no other kernel calls; those that are called are compiled with their callers
UNCALLED = """
import sys
from numba.core.dispatcher import Dispatcher
from fdhil.cli.kernel_compilation import compile_all
compile_all()
modules = [m for name, m in sys.modules.items() if name.startswith("fdhil.")]
named = {(name, k) for m in modules for name, k in vars(m).items() if isinstance(k, Dispatcher)}
called = {name for _, k in named for name in k.py_func.__code__.co_names}
print(len(named), *sorted(name for name, k in named if name not in called and not k.signatures))
print(*sorted({m.__file__ for m in modules if any(vars(m).get(name) is k for name, k in named)}), sep="\\n")
"""
# one small kernel: how two processes keep it does not depend on its size
ONE = """
import numpy
from fdhil.sim.drive.plant_physics import _coast_plant
_coast_plant(numpy.zeros(6), 0.0, numpy.array([0.5, 0.005, 0.8, 0.075, 0.05, 5.0]), 6.25e-5)
print(sum(_coast_plant.stats.cache_hits.values()))
"""


def run_python(code: str, **environment: str) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-c", code], env={**os.environ, **environment}, stdout=-1, text=True)


def test_make_setup_compiles_every_kernel() -> None:
    reported = run_python(UNCALLED).communicate()[0].splitlines()
    count, *left = reported[0].split()
    assert int(count) > 30
    assert left == []
    made = re.compile(r"njit|^@compile_(inline_)?kernel$", re.MULTILINE)
    files = set(ROOT.rglob("*.py")) - {ROOT / "model" / "numba_decorators.py"}
    with_kernels = {str(path) for path in files if made.search(path.read_text())}
    assert str(ROOT / "identification" / "kalman.py") in with_kernels
    assert with_kernels <= set(reported[1:])


def test_parallel_compilation_leaves_usable_cache(tmp_path: Path) -> None:
    both = [run_python(ONE, NUMBA_CACHE_DIR=str(tmp_path)) for _ in range(2)]
    assert [process.communicate()[0].strip() in "01" and process.returncode for process in both] == [0, 0]
    assert run_python(ONE, NUMBA_CACHE_DIR=str(tmp_path)).communicate()[0].strip() == "1"


def test_missing_cache_folder_is_reported_with_remedy(tmp_path: Path) -> None:
    shutil.copytree(ROOT, tmp_path / "fdhil", ignore=shutil.ignore_patterns("__pycache__"))
    for folder in {path.parent for path in (tmp_path / "fdhil").rglob("*.py")}:
        (folder / "__pycache__").touch()  # no user can create a folder there
    command = [sys.executable, "-m", "fdhil", "sim", str(tmp_path / "fdhil" / "cli" / "demo" / "machine.toml")]
    nowhere = {"HOME": "/dev/null", "XDG_CACHE_HOME": "/dev/null/cache", "PYTHONPATH": str(tmp_path)}
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    done = subprocess.run(command, env={**environment, **nowhere}, capture_output=True, text=True, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (3, "")
    assert done.stderr.count("\n") == 1
    assert "set NUMBA_CACHE_DIR to a folder" in done.stderr
