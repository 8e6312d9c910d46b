"""Exports the records anonymously: for a machine builder, a supplier, a university.

A machine's name becomes a keyed digest (HMAC-SHA256); without the key, which stays at the fleet server, names cannot be
tested. Times become ages in whole months since the first record or the newest service. Free text, configuration digests
and record numbers are left out; only the requested labels are exported. Measured figures remain: anyone who has the
same figures from elsewhere can match them.
"""

import hashlib
import hmac
import os
import secrets
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, LiteralString

from fdhil.errors import StoreError
from fdhil.fleet.parameter_sets import Db
from fdhil.store import make_folder, make_store_error, pa, pq

KEY_BYTES = 32
NAME_CHARS = 16  # of the digest, 64 bits
ROWS = 10_000  # at a time
AGE = "floor(extract(epoch FROM {at} - coalesce(a.serviced_at, a.first_at)) / 2592000)::int AS age_months"
_FIGURES = ("R", "L", "K", "Jt", "ft", "Cd")
# columns with types and query per table; the row order reveals neither time nor machine
_AT = "fleet.time_of(t.recorded_at, t.stored_at)"
_AXES = "LEFT JOIN fleet.axes a USING (machine, axis) ORDER BY md5(%(salt)s || machine), axis, age_months, md5(t::text)"
TABLES: dict[str, tuple[dict[str, pa.DataType], str]] = {
    "parameter_sets": (
        {"age_months": pa.int32(), **dict.fromkeys(_FIGURES, pa.float64()),
         **{f"{name}_std": pa.float64() for name in _FIGURES}, "windows": pa.int64(), "temperature_c": pa.float64()},
        f"""SELECT t.*, {AGE.format(at="t.at")}, {", ".join(
            f'sqrt(greatest(0, CASE WHEN jsonb_typeof(t.covariance->{k}->{k}) = $$number$$ THEN '
            f'(t.covariance->{k}->>{k})::float8 END)) AS "{name}_std"' for k, name in enumerate(_FIGURES))}
        FROM fleet.parameter_sets t {_AXES}""",
    ),
    "windows": (
        {"age_months": pa.int32(), "accepted": pa.bool_(), "fit_percent": pa.float64(), "direction": pa.int32(),
         "temperature_c": pa.float64(), "unexplained_um": pa.float64(), "reasons": pa.list_(pa.string())},
        f"""SELECT t.machine, t.axis, accepted, fit_percent, direction, temperature_c, unexplained_um,
          ARRAY(SELECT substring(reason FROM '^[A-Za-z]+') FROM jsonb_array_elements_text(
            CASE WHEN jsonb_typeof(reasons) = 'array' THEN reasons ELSE '[]' END) reason) AS reasons,
          {AGE.format(at=_AT)} FROM fleet.windows t {_AXES}""",
    ),
    "skills": (
        {"age_months": pa.int32(), "rms_um": pa.float64(), "max_um": pa.float64(), "delay_ms": pa.float64(),
         "measured_rms_um": pa.float64()},
        f"""SELECT t.machine, t.axis, rms_um, max_um, delay_ms, measured_rms_um, {AGE.format(at=_AT)}
        FROM fleet.skills t {_AXES}""",
    ),
    "notices": (
        {"age_months": pa.int32(), "code": pa.string(), "severity": pa.string()},
        f"""SELECT t.machine, t.axis, substring(code FROM '^[A-Za-z]+') AS code,
          substring(severity FROM '^[A-Za-z]+') AS severity, {AGE.format(at=_AT)} FROM fleet.notices t {_AXES}""",
    ),
}  # fmt: skip
_LABELS: LiteralString = """
SELECT machine, axis, label, text FROM fleet.labels WHERE label = ANY(%(labels)s)
ORDER BY md5(%(salt)s || machine), axis, label
"""


def load_or_create_key(path: Path) -> bytes:
    """Return the key; create it on first use, readable by its owner alone. StoreError."""
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        with os.fdopen(descriptor, "wb") as made:
            made.write(secrets.token_bytes(KEY_BYTES).hex().encode())
            made.flush()
            os.fsync(made.fileno())
    except FileExistsError:
        pass
    except OSError as error:
        raise make_store_error(path, error) from None
    try:
        key = bytes.fromhex(path.read_text("ascii").strip())
        open_to_all = path.stat().st_mode & 0o077
    except (OSError, ValueError):
        key, open_to_all = b"", 0
    if len(key) != KEY_BYTES or open_to_all:
        what = "can be read by others" if open_to_all else "is not a valid key"
        text = f"{path} {what}; nothing was exported. chmod 600 it, or name another file (new key, new pseudonyms)"
        raise StoreError(text, "BadKey")
    return key


def export_tables(
    db: Db, folder: Path, key: bytes, labels: Sequence[str], report: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Write a Parquet file per table into a new folder and return the number of rows of each. StoreError."""
    if folder.exists():
        raise StoreError(f"{folder} already exists; nothing was exported. Name a new folder", "Exists")
    partial = folder.with_name(f".{folder.name}.part")
    counts = {}
    given = {"salt": compute_pseudonym(key, "the order of machines"), "labels": list(labels)}
    try:
        make_folder(partial)
        for name, (columns, query) in TABLES.items():
            counts[name] = _write_parquet(db, partial / f"{name}.parquet", columns, query, given, key)
            report(f"{name}: {counts[name]} rows")
        columns = {"label": pa.string(), "text": pa.string()}
        counts["labels"] = _write_parquet(db, partial / "labels.parquet", columns, _LABELS, given, key)
        partial.rename(folder)
    except OSError as error:
        raise make_store_error(folder, error) from None
    return {"folder": str(folder), "rows": counts, "labels": list(labels)}


def _write_parquet(
    db: Db, path: Path, columns: dict[str, pa.DataType], query: str, given: Mapping[str, object], key: bytes
) -> int:
    schema = pa.schema({"machine": pa.string(), "axis": pa.string(), **columns})
    count = 0
    with db.transaction(), db.cursor(name="export") as rows, pq.ParquetWriter(path, schema) as file:
        rows.execute(query.encode(), given)
        while batch := rows.fetchmany(ROWS):
            records = [{name: row[name] for name in schema.names} | {"machine": compute_pseudonym(key, row["machine"])}
                    for row in batch]  # fmt: skip
            file.write_table(pa.Table.from_pylist(records, schema))
            count += len(records)
    return count


def compute_pseudonym(key: bytes, machine: str) -> str:
    return hmac.new(key, machine.encode(), hashlib.sha256).hexdigest()[:NAME_CHARS]
