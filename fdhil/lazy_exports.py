"""The names of a room: its stub ``__init__.pyi`` lists them, and each is imported when it is used (PEP 562).

So a room has one way in, and nothing heavy is imported for the sake of one name. A name is looked up each time: what
replaces it in its module for a while, a test's stand-in, is neither missed nor kept.
"""

import re
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

EXPORT = re.compile(r"^from \.([\w.]+) import (\w+) as \w+$", re.MULTILINE)


def export_names(package: str, file: str) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package, from the stub next to its ``__init__.py``."""
    modules = {name: module for module, name in EXPORT.findall(Path(file).with_suffix(".pyi").read_text("utf-8"))}

    def import_name(name: str) -> object:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(f"{package}.{modules[name]}"), name)

    return import_name, lambda: sorted(modules), sorted(modules)
