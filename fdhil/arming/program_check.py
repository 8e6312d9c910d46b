"""Checks a whole program: planner, correction and gate, block by block, ahead of the motion.

Runs as a child process (``python -m fdhil.arming.program_check``, one JSON request on stdin): an hour's program may
take minutes, at low priority, without delaying the daemon, and the check can be ended at any moment. Each block that
passed is on disk in the guard's format before its digest is reported. The result is a file of all rows and a header
with their digests.
"""

import contextlib
import hashlib
import json
import math
import os
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from fdhil.arming.code_digest import compute_code_digest
from fdhil.bounded_process import limit_process, receive_request, report_to_parent
from fdhil.config import MachineConfig
from fdhil.correction import StreamBlock, check_gain, stream_blocks
from fdhil.errors import FdhilError, ProgramError, StoreError
from fdhil.program import (
    compute_program_digest,
    is_demand,
    open_program,
    read_demand_csv,
    require_digest,
    stream_trajectory,
)
from fdhil.records import Float, Parameters, Reason, Trajectory
from fdhil.store import keep_newest, make_folder, make_store_error, sync_folder, write_file

SCHEMA = "fdhil-check-4"
ROWS = ".rows"
HEADER = ".json"
KEPT = 4  # checked programs; an hour of two axes takes 58 MB
PIECE_ROWS = 2000
MOST_REFUSED = 20  # listed refusals
REPORT_S = 0.5
NICENESS = 10
INT32_END = 2**31

Report = Callable[[Mapping[str, Any]], None]


Opened = Callable[[], list[tuple[Path, str]]]  # which files were opened so far, with their digests


def plan_reference_blocks(program: Path, config: MachineConfig, sha256: str | None = None) -> Iterator[Trajectory]:
    """Return the NC's demand in blocks. Raises ProgramError, RecordingError or ConfigError if it cannot be used.

    ``sha256`` is the program's digest: blocks of another content are a ProgramError.
    """
    return _open_reference(program, config, sha256)[0]


def _open_reference(program: Path, config: MachineConfig, sha256: str | None) -> tuple[Iterator[Trajectory], Opened]:
    if is_demand(program):
        return iter([read_demand_csv(program, config, sha256)]), list
    interpreter = open_program(program, config, sha256)
    return stream_trajectory(interpreter.run(), config, PIECE_ROWS), lambda: interpreter.files


class _FileDigests:
    """The digests of a program's files as they were read, subroutines in the same folder included."""

    def __init__(self, program: Path, digest: str) -> None:
        self._digests = {program: digest}

    def add_files(self, files: Sequence[tuple[Path, str]]) -> None:
        for file, digest in files:
            require_digest(file, digest, self._digests.setdefault(file, digest))

    def require_unchanged(self) -> dict[str, str]:
        for file, digest in self._digests.items():
            require_digest(file, compute_program_digest(file), digest)
        return {file.name: digest for file, digest in list(self._digests.items())[1:]}


class _PathBuffer:
    """Buffers the path until its blocks are planned; after them only the lines that a refusal may name."""

    def __init__(self, source: Iterator[Trajectory]) -> None:
        self._source = source
        self._parts: deque[tuple[int, Trajectory]] = deque()
        self._end = 0

    def read_parts(self) -> Iterator[Mapping[str, Float]]:
        for part in self._source:
            self._parts.append((self._end, part))
            self._end += part.time_s.size
            yield part.position_mm

    def take_positions(self, first: int, stop: int) -> dict[str, Float]:
        while self._parts and self._parts[0][0] + self._parts[0][1].time_s.size <= first:
            self._parts.popleft()
        found: dict[str, list[Float]] = {axis: [] for axis in self._parts[0][1].axes}
        for start, part in self._parts:
            for axis, values in part.position_mm.items():
                found[axis].append(np.asarray(values[max(0, first - start) : max(0, stop - start)]))
        return {axis: np.concatenate(parts) for axis, parts in found.items()}

    def find_line(self, row: int) -> int:
        for start, part in self._parts:
            if start <= row < start + part.time_s.size:
                return int(part.line[row - start])
        return 0


