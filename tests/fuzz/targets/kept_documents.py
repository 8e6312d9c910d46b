"""Files that fdhil stores or receives: read, or the error that their reader declares (None if declared)."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from fdhil.arming.checked_program import CheckedProgram
from fdhil.arming.program_check import HEADER
from fdhil.commissioning.commissioning_record import build_record_path, load_record, save_record
from fdhil.config.user_file import hash_password, read_users, write_users
from fdhil.correction.learned_offsets import LearnedOffset
from fdhil.drivers.cia402.drive_profile_file import read_profile
from fdhil.drivers.nc.nc_profile_file import read_nc_profile
from fdhil.errors import FdhilError
from fdhil.guard.guard_settings import encode_settings, load_settings
from fdhil.prediction.axis_models import load_model_file
from fdhil.program.demand_csv import read_demand_csv
from fdhil.store import audit_file
from fdhil.store.column_map import read_column_map
from fdhil.store.learned_offset_files import read_learned, write_learned
from fdhil.store.window_file import read_window
from tests.bench import bench_config
from tests.fuzz.input_assessment import Target
from tests.guard.simulated_bus import settings

_FOLDER = tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None)
FOLDER = Path(_FOLDER.name)
CONFIG = bench_config("X")


def _read_profile(path: Path) -> None:
    read_profile.__wrapped__(str(path))


def _read_record(path: Path) -> None:
    load_record(path.parent, "X", may_lack_key=True)


def _read_audit(path: Path) -> None:
    for body, wrong in audit_file.read_entries(path.parent):
        json.dumps(body)
        assert wrong is None or "audit" in wrong
    audit_file.append_entry(path.parent, {"asked": "arm"})


# name of the file -> its reader
READERS: Mapping[str, Callable[[Path], object]] = {
    "lesson.npz": read_learned,
    "guard.json": load_settings,
    "model.json": load_model_file,
    build_record_path(Path(), "X").name: _read_record,
    "users.json": read_users,
    "demand.csv": lambda path: read_demand_csv(path, CONFIG),
    "columns.toml": read_column_map,
    "drive.toml": _read_profile,
    "nc.toml": lambda path: read_nc_profile(str(path), "mtconnect"),
    f"key{HEADER}": lambda path: CheckedProgram.find_checked(path.parent, "key", path.parent),
    audit_file.AUDIT_FILE_NAME: _read_audit,
    "window.parquet": read_window,
}


def taste(data: bytes) -> None:
    """Read the bytes as the file selected by the first of them."""
    name = [*READERS][data[0] % len(READERS)] if data else "model.json"
    path = FOLDER / name
    path.write_bytes(data[1:])
    path.chmod(0o600)
    with suppress(FdhilError):
        READERS[name](path)


def _write_examples() -> Mapping[str, bytes]:
    from tests.commissioning.test_record import RECORD

    write_learned(FOLDER / "lesson.npz", LearnedOffset({"X": np.arange(4.0)}, 3.0, 0.5, (3.0, 1.0)))
    write_users(FOLDER / "users.json", {"w": hash_password("canary-9b1f-password", "watch")})
    save_record(replace(RECORD, axis="X"), FOLDER)
    (FOLDER / audit_file.AUDIT_FILE_NAME).unlink(missing_ok=True)
    audit_file.append_entry(FOLDER, {"asked": "arm"})
    written = {path.name: path.read_bytes() for path in FOLDER.iterdir()}
    return written | {
        "guard.json": encode_settings(settings("X")).encode(),
        "model.json": json.dumps({"X": {"R": 0.5, "L": 0.005, "K": 0.8, "Jt": 0.075, "ft": 0.05, "Cd": 5.0}}).encode(),
        "demand.csv": b"time_s,X_mm\n0.000,0.0\n0.001,0.1\n0.002,0.2\n",
        "columns.toml": b'[headers]\naxis = "X"\nsample_rate_hz = 1000\n'
        b'[columns]\ntime_s = { column = "t", unit = "s" }\n',
        "drive.toml": b'base = "cia402"\nvendor_id = 1\nspeed_unit = "rpm"\n',
        "nc.toml": b'title = "t"\ninterface = "mtconnect"\n[signals]\nx = { at = "Execution" }\n'
        b'[[motion]]\nkind = "rest"\n'
        b'when = { x = ["READY"] }\n',
        f"key{HEADER}": b'{"schema": 1, "axes": ["X"], "code": "c", "blocks": [[1, "s"]], "rows": 1, "digest": "d"}',
    }


def target() -> Target:
    written, names = _write_examples(), [*READERS]
    seeds = [bytes([names.index(name)]) + content for name, content in written.items() if name in names]
    words = [b"NaN", b"1e999", b"null", b"true", b"[]", b"{}", b'"digest"', b'"schema"', b"PK\x01\x02", b"\x93NUMPY"]
    return Target("kept_documents", seeds, taste, words, 3500)
