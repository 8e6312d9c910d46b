"""The examples in the docstrings of the Python interface are run."""

from __future__ import annotations

import doctest
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MODULES = ("recording_interface", "identification_result", "machine_interface", "drive_model")


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples_give_the_shown_output(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    options = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    done = doctest.testmod(import_module(f"fdhil.api.{name}"), optionflags=options)
    assert done.attempted > 1
    assert done.failed == 0
