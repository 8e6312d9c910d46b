"""Fuzz one target with atheris: ``python -m tests.fuzz NAME --inputs N``; the figures are printed as JSON.

Only fdhil is instrumented, except the modules that numba compiles. One input per kind of failure is stored, and the
search continues.
"""

from __future__ import annotations

import argparse
import gc
import hashlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tests.fuzz import TARGETS

ROOT = Path(__file__).resolve().parent.parent.parent
COMPILED = ("njit", "@compiled", "@inlined")
# an input that ends the reading process is stored once; more of them would cost a start each
UNSEEN = ["fdhil.store.reading_process"]


def list_kernel_modules() -> list[str]:
    """Return the modules with compiled functions, which cannot be instrumented."""
    files = (ROOT / "fdhil").rglob("*.py")
    found = [path for path in files if any(word in path.read_text("utf-8") for word in COMPILED)]
    return [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in found]


def main() -> None:
    """Parse the options and fuzz; exit with 1 if any input failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz")
    parser.add_argument("name", choices=TARGETS)
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--seconds", type=float, default=1e9, help="end sooner after this long")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--corpus", type=Path, help="where what is interesting is kept from run to run")
    parser.add_argument("--found", type=Path, default=ROOT / "out" / "fuzz" / "found")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        _fuzz(options, options.corpus or Path(folder) / "corpus", Path(folder))


def _fuzz(options: argparse.Namespace, corpus: Path, folder: Path) -> None:
    try:
        import atheris
    except ImportError:
        sys.exit("atheris is not installed; there is one for Linux and Python below 3.14: make setup with that")

    with atheris.instrument_imports(
        include=["fdhil"], exclude=[*list_kernel_modules(), *UNSEEN], enable_loader_override=False
    ):
        from tests.fuzz import input_assessment
        from tests.fuzz.targets import load_target

        target = load_target(options.name)
        for seed in target.seeds:  # imports that would otherwise happen late
            input_assessment.assess_input(target, seed)
    gc.collect()
    gc.freeze()  # imported objects are not scanned again and again
    corpus.mkdir(parents=True, exist_ok=True)
    for seed in target.seeds:
        (corpus / hashlib.sha256(seed).hexdigest()[:16]).write_bytes(seed)
    words = folder / "words"
    words.write_text("".join(f'"{_escape_input(word)}"\n' for word in target.words))
    search = _FuzzSearch(options, target, input_assessment)
    kept = options.found / options.name  # an input that ends the process itself
    kept.mkdir(parents=True, exist_ok=True)
    flags = [f"-seed={options.seed}", f"-max_len={target.longest}", f"-dict={words}", "-verbosity=0", "-timeout=600"]
    atheris.Setup(
        [sys.argv[0], *flags, "-rss_limit_mb=8192", f"-artifact_prefix={kept}/", str(corpus)], search.try_input
    )
    atheris.Fuzz()


def _escape_input(word: bytes) -> str:
    return "".join(f"\\x{byte:02x}" for byte in word)


class _FuzzSearch:
    """Counts inputs, stores failing ones, and ends the process after enough inputs."""

    def __init__(self, options: argparse.Namespace, target: Any, tasting: Any) -> None:
        self._options, self._target, self._tasting = options, target, tasting
        self._count, self._slowest_s = 0, 0.0
        self._found: dict[tuple[str, str], int] = {}
        self._begin_s, self._begin_cpu_s = time.monotonic(), tasting.processor_s(target)

    def try_input(self, data: bytes) -> None:
        begin_s = self._tasting.processor_s(self._target)
        finding = self._tasting.judged(self._target, data)
        self._slowest_s = max(self._slowest_s, self._tasting.processor_s(self._target) - begin_s)
        self._count += 1
        if finding is not None:
            self._store_finding(finding, data)
        if self._count >= self._options.inputs or time.monotonic() - self._begin_s > self._options.seconds:
            self._end_process()

    def _store_finding(self, finding: Any, data: bytes) -> None:
        place = (finding.kind, finding.place)
        self._found[place] = self._found.get(place, 0) + 1
        if self._found[place] == 1:
            folder = self._options.found / self._target.name
            folder.mkdir(parents=True, exist_ok=True)
            name = f"{finding.kind}-{hashlib.sha256(data).hexdigest()[:8]}"
            (folder / name).write_bytes(data)
            print(
                f"{self._target.name}: {finding.kind} at {finding.place}, kept as {name}\n{finding.text}",
                file=sys.stderr,
            )

    def _end_process(self) -> None:
        figures = {
            "target": self._target.name,
            "inputs": self._count,
            "cpu_s": self._tasting.processor_s(self._target) - self._begin_cpu_s,
            "slowest_s": self._slowest_s,
            "peak_mib": max(self._tasting.peaks_bytes(self._target)) / (1 << 20),
            "found": _format_summary(self._found),
        }
        print(json.dumps(figures), flush=True)
        sys.stderr.flush()
        os._exit(bool(self._found))  # the fuzzer's own end would repeat the report


def _format_summary(found: dict[tuple[str, str], int]) -> Sequence[dict[str, Any]]:
    return [{"kind": kind, "place": place, "inputs": count} for (kind, place), count in found.items()]


if __name__ == "__main__":
    main()
