"""The anonymous export does not identify machines."""

from __future__ import annotations

from pathlib import Path

import pyarrow.parquet as pq
import pytest

from fdhil.errors import StoreError
from fdhil.fleet.anonymous_export import compute_pseudonym, load_or_create_key
from tests.daemon.machine_rig import fdhil
from tests.fleet.fleet_database import build_fleet, collect_messages, list_messages
from tests.fleet.recording_machine import RecordingMachine, write_history
from tests.fleet.servers import Postgres

NAMES = [f"SECRET-mill-{k}" for k in range(5)]
PRIVATE = ["SECRET", "lubrication", "anna", "Halle 7"]


def test_key_is_created_once_and_private(tmp_path: Path) -> None:
    key = load_or_create_key(tmp_path / "key")
    assert len(key) == 32
    assert load_or_create_key(tmp_path / "key") == key
    assert (tmp_path / "key").stat().st_mode & 0o777 == 0o600
    assert compute_pseudonym(key, "mill-1") != compute_pseudonym(bytes(32), "mill-1")
    (tmp_path / "key").chmod(0o644)
    with pytest.raises(StoreError, match="read by others"):
        load_or_create_key(tmp_path / "key")
    (tmp_path / "short").touch(0o600)
    with pytest.raises(StoreError, match="not a valid key"):
        load_or_create_key(tmp_path / "short")


@pytest.mark.debian
async def test_export_contains_no_names_texts_or_times(
    database: Postgres, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    works = build_fleet(database, tmp_path)
    messages = []
    for name in NAMES:
        labels = {"type": "V-800", "works": "Halle 7"}
        machine = RecordingMachine(
            write_history(tmp_path / name, name, labels=labels, axis_labels={"X": {"screw": "A"}})
        )
        machine.record_windows(3)
        machine.store.store_acknowledgement({"up_to": 1, "by": "anna"})
        machine.close_store()
        messages += list_messages(machine)
    await collect_messages(works, messages)
    file, folder = tmp_path / "fleet.toml", tmp_path / "given away"
    file.write_text(f'[database]\nconnection = "{database.connection}"\n')
    words = ("fleet", "export", file, "--anonymous", folder, "--label", "type", "--label", "screw")
    code, out, err = fdhil(*map(str, words), capsys=capsys)
    assert (code, err) == (0, "")
    assert "30 parameter sets, 30 windows" in out

    tables = {path.stem: pq.read_table(path) for path in folder.iterdir()}
    assert set(tables) == {"parameter_sets", "windows", "skills", "notices", "labels"}
    written_bytes = b"".join(path.read_bytes() for path in folder.iterdir())
    text = str({name: table.to_pylist() for name, table in tables.items()})
    assert [word for word in PRIVATE if word in text or word.encode() in written_bytes] == []
    times = [f for table in tables.values() for f in table.schema if "time" in str(f.type) or f.name.endswith("_at")]
    assert times == []
    key = load_or_create_key(tmp_path / "anonymous.key")
    sets = tables["parameter_sets"]
    names = sets["machine"].to_pylist()
    assert set(names) == {compute_pseudonym(key, name) for name in NAMES}
    assert set(sets["age_months"].to_pylist()) == {0}
    assert min(sets["ft_std"].to_pylist()) > 0
    assert {row["text"] for row in tables["labels"].to_pylist()} == {"V-800", "A"}
    assert "Halle" not in text
    assert {code for row in tables["windows"].to_pylist() for code in row["reasons"] if not code.isalpha()} == set()

    code, out, err = fdhil(*map(str, words), capsys=capsys)
    assert (code, "already exists" in err) == (3, True)
