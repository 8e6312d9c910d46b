"""Defines a worker's task in a re-analysis: read stored windows and analyse each; bit-identical wherever it runs."""

import hashlib
import json
import math
import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import fdhil
from fdhil.config import Identification, MachineConfig
from fdhil.errors import FdhilError, RecordingError
from fdhil.fleet.window_files import build_window_path
from fdhil.pipeline import analyse_windows
from fdhil.records import WindowOutcome
from fdhil.store import MAX_FILE_BYTES, decode_window, format_parameters

ROOMS = ("records", "model", "identification", "validation", "pipeline")  # the code that the results depend on
LIBRARIES = ("numpy", "scipy", "numba", "pyarrow")


class WindowReference(NamedTuple):
    machine: str
    name: str


class ReanalysedWindow(NamedTuple):
    """The new result of a window: JSON in canonical order, and its SHA-256."""

    window: WindowReference
    text: str
    digest: str


@dataclass(frozen=True, slots=True)
class AnalysisMethod:
    """How windows are analysed.

    The settings, the known configurations (by the machine's fleet name), the folder of windows, and the digest of the
    code that requests the analysis.
    """

    settings: Identification
    machines: Mapping[str, MachineConfig]
    folder: Path
    code: str

    def build_document(self) -> dict[str, Any]:
        """Return everything that the results depend on, as JSON data."""
        machines = {
            name: {
                "sync_period_s": config.machine.sync_period_s,
                "settings": config.identification.model_dump(mode="json"),
            }
            | {"axes": {axis: section.model_dump(mode="json") for axis, section in config.axis.items()}}
            for name, config in self.machines.items()
        }
        return {"settings": self.settings.model_dump(mode="json"), "machines": machines, "code": self.code}

    @property
    def digest(self) -> str:
        """The SHA-256 of :meth:`document`."""
        return hashlib.sha256(json.dumps(self.build_document(), sort_keys=True).encode()).hexdigest()


@cache
def compute_code_digest() -> str:
    """Return the SHA-256 of the analysing code and of the versions of its libraries."""
    digest = hashlib.sha256(repr([platform.python_version(), *map(version, LIBRARIES)]).encode())
    for path in _list_sources(Path(fdhil.__file__).parent):
        digest.update(path.name.encode() + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def _list_sources(folder: Path) -> Iterator[Path]:
    for room in ROOMS:
        yield from sorted((folder / room).rglob("*.py"))
    yield folder / "store" / "window_file.py"


def reanalyse_batch(windows: Sequence[WindowReference], method: AnalysisMethod) -> list[ReanalysedWindow]:
    """Analyse each window again; the result of an unreadable window is its error.

    FdhilError where this worker cannot do the same work as the others: it has other code, or no folder of windows.
    """
    if method.code != compute_code_digest():
        text = "has another fdhil, or other library versions, than the command; install the same versions everywhere"
        raise FdhilError(f"the worker on {platform.node()} {text}")
    if not method.folder.is_dir():
        text = f"cannot read {method.folder}; the folder of windows must be mounted at the same path everywhere"
        raise FdhilError(f"the worker on {platform.node()} {text}")
    return [encode_result(window, _analyse_window(window, method)) for window in windows]


def encode_result(window: WindowReference, result: Mapping[str, Any]) -> ReanalysedWindow:
    text = json.dumps(result, sort_keys=True, allow_nan=False)
    return ReanalysedWindow(window, text, hashlib.sha256(text.encode()).hexdigest())


def create_lost_result(window: WindowReference) -> ReanalysedWindow:
    """Return the result of a window whose worker died each time."""
    return encode_result(
        window, {"error": {"class": "WorkerDied", "text": f"each process that analysed {window.name} died"}}
    )


def _analyse_window(window: WindowReference, method: AnalysisMethod) -> dict[str, Any]:
    config = method.machines.get(window.machine)
    settings = method.settings
    if config is not None:
        settings = config.identification.model_copy(update={"method": settings.method} if settings.method else {})
    try:
        recorded = decode_window(_read_window_file(window.name, method.folder), window.name)
        axis = None if config is None else config.axis.get(recorded.axis)
        period_s = None if config is None else config.machine.sync_period_s
        ((outcome,), _) = analyse_windows([recorded], settings, axis, period_s)
    except (FdhilError, MemoryError) as error:
        return {"error": {"class": type(error).__name__, "text": str(error) or "out of memory"}}
    return _describe_outcome(outcome) | {"configured": axis is not None}


def _read_window_file(name: str, folder: Path) -> bytes:
    path = build_window_path(folder, name)
    try:
        with path.open("rb") as file:
            content = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}; check [objects] directory") from None
    if hashlib.sha256(content).hexdigest() != name:
        raise RecordingError(f"{path} is damaged (wrong SHA-256); restore it from a backup")
    return content


def _describe_outcome(outcome: WindowOutcome) -> dict[str, Any]:
    estimate, verdict = outcome.estimate, outcome.verdict
    return {
        "accepted": verdict.accepted,
        "fit_percent": _replace_non_finite(verdict.fit_percent),
        "unexplained_um": _replace_non_finite(verdict.unexplained_um),
        "reasons": [str(reason) for reason in verdict.reasons],
        "warnings": [str(reason) for reason in verdict.warnings],
        "method": estimate and estimate.method,
        "result": estimate and estimate.result.value,
        "parameters": format_parameters(outcome) if estimate else None,
    }


def _replace_non_finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
