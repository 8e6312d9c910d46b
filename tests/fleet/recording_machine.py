"""A machine that records into its store as the daemon does, with records for the fleet server."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fdhil import config as machine_config
from fdhil.cli.demo.toml_writer import format_toml
from fdhil.config import MachineConfig
from fdhil.daemon.outcome_store import OutcomeStore
from fdhil.records import Notice, Outcome, Parameters, Skill
from tests.bench import bench_document
from tests.store.sample_records import BENCH, make_outcome, make_published, make_window

AXES = ("X", "Y")


def write_history(folder: Path, name: str = "mill-1", **uplink: Any) -> Path:
    """Write a machine's configuration with [uplink] and return its file."""
    folder.mkdir(parents=True, exist_ok=True)
    document: dict[str, Any] = bench_document()
    document["machine"]["name"] = name
    document["uplink"] = {"labels": {"type": "V-800"}} | uplink
    file = folder / "machine.toml"
    file.write_text(format_toml(document))
    return file


class RecordingMachine:
    """Stores its records at once, through the daemon's own store."""

    def __init__(self, file: Path, keep_unsent: int | None = None, *, quiet: bool = False) -> None:
        self.config: MachineConfig = machine_config.load_config(file)
        if quiet:  # as before [uplink] was set
            self.config = self.config.model_copy(update={"uplink": None})
        if keep_unsent is not None and self.config.uplink is not None:  # fewer than a configuration may say
            few = self.config.uplink.model_copy(update={"keep_unsent": keep_unsent})
            self.config = self.config.model_copy(update={"uplink": few})
        self.store = OutcomeStore(self.config)
        assert self.store.open() == []
        self._tick = 0

    def record_windows(
        self, count: int, axes: tuple[str, ...] = AXES, parameters: Mapping[str, float] | None = None
    ) -> int:
        """Record ``count`` rounds of each axis: a window, a set, a skill, one notice per round; return the number."""
        changed = Parameters.from_mapping(BENCH.as_dict() | dict(parameters or {}))
        outcomes: list[Outcome] = []
        for _ in range(count):
            self._tick += 1000
            for axis in axes:
                whole = make_window(axis=axis, start_tick=self._tick, seed=self._tick)
                outcomes.append(make_outcome(accepted=self._tick % 3000 != 0, of=whole))
                outcomes.append(make_published(self._tick // 1000, axis, changed))
                outcomes.append(Skill(axis, self._tick, 1.5, 4.0, 2.0, 1.6))
            outcomes.append(Notice("Drift", "minor", "Friction rises; look at the lubrication.", axes[0], self._tick))
        assert self.store.store_outcomes(outcomes) == []
        return len(outcomes)

    def close_store(self) -> None:
        self.store.close()
