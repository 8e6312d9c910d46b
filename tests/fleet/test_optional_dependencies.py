"""Daemon and guard run without the packages of the fleet extra."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytestmark = pytest.mark.usefixtures("processes")


@pytest.mark.parametrize(
    "module", ["fdhil.daemon.daemon_service", "fdhil.guard.guard_process", "fdhil.cli.main", "fdhil.cli.fleet_commands"]
)
def test_daemon_and_guard_run_without_fleet_extra(module: str) -> None:
    code = f"import sys, {module}; print([name for name in ('nats', 'psycopg', 'distributed') if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_uplink_does_not_import_heavy_libraries() -> None:
    """The uplink runs next to an NC: it loads no numeric library."""
    code = (
        "import sys, fdhil.fleet.record_uplink; "
        "print([n for n in ('numba', 'scipy', 'pyarrow', 'can') if n in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
