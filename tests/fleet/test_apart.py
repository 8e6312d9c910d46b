"""Daemon and guard run without the packages of the fleet extra."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytestmark = pytest.mark.usefixtures("processes")


@pytest.mark.parametrize(
    "module", ["fdhil.daemon.daemon_service", "fdhil.guard.guard_process", "fdhil.cli.main", "fdhil.cli.fleet"]
)
def test_it_runs_without_the_extra(module: str) -> None:
    code = f"import sys, {module}; print([name for name in ('nats', 'psycopg', 'distributed') if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_uplink_is_light() -> None:
    """The uplink runs next to an NC: it loads no numeric library."""
    code = (
        "import sys, fdhil.fleet.uplink; print([n for n in ('numba', 'scipy', 'pyarrow', 'can') if n in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
