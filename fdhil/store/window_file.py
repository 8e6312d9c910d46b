"""Stores G0 windows as Parquet, one file each, exactly to the bit.

A column from a drive is stored as the drive's own integers with scale and unit in the metadata (a 1 s window takes some
10 kB); the store tries the given scales and falls back to floats if a column is not an exact multiple. Files are
numbered, never dated: the order is independent of the wall clock.
"""

import hashlib
import io
import json
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fdhil.errors import RecordingError, StoreError
from fdhil.records import Float, NcMove, SlowVoltage, Stages, Window, make_read_only_view
from fdhil.store.atomic_file import make_folder, make_store_error, sync_folder, write_file
from fdhil.store.parquet_library import pa, pq
from fdhil.store.parquet_pages import count_uncompressed_bytes

FORMAT = "fdhil-window-1"
MAX_FILE_BYTES = 64 * 1024 * 1024
MAX_ROWS = 500_000  # half a minute at 60 us
MAX_HEAD_BYTES = 1024 * 1024
ROW_BYTES, SPARE_BYTES = 16, 64 * 1024  # of a column, whatever its encoding
COLUMNS: Mapping[str, str] = {
    "demand_mm": "mm",
    "position_mm": "mm",
    "speed_rad_s": "rad/s",
    "current_a": "A",
    "voltage_v": "V",
    "offset_mm": "mm",
    "table_mm": "mm",
    "table_m_s2": "m/s2",
    "current_off_a": "A",
}
ADDED_LATER = {"table_mm", "table_m_s2", "current_off_a"}  # absent in older windows, whose digest stays the same
OPTIONAL = {"voltage_v", "offset_mm", *ADDED_LATER}
_NAME = re.compile(r"w(\d{8,12})-([A-Z]2?)\.parquet")
_META = b"fdhil"
REFUSED = (
    pa.ArrowException, OSError, ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError,
    MemoryError,
)  # fmt: skip
_NEXT = "make a new recording or use an older one"

Bits = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class RawScale:
    """The scale of a drive's integer q: its value is q * ``factor`` / ``divisor``, in this order of operations."""

    factor: float = 1.0
    divisor: float = 1.0

    def decode(self, raw: Float) -> Float:
        """Return the values of raw integers (n,), given as floats; NaN stays NaN."""
        return raw * self.factor / self.divisor

    def encode(self, values: Float) -> Float | None:
        """Return the raw integers (n,) that decode to exactly ``values``, NaN where they are NaN, or None."""
        with np.errstate(invalid="ignore", over="ignore"):
            raw = np.rint(values * self.divisor / self.factor)
        finite = np.isfinite(values)
        if not np.array_equal(np.isnan(values), ~finite) or np.any(np.abs(raw[finite]) >= 2.0**53):
            return None
        raw = np.where(finite, raw + 0.0, np.nan)  # an integer has no negative zero
        return raw if np.array_equal(_get_bits(self.decode(raw)), _get_bits(values)) else None


def _get_bits(values: Float) -> Bits:
    """Return the bit patterns; all NaN are equal, since a lost sample has no payload."""
    return np.where(np.isnan(values), np.nan, values).view(np.int64)


Scales = Mapping[str, Sequence[RawScale]]


def encode_window(window: Window, config_digest: str, scales: Scales | None = None) -> bytes:
    """Return a window as the bytes of a Parquet file; ``scales`` names the candidates of each drive column."""
    columns: dict[str, Any] = {}
    described: dict[str, Any] = {}
    encodings = {"tick": "DELTA_BINARY_PACKED"}
    ticks = window.start_tick + np.arange(window.n, dtype=np.int64)
    columns["tick"] = pa.array(ticks)
    for name, unit in COLUMNS.items():
        values = getattr(window, name)
        if values is None:
            continue
        scale, columns[name] = _encode_column(values, (scales or {}).get(name, ()))
        raw = scale is not None
        encodings[name] = "DELTA_BINARY_PACKED" if raw else "BYTE_STREAM_SPLIT"
        described[name] = {"unit": unit} | ({"factor": scale.factor, "divisor": scale.divisor} if scale else {})
    if window.slow_voltage is not None:
        rest = window.n - window.slow_voltage.voltage_v.size
        columns["slow_voltage_v"] = pa.array(np.append(window.slow_voltage.voltage_v, np.full(rest, np.nan)))
        encodings["slow_voltage_v"] = "BYTE_STREAM_SPLIT"
    head = _make_header(window) | {"columns": described, "config_digest": config_digest}
    head["digest"] = _compute_digest(window)
    table = pa.table(columns).replace_schema_metadata({_META: json.dumps(head).encode()})
    sink = io.BytesIO()
    pq.write_table(
        table, sink, compression="zstd", use_dictionary=False, column_encoding=encodings, write_page_checksum=True
    )
    return sink.getvalue()