@dataclass(slots=True)
class _CheckSummary:
    rows: int = 0
    before_square: float = 0.0
    after_square: float = 0.0
    before_max: float = 0.0
    after_max: float = 0.0
    largest_um: float = 0.0
    refused: list[Reason] = field(default_factory=list)
    named: set[tuple[str, ...]] = field(default_factory=set)

    def add_block(self, block: StreamBlock) -> None:
        self.rows += block.before_um.size
        self.before_square += float(block.before_um @ block.before_um)
        self.after_square += float(block.after_um @ block.after_um)
        self.before_max = max(self.before_max, float(block.before_um.max()))
        self.after_max = max(self.after_max, float(block.after_um.max()))
        self.largest_um = max(self.largest_um, *(float(np.abs(o).max()) for o in block.offset_um.values()))

    def add_refusals(self, block: StreamBlock, path: _PathBuffer, dt_s: float) -> list[Reason]:
        """Add a block's refusals with line and time, once per line; return the new ones."""
        known = len(self.refused)
        for row, reason in sorted(zip(block.at, block.refused, strict=True), key=lambda pair: pair[0]):
            line = path.find_line(row)
            name = (reason.code, *reason.text.split()[:2], str(line or row))
            if name not in self.named:
                self.named.add(name)
                place = f"line {line}, at {row * dt_s:.2f} s" if line else f"at {row * dt_s:.2f} s"
                self.refused.append(Reason(reason.code, f"{place}: {reason.text}", reason.advice))
        return self.refused[known:]

    def compute_errors(self) -> dict[str, dict[str, float]]:
        then, now = (math.sqrt(square / max(1, self.rows)) for square in (self.before_square, self.after_square))
        return {
            "before": {"rms_um": then, "max_um": self.before_max},
            "after": {"rms_um": now, "max_um": self.after_max},
        }

    def make_header(self) -> dict[str, Any]:
        errors = self.compute_errors()
        refused = self.refused or list(check_gain(errors["before"]["rms_um"], errors["after"]["rms_um"]))
        reasons = [asdict(reason) for reason in refused[:MOST_REFUSED]]
        return {"rows": self.rows, **errors, "largest_um": self.largest_um, "refused": reasons}


def check_program(
    program: Path, sha256: str, models: Mapping[str, Parameters], config: MachineConfig, body: BinaryIO, report: Report
) -> dict[str, Any]:
    """Run the whole program through correction and gate; write its rows to ``body``, return the header.

    ``sha256`` is the digest under which the rows are stored. A row is the demand of each axis, then the offset of each,
    int32 in the guard's increments. ``report`` receives each block that passed ({"block": ...}, once its rows are
    written), each refusal ({"refused": ...}), and progress reports ({"progress": ...}). Raises ProgramError,
    RecordingError or ConfigError if the program cannot be used.
    """
    source, opened = _open_reference(program, config, sha256)
    path, findings, files = _PathBuffer(source), _CheckSummary(), _FileDigests(program, sha256)
    code, blocks, pace = compute_code_digest(), list[list[Any]](), _ProgressReporter(config.machine.sync_period_s)
    for block in stream_blocks(path.read_parts(), models, config, goes_on=True):
        demand = path.take_positions(block.first_row, block.first_row + block.before_um.size)
        files.add_files(opened())
        findings.add_block(block)
        for reason in findings.add_refusals(block, path, config.machine.sync_period_s):
            report({"refused": asdict(reason)})
        if len(findings.refused) >= MOST_REFUSED:
            break
        if not findings.refused:
            rows = encode_rows(demand, block.offset_um, config)
            body.write(rows)
            body.flush()
            blocks.append([findings.rows, hashlib.sha256(rows).hexdigest()])
            report({"block": blocks[-1], "last": block.final, "errors": findings.compute_errors()})
        pace.report_progress(report, findings, path)
    of = {
        "schema": SCHEMA,
        "axes": list(config.axis),
        "code": code,
        "blocks": blocks,
        "files": files.require_unchanged(),
    }
    return of | findings.make_header()


