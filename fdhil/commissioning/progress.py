"""Keeps what a commissioning has proven step by step, so that one that was stopped goes on where it ended.

A step holds for the drive and the configuration that it was done with, which a fingerprint tells. The file lies beside
the record and is sealed with the same key: what is signed off may rest on it.
"""

import hashlib
import hmac
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fdhil.commissioning.record import KEY_NAME, sealing_key
from fdhil.errors import StoreError
from fdhil.store.atomic import make_folder, write_file

SCHEMA = "fdhil-commissioning-steps-1"
MAX_BYTES = 256 * 1024

Found = Mapping[str, Any]
"""What a step found: names and JSON values; a step that could not tell something has None there and is not kept."""


@dataclass(frozen=True, slots=True)
class Step:
    """One step that was done: for which drive and configuration, when, and what it found."""

    holds_for: str
    done_utc: str
    found: Found


def steps_path(directory: Path, axis: str) -> Path:
    """Return where the steps of an axis are kept."""
    return directory / f"commissioning-{axis}.steps.json"


class Progress:
    """The steps of one axis that were done; each is written as soon as it is.

    ``doubt`` says why a file that is there is not believed. ``on_kept`` is told of each step that need not be done
    again. StoreError where the file is there and cannot be read, or the key.
    """

    def __init__(self, directory: Path, axis: str, key: Path | None = None) -> None:
        self._path, self._axis = steps_path(directory, axis), axis
        self._key = key or directory / KEY_NAME
        self.doubt = ""
        self.on_kept: Callable[[str, Step], None] = lambda _name, _step: None
        self._steps = self._read()

    def kept(self, name: str, holds_for: str) -> Found | None:
        """Return what a step found, where it was done with this drive and configuration, and tell so; else None."""
        found = self.found(name, holds_for)
        if found is not None:
            self.on_kept(name, self._steps[name])
        return found

    def found(self, name: str, holds_for: str) -> Found | None:
        """Return what was kept under a name for this drive and configuration; else None."""
        step = self._steps.get(name)
        return None if step is None or step.holds_for != holds_for else step.found

    def done(self) -> dict[str, str]:
        """Return when each step was done, whatever it was done with."""
        return {name: step.done_utc for name, step in self._steps.items()}

    def keep(self, name: str, holds_for: str, found: Found) -> None:
        """Keep a step that was done, unless it could not tell something; StoreError."""
        if None in found.values():
            return
        steps = {**self._steps, name: Step(holds_for, datetime.now(UTC).isoformat(timespec="seconds"), found)}
        document = {"schema": SCHEMA, "axis": self._axis, "steps": {k: asdict(v) for k, v in steps.items()}}
        try:
            make_folder(self._path.parent)
        except OSError as error:
            text = f"{self._path.parent} cannot be written ({error.strerror}); check the rights of [store] directory"
            raise StoreError(text) from None
        seal = _seal(document, sealing_key(self._key))
        content = json.dumps({**document, "seal": seal}, indent=2).encode()
        if len(content) > MAX_BYTES:  # more would not be read again
            raise StoreError(f"{self._path} has no room for another step; begin anew with fdhil commission --again")
        write_file(self._path, content)
        self._steps = steps

    def forget(self) -> None:
        """Let all steps be done anew; StoreError."""
        self._steps = {}
        try:
            self._path.unlink(missing_ok=True)
        except OSError as error:
            raise StoreError(f"{self._path} cannot be removed ({error.strerror}); check the store's rights") from None

    def _read(self) -> dict[str, Step]:
        try:
            with self._path.open("rb") as file:
                document = json.loads(file.read(MAX_BYTES))
            seal = str(document.pop("seal")).encode("utf-8", "replace")
            steps = {str(name): Step(**step) for name, step in document["steps"].items()}
            told = (document["schema"], document["axis"]) == (SCHEMA, self._axis)
        except (FileNotFoundError, NotADirectoryError):
            return {}
        except OSError as error:  # what was done may well be there: it is not written over
            text = f"{self._path} cannot be read ({error.strerror}); check the disk, or move it away and do it all anew"
            raise StoreError(text) from None
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            return self._doubted("it cannot be read")
        sealed = self._key.exists() and _seal(document, sealing_key(self._key))  # a key is not made for reading
        if not (told and sealed and hmac.compare_digest(seal, sealed.encode())):
            return self._doubted("it was changed, or is another machine's")
        return steps

    def _doubted(self, why: str) -> dict[str, Step]:
        self.doubt = f"{self._path.name} is not believed ({why}); every step is done anew"
        return {}


def _seal(document: Mapping[str, Any], key: bytes) -> str:
    text = json.dumps(document, sort_keys=True).encode()
    return hmac.new(key, text, hashlib.sha256).hexdigest()
