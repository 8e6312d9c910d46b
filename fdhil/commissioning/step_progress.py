"""Store the results of commissioning steps, so that an interrupted commissioning continues where it stopped.

A step is valid for the drive and configuration it was done with, identified by a fingerprint. The file is stored next
to the record and sealed with the same key, since the sign-off may rely on it.
"""

import hashlib
import hmac
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fdhil.commissioning.commissioning_record import KEY_NAME, load_sealing_key
from fdhil.errors import StoreError
from fdhil.store import make_folder, write_file

SCHEMA = "fdhil-commissioning-steps-1"
MAX_BYTES = 256 * 1024

Found = Mapping[str, Any]
"""Results of a step: names and JSON values; a step with an undetermined result (None) is not stored."""


@dataclass(frozen=True, slots=True)
class CompletedStep:
    """A completed step: the drive and configuration it is valid for, its time, and its results."""

    holds_for: str
    done_utc: str
    found: Found


def build_steps_path(directory: Path, axis: str) -> Path:
    """Return the file of an axis' completed steps."""
    return directory / f"commissioning-{axis}.steps.json"


class StepProgress:
    """The completed steps of one axis; each is written as soon as it is done.

    ``doubt`` says why an existing file was rejected. ``on_reused`` is called for each reused step. StoreError if the
    file or the key exists but cannot be read.
    """

    def __init__(self, directory: Path, axis: str, key: Path | None = None) -> None:
        self._path, self._axis = build_steps_path(directory, axis), axis
        self._key = key or directory / KEY_NAME
        self.rejection = ""
        self.on_reused: Callable[[str, CompletedStep], None] = lambda _name, _step: None
        self._steps = self._read_steps()

    def reuse_step(self, name: str, holds_for: str) -> Found | None:
        """Return the results of a step if it was done with this drive and configuration, and report it; else None."""
        found = self.find_result(name, holds_for)
        if found is not None:
            self.on_reused(name, self._steps[name])
        return found

    def find_result(self, name: str, holds_for: str) -> Found | None:
        """Return what is stored under a name for this drive and configuration; else None."""
        step = self._steps.get(name)
        return None if step is None or step.holds_for != holds_for else step.found

    def list_step_times(self) -> dict[str, str]:
        """Return when each step was done, with any drive and configuration."""
        return {name: step.done_utc for name, step in self._steps.items()}

    def save_step(self, name: str, holds_for: str, found: Found) -> None:
        """Store a completed step, unless a result is undetermined; StoreError."""
        if None in found.values():
            return
        steps = {**self._steps, name: CompletedStep(holds_for, datetime.now(UTC).isoformat(timespec="seconds"), found)}
        document = {"schema": SCHEMA, "axis": self._axis, "steps": {k: asdict(v) for k, v in steps.items()}}
        try:
            make_folder(self._path.parent)
        except OSError as error:
            text = f"{self._path.parent} cannot be written ({error.strerror}); check the rights of [store] directory"
            raise StoreError(text) from None
        seal = _compute_seal(document, load_sealing_key(self._key))
        content = json.dumps({**document, "seal": seal}, indent=2).encode()
        if len(content) > MAX_BYTES:  # a larger file would not be read
            raise StoreError(f"{self._path} has no room for another step; start over with fdhil commission --again")
        write_file(self._path, content)
        self._steps = steps

    def forget_steps(self) -> None:
        """Delete all completed steps; StoreError."""
        self._steps = {}
        try:
            self._path.unlink(missing_ok=True)
        except OSError as error:
            raise StoreError(f"{self._path} cannot be removed ({error.strerror}); check the store's rights") from None

    def _read_steps(self) -> dict[str, CompletedStep]:
        try:
            with self._path.open("rb") as file:
                document = json.loads(file.read(MAX_BYTES))
            seal = str(document.pop("seal")).encode("utf-8", "replace")
            steps = {str(name): CompletedStep(**step) for name, step in document["steps"].items()}
            matches = (document["schema"], document["axis"]) == (SCHEMA, self._axis)
        except (FileNotFoundError, NotADirectoryError):
            return {}
        except OSError as error:  # completed steps may be in it: it is not overwritten
            text = f"{self._path} cannot be read ({error.strerror}); check the disk, or move it away and start over"
            raise StoreError(text) from None
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            return self._reject_file("damaged")
        sealed = self._key.exists() and _compute_seal(document, load_sealing_key(self._key))  # reading creates no key
        if not (matches and sealed and hmac.compare_digest(seal, sealed.encode())):
            return self._reject_file("modified, or of another machine")
        return steps

    def _reject_file(self, why: str) -> dict[str, CompletedStep]:
        self.rejection = f"{self._path.name} was rejected ({why}); every step is repeated"
        return {}


def _compute_seal(document: Mapping[str, Any], key: bytes) -> str:
    text = json.dumps(document, sort_keys=True).encode()
    return hmac.new(key, text, hashlib.sha256).hexdigest()