class _ProgressReporter:
    def __init__(self, dt_s: float) -> None:
        self._dt_s, self._begun_s, self._reported_s = dt_s, time.monotonic(), -math.inf

    def report_progress(self, report: Report, findings: _CheckSummary, path: _PathBuffer) -> None:
        now_s = time.monotonic()
        if now_s - self._reported_s < REPORT_S:
            return
        self._reported_s, checked_s = now_s, findings.rows * self._dt_s
        progress = {
            "checked_s": round(checked_s, 3),
            "line": path.find_line(findings.rows - 1),
            "times_real_time": round(checked_s / max(1e-3, now_s - self._begun_s), 1),
            "refused": len(findings.refused),
        }
        report({"progress": progress})


def encode_rows(demand_mm: Mapping[str, Float], offset_um: Mapping[str, Float], config: MachineConfig) -> bytes:
    """Return rows of demand and offset in increments, in the drives' own sign. Raises ProgramError beyond int32."""
    columns = []
    for values, per_mm in ((demand_mm, 1.0), (offset_um, 1e-3)):
        for axis, settings in config.axis.items():
            scale = settings.scaling.sign * settings.scaling.increments_per_mm * per_mm
            columns.append(np.rint(values[axis] * scale))
    rows = np.column_stack(columns)
    if not np.all(np.abs(rows) < INT32_END):
        raise ProgramError(0, "", "a row is not finite, or too large for the guard's table; use another program")
    return rows.astype("<i4").tobytes()


def compute_header_digest(header: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(header, sort_keys=True).encode()).hexdigest()


def make_part_path(folder: Path, key: str) -> Path:
    return folder / f".{key}.part"


def store_checked(folder: Path, key: str, request: Callable[[BinaryIO], dict[str, Any]]) -> dict[str, Any]:
    """Have the rows written, then store them and their header durably under ``key``; the oldest programs are removed.

    Raises StoreError if that fails. A refused program leaves nothing.
    """
    part = make_part_path(folder, key)
    try:
        make_folder(folder)
        for leftover in folder.glob(".*.part"):  # left by a check that was ended
            if leftover != part:
                leftover.unlink()
        with part.open("wb") as body:
            header = request(body)
            body.flush()
            os.fsync(body.fileno())
        if header["refused"]:
            return header
        part.rename(folder / (key + ROWS))
        write_file(folder / (key + HEADER), json.dumps(header | {"digest": compute_header_digest(header)}).encode())
        others = [file for file in folder.glob("*" + HEADER) if file.stem != key]
        keep_newest(folder / (key + HEADER), others, KEPT)
        for rows in folder.glob("*" + ROWS):
            if not rows.with_suffix(HEADER).exists():
                rows.unlink()
        sync_folder(folder)
    except OSError as error:
        raise make_store_error(part, error) from None
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
    return header


def main() -> None:
    """Answer one request; each output line is a JSON object, the last one is the answer."""
    limit_process(NICENESS, {})
    answer_request(receive_request(), report_to_parent)


def answer_request(request: Mapping[str, Any], report: Report) -> None:
    """Check the requested program, and pass progress, blocks and the answer to ``say``."""
    config = MachineConfig.model_validate(request["config"])
    models = {axis: Parameters.from_mapping(values) for axis, values in request["models"].items()}

    def run_check(body: BinaryIO) -> dict[str, Any]:
        return check_program(Path(request["program"]), request["program_digest"], models, config, body, report)

    try:
        header = store_checked(Path(request["folder"]), request["key"], run_check)
        report({"header": {name: value for name, value in header.items() if name != "blocks"}})  # which were reported
    except StoreError as error:
        report({"error": {"code": error.code, "text": str(error), "advice": "free disk space, then arm again"}})
    except FdhilError as error:
        advice = "correct the program, then arm again"
        report({"error": {"code": type(error).__name__, "text": str(error), "advice": advice}})


if __name__ == "__main__":
    main()
