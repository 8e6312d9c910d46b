"""The pytest fixture for other projects, used from a separate test suite."""

from __future__ import annotations

import re
from importlib.metadata import entry_points
from pathlib import Path

import pytest

pytest_plugins = ["pytester"]

PAGE = Path(__file__).parents[1] / "docs/how-to/test-your-master.md"

OTHERS = """
def test_its_own_nc_plays_a_program(feed_drive_bench, tmp_path):
    bench = feed_drive_bench(pace="lockstep")
    bench.play("G0 X3 Y1", trace=tmp_path / "trace.csv")
    assert bench.wait_for("finished")["rows"] > 100
    assert bench.position_mm("Y") == pytest.approx(1.0, abs=0.01)
    assert (tmp_path / "trace.csv").stat().st_size > 1000


def test_what_it_cannot_do_fails_the_test(feed_drive_bench):
    bench = feed_drive_bench()
    bench.fault("trip")
"""


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("bus", ["virtual", "hub"])
def test_documented_tests_run_in_separate_suite(bus: str, pytester: pytest.Pytester) -> None:
    shown = re.findall(r"^```python\n(.*?)^```", PAGE.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    pytester.makepyfile("\n\n".join([*shown, OTHERS]))
    pytester.makeini("[pytest]\nasyncio_default_fixture_loop_scope = function\n")
    named = () if entry_points(group="pytest11", name="fdhil") else ("-p", "fdhil.pytest_plugin")  # not installed yet
    result = pytester.runpytest_subprocess("-q", *named, f"--feed-drive-bus={bus}")
    result.assert_outcomes(passed=3, failed=1)
    result.stdout.fnmatch_lines(["*the feed drive bench failed: *trip needs a value*"])


def test_plugin_configuration_is_accepted_by_commands(tmp_path: Path) -> None:
    from fdhil import config
    from fdhil.pytest_plugin import FeedDriveBench

    with FeedDriveBench(tmp_path, axes="XZ", modbus=True) as bench:
        machine = config.load_config(bench.write_config())
    assert [*machine.axis] == ["X", "Z"]
    assert machine.axis["Z"].voltage.port == bench.ready["modbus"]["Z"]["port"]


def test_package_registers_pytest_plugin() -> None:
    import tomllib

    document = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text("utf-8"))
    assert document["project"]["entry-points"]["pytest11"] == {"fdhil": "fdhil.pytest_plugin"}


def test_machine_that_never_becomes_ready_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its thread would prevent the end of the test run."""
    from fdhil.pytest_plugin import FeedDriveBench

    def raise_interrupt(_: FeedDriveBench, event: str) -> None:
        raise KeyboardInterrupt(event)

    monkeypatch.setattr(FeedDriveBench, "wait_for", raise_interrupt)
    bench = FeedDriveBench(tmp_path)
    with pytest.raises(KeyboardInterrupt, match="ready"):
        bench.__enter__()
    assert bench._thread is not None
    assert not bench._thread.is_alive()