def _encode_column(values: Float, candidates: Sequence[RawScale]) -> tuple[RawScale | None, Any]:
    for scale in candidates:
        raw = scale.encode(values)
        if raw is not None:
            lost = np.isnan(raw)
            return scale, pa.array(np.where(lost, 0.0, raw).astype(np.int64), mask=lost)
    return None, pa.array(values)


def _make_header(window: Window) -> dict[str, Any]:
    """Return the fields of a window that are not arrays, exactly as JSON stores them.

    A slow sensor's samples are a column that ends earlier than the others; its grid is stored here.
    """
    plain = {field.name: getattr(window, field.name) for field in fields(Window) if field.name not in COLUMNS}
    slow = plain.pop("slow_voltage")
    if plain["torque_constant_nm_per_a"] is None:  # as in older windows, whose digest stays the same
        del plain["torque_constant_nm_per_a"]
    if plain["is_rapid"]:  # as in windows from before laboratory moves
        del plain["is_rapid"]
    nc = plain.pop("nc")
    if nc is not None:
        plain["nc"] = asdict(nc)
    if slow is not None:
        grid = {"begin_s": slow.begin_s, "period_s": slow.period_s, "error_s": slow.error_s}
        plain["slow_voltage"] = grid | {"samples": slow.voltage_v.size}
        if slow.late_s is not None:
            plain["slow_voltage"]["late_s"] = slow.late_s.tolist()
    return plain | {"format": FORMAT, "clock": "SYNC tick", "stages": asdict(window.stages)}


def _compute_digest(window: Window) -> str:
    digest = hashlib.sha256(json.dumps(_make_header(window), sort_keys=True).encode())
    for name in COLUMNS:
        values = getattr(window, name)
        if values is None and name in ADDED_LATER:
            continue
        digest.update(name.encode() + (b"-" if values is None else _get_bits(values).tobytes()))
    if window.slow_voltage is not None:
        digest.update(_get_bits(window.slow_voltage.voltage_v).tobytes())
    return digest.hexdigest()


def decode_window(content: bytes, source: str = "recording") -> Window:
    """Return the window of a Parquet file's bytes. RecordingError if it is foreign, truncated or damaged."""
    try:
        window, digest = _decode_parquet(content)
    except REFUSED as error:
        first = (str(error).splitlines() or [type(error).__name__])[0][:200]
        raise RecordingError(f"{source} is not a window recording of fdhil: {first}; {_NEXT}") from None
    if digest != _compute_digest(window):
        raise RecordingError(f"{source} is damaged: its digest does not match its content; {_NEXT}")
    return window


def _decode_parquet(content: bytes) -> tuple[Window, str]:
    file = pq.ParquetFile(pa.BufferReader(content), page_checksum_verification=True)
    head = json.loads((file.metadata.metadata or {}).get(_META, b"{}")[:MAX_HEAD_BYTES])
    if head.get("format") != FORMAT:
        raise ValueError(f"its format is {head.get('format')!r}, not {FORMAT}")
    _check_declared(file, content)
    table = file.read()
    arrays: dict[str, Any] = {}
    for name in COLUMNS:
        described = head["columns"].get(name)
        arrays[name] = None if described is None else _decode_column(table.column(name), described)
    if any(arrays[name] is None for name in COLUMNS.keys() - OPTIONAL):
        raise ValueError("a column is missing")
    grid, arrays["slow_voltage"] = head.pop("slow_voltage", None), None
    if grid is not None:
        samples = _decode_column(table.column("slow_voltage_v"), {})[: int(grid["samples"])]
        begin, period, error = (float(grid[name]) for name in ("begin_s", "period_s", "error_s"))
        late = make_read_only_view(np.array(grid["late_s"], np.float64)) if "late_s" in grid else None
        if late is not None and late.shape != samples.shape:
            raise ValueError("its slow voltage lacks a time per sample")
        arrays["slow_voltage"] = SlowVoltage(begin, period, error, samples, late)
    return _make_window(head, arrays), str(head["digest"])


def _check_declared(file: pq.ParquetFile, content: bytes) -> None:
    """Refuse, before any of it is read, what would take more than a window does; ValueError says what."""
    metadata = file.metadata
    if metadata.num_rows > MAX_ROWS:
        raise ValueError(f"it declares {metadata.num_rows} rows, {MAX_ROWS} are allowed")
    names = [file.schema.column(k).path for k in range(metadata.num_columns)]
    if len(set(names)) != len(names) or not {"tick", *COLUMNS, "slow_voltage_v"}.issuperset(names):
        raise ValueError("it has columns unknown in windows")
    for group in map(metadata.row_group, range(metadata.num_row_groups)):
        for k, name in enumerate(names):
            column, shape = group.column(k), file.schema.column(k)
            if column.physical_type not in ("INT64", "DOUBLE") or shape.max_repetition_level:
                raise ValueError(f"its column {name} does not contain plain numbers")
            if column.has_dictionary_page:
                raise ValueError(f"its column {name} has a dictionary, which windows never have")
            size = count_uncompressed_bytes(content, column.data_page_offset, column.total_compressed_size)
            if size > ROW_BYTES * group.num_rows + SPARE_BYTES:
                raise ValueError(f"its column {name} declares {size} bytes for {group.num_rows} rows")


