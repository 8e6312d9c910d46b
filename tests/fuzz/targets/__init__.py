"""The entry points, one module each with ``target()``."""

from __future__ import annotations

from functools import cache
from importlib import import_module

from tests.fuzz.input_assessment import Target


@cache
def load_target(name: str) -> Target:
    """Return a target by its name; nothing else of fdhil is imported before."""
    made = import_module(f"tests.fuzz.targets.{name}").target()
    assert isinstance(made, Target)
    return made
