"""Files are read in a child process, which damage may crash, block or fill."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import pytest

from fdhil.errors import FdhilError, RecordingError
from fdhil.store import reading_process
from fdhil.store.reading_process import read_in_process
from fdhil.store.recording_file import read_recording, read_table
from fdhil.store.window_export import convert_window, export_table
from tests.fuzz.input_assessment import FOUND
from tests.store import failing_reader
from tests.store.sample_records import make_window

pytestmark = pytest.mark.usefixtures("processes")


@pytest.fixture(autouse=True)
def _fresh_process() -> Iterator[None]:
    reading_process._end_process()
    yield
    reading_process._end_process()


def _read_file(content: bytes, source: str) -> str:
    table = read_in_process(failing_reader.__name__, "such file", content, source)
    assert table.columns["time_s"].tolist() == [0.0, 1.0, 2.0]
    return table.headers["of"]


@pytest.mark.fault("G8")
@pytest.mark.parametrize("name", ["mat", "h5"])
def test_file_that_crashes_reader_is_refused_and_next_is_read(name: str, tmp_path: Path) -> None:
    bad, good = tmp_path / "bad.mat", tmp_path / f"good.{name}"
    bad.write_bytes((FOUND / "recording_mat" / "vector-of-unknown-type").read_bytes())
    export_table(convert_window(make_window()), good, {"h5": "hdf5"}.get(name, name))
    with pytest.raises(RecordingError, match=r"bad\.mat is not a readable MATLAB file.*crashed; export it again"):
        read_recording(bad)
    assert read_recording(good).axis == "X"


@pytest.mark.fault("G8")
@pytest.mark.parametrize(
    ("does", "told"),
    [
        ("crash", "crashed"),
        ("abort", "crashed"),
        ("fill", "crashed"),
        ("talk", "crashed"),
        ("sleep", "within 0.3 s"),
        ("hang", "within 0.8 s of processor time"),
    ],
)
def test_runaway_reader_is_killed(does: str, told: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        if does == "sleep":
            patch.setattr(reading_process, "LONGEST_S", 0.3)
        with pytest.raises(RecordingError, match=f"^r is not a readable such file.*{told}.*; export it again$"):
            _read_file(does.encode(), "r")
    assert _read_file(b"", "the next") == "the next"


def test_damage_by_one_file_does_not_affect_the_next() -> None:
    assert _read_file(b"break", "one") == "one"
    assert _read_file(b"", "the next") == "the next"


def test_interrupted_reading_leaves_no_stale_answer() -> None:
    with pytest.raises(KeyboardInterrupt):
        _read_file(b"interrupt", "r")
    assert _read_file(b"", "the next") == "the next"


def test_killed_idle_reader_is_restarted() -> None:
    assert _read_file(b"", "first") == "first"
    (process,) = reading_process._PROCESSES.values()
    process.child.kill()
    process.child.wait()
    assert _read_file(b"", "second") == "second"


def test_script_is_not_rerun_and_fork_has_own_reader(tmp_path: Path) -> None:
    for n in (120, 150):
        export_table(convert_window(make_window(n=n, raw=False)), tmp_path / f"{n}.mat", "mat")
    script = tmp_path / "script.py"
    script.write_text(
        textwrap.dedent(
            """\
            import os
            from pathlib import Path
            from fdhil.store.recording_file import read_table

            print("begun", flush=True)
            assert read_table(Path("120.mat")).columns["time_s"].size == 117
            forked = os.fork()
            n = 120 if forked else 150
            for _ in range(20):
                assert read_table(Path(f"{n}.mat")).columns["time_s"].size == n - 3
            print("done", flush=True)
            if forked:
                assert os.waitpid(forked, 0)[1] == 0
            """
        )
    )
    done = subprocess.run([sys.executable, script], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.split() == ["begun", "done", "done"]


def test_module_next_to_the_file_is_not_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export_table(convert_window(make_window()), tmp_path / "r.mat", "mat")
    (tmp_path / "numpy.py").write_text("raise SystemExit(1)")
    monkeypatch.chdir(tmp_path)
    assert read_recording(Path("r.mat")).axis == "X"


def test_missing_extra_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "asammdf.py").write_text("raise ImportError")
    export_table(convert_window(make_window()), tmp_path / "r.mf4", "mdf4")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(FdhilError, match="pip install 'fdhil"):
        read_table(tmp_path / "r.mf4")


@pytest.mark.parametrize("program", ["/nowhere", "/bin/true"])
def test_reader_that_cannot_start_is_not_blamed_on_the_file(program: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", program)
    with pytest.raises(RecordingError, match=r"^r was not read: .*cannot be started.*; free memory"):
        _read_file(b"", "r")