def _decode_column(column: Any, described: Mapping[str, Any]) -> Float:
    values = np.asarray(column.to_numpy(), dtype=np.float64)
    if "factor" in described:
        values = RawScale(float(described["factor"]), float(described["divisor"])).decode(values)
    return make_read_only_view(values)


def _make_window(head: Mapping[str, Any], arrays: Mapping[str, Any]) -> Window:
    known = {field.name for field in fields(Window)}
    plain = {key: value for key, value in head.items() if key in known}
    stages = {key: None if span is None else (int(span[0]), int(span[1])) for key, span in head["stages"].items()}
    plain["stages"] = Stages(**stages)
    if "nc" in plain:
        override = plain["nc"]["override"]
        plain["nc"] = NcMove(**plain["nc"] | {"override": None if override is None else (override[0], override[1])})
    plain["gaps"] = tuple((int(start), int(end)) for start, end in head["gaps"])
    return Window(**plain, **arrays)


def read_window(path: Path) -> Window:
    """Read one window file. RecordingError if it is unreadable, too large, foreign, truncated or damaged."""
    try:
        with path.open("rb") as file:
            content = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}; check the path and its permissions") from None
    if len(content) > MAX_FILE_BYTES:
        raise RecordingError(f"{path} is larger than 64 MiB, too large for a window; {_NEXT}")
    return decode_window(content, str(path))


@dataclass(frozen=True, slots=True)
class WindowFile:
    """One stored window: its running ``number``, axis and path."""

    number: int
    axis: str
    path: Path


@dataclass(frozen=True, slots=True)
class WindowListing:
    """The files of a folder: ``windows`` oldest first, and the names of ``strays``, which are ignored."""

    windows: tuple[WindowFile, ...]
    strays: tuple[str, ...]


def list_windows(folder: Path) -> WindowListing:
    """List the window files of a folder; a missing folder is empty. Raises StoreError if it cannot be read."""
    windows, strays = [], []
    try:
        entries = sorted(folder.iterdir()) if folder.exists() else []
        for path in entries:
            match = _NAME.fullmatch(path.name)
            if match and path.is_file() and not path.is_symlink():
                windows.append(WindowFile(int(match[1]), match[2], path))
            else:
                strays.append(path.name)
    except OSError as error:
        raise StoreError(f"{folder} cannot be listed: {error.strerror}; check its permissions") from None
    windows.sort(key=lambda file: file.number)
    return WindowListing(tuple(windows), tuple(strays))


class WindowStore:
    """Writes the folder of windows (one daemon): appends, and removes the oldest beyond ``keep`` files."""

    def __init__(self, folder: Path, keep: int, config_digest: str) -> None:
        """Open or create the folder. Raises StoreError if it cannot be created or listed."""
        self.folder = folder
        self._keep = keep
        self._config_digest = config_digest
        try:
            make_folder(folder)
        except OSError as error:
            raise make_store_error(folder, error) from None
        listing = list_windows(folder)
        self.strays = listing.strays
        self.removal_error: StoreError | None = None  # why the first file that should have been removed is still there
        self._files = list(listing.windows)

    def append_window(self, window: Window, scales: Scales | None = None, at_least: int = 0) -> WindowFile:
        """Write a window durably and return its file; its number exceeds every stored one and ``at_least``.

        Raises StoreError if it cannot be written: no incomplete file remains under the window's name. If an old file
        cannot be removed, ``left`` says why; the next store that is opened tries again.
        """
        number = max(self._files[-1].number if self._files else 0, at_least) + 1
        file = WindowFile(number, window.axis, self.folder / f"w{number:08d}-{window.axis}.parquet")
        write_file(file.path, encode_window(window, self._config_digest, scales))
        self._files.append(file)
        self._remove_oldest()
        return file

    def _remove_oldest(self) -> None:
        old = [self._files.pop(0).path for _ in range(len(self._files) - self._keep)]
        for path in old:
            try:
                path.unlink(missing_ok=True)
            except OSError as error:
                text = f"{path} cannot be removed ({error.strerror}) and stays; new windows are still stored"
                self.removal_error = self.removal_error or StoreError(
                    f"{text}; check the disk and the file's permissions"
                )
        if old:
            with suppress(OSError):  # a file that a power cut brings back is removed later
                sync_folder(self.folder)
