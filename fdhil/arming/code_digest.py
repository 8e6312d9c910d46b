"""Computes a digest of the code that makes checked rows, so that rows of other code are not reused."""

import hashlib
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import numba
import numpy as np
import scipy

import fdhil
from fdhil.lazy_exports import EXPORT

MAKER = "fdhil.arming.program_check"
LIBRARIES = (np, scipy, numba)  # that compute the rows
_IMPORT = re.compile(r"^\s*from (fdhil[\w.]*) import (\([^)]*\)|.*)$", re.MULTILINE)
_LISTED = re.compile(r'"(fdhil\.[\w.]+):\w+"')  # in a table of tables.py


def compute_code_digest() -> str:
    """Return the digest of the code that makes the rows, as it is on disk now, and of its libraries' versions."""
    home = Path(fdhil.__file__).parent
    digest = hashlib.sha256(json.dumps([sys.version, *(library.__version__ for library in LIBRARIES)]).encode())
    for name, content in sorted(find_code_files(home).items()):
        digest.update(name.encode() + b"\0" + content)
    return digest.hexdigest()


def find_code_files(home: Path) -> dict[str, bytes]:
    """Return the package files below ``home`` that the check imports, or that a table in tables.py lists."""
    found: dict[str, bytes] = {}
    waiting, seen = [MAKER], set[str]()
    while waiting:
        module = waiting.pop()
        if module in seen:
            continue
        seen.add(module)
        place = home.joinpath(*module.split(".")[1:])
        waiting += _find_export(home, module)
        for file in (place.with_suffix(".py"), place / "__init__.py"):
            if file.is_file():
                content = found[str(file.relative_to(home))] = file.read_bytes()
                if module != "fdhil":  # which only offers the Python interface
                    waiting += _find_imports(content.decode())
        waiting.append(module.rpartition(".")[0] or "fdhil")  # a package is imported with its modules
    return found


def _find_export(home: Path, module: str) -> list[str]:
    """Return the module from which a package exports a name: what looks like a module of it may be one."""
    package, _, name = module.rpartition(".")
    stub = home.joinpath(*package.split(".")[1:], "__init__.pyi")
    exports = EXPORT.findall(stub.read_text("utf-8")) if stub.is_file() else []
    return [f"{package}.{file}" for file, exported in exports if exported == name]


def _find_imports(text: str) -> Iterator[str]:
    yield from _LISTED.findall(text)
    for module, names in _IMPORT.findall(text):
        yield module
        yield from (f"{module}.{name}" for name in re.findall(r"\w+", names))
