"""Stores each outcome of the daemon; when the disk refuses, it reports that and the daemon continues in shadow."""

import math
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from fdhil.arming import Answer
from fdhil.config import MachineConfig
from fdhil.daemon import service_log
from fdhil.daemon.notice_log import NEWEST, NotAcknowledged, NoticeLog, describe_numbers, parse_acknowledgement
from fdhil.drivers import load_profile
from fdhil.errors import StoreError
from fdhil.identification import HISTORY_WINDOWS, DriftPoint, PoolMember
from fdhil.pipeline import POOL_WINDOWS, PipelineState
from fdhil.records import (
    PARAMETERS,
    Float,
    LoopEstimate,
    Notice,
    Outcome,
    Parameters,
    ParameterSet,
    Skill,
    WindowOutcome,
    freeze_array,
)
from fdhil.store import (
    HISTORY_FILE_NAME,
    History,
    Outbox,
    RawScale,
    Revision,
    Scales,
    StoredWindow,
    TimeStamp,
    WindowStore,
    find_newest_loops,
    find_newest_parameters,
    sync_folder,
)
from fdhil.store import WINDOWS_FOLDER as WINDOWS_FOLDER
from fdhil.system_clock import SYSTEM_CLOCK, Clock

SKILLS = 3
# the log first: it may hold the newest rows, and SQLite removes a log without its file
SUFFIXES = ("-wal", "-shm", "")


def get_raw_scales(config: MachineConfig, axis: str) -> Scales:
    """Return the scales from the drive's integers to the values of each column, as the drivers apply them."""
    settings = config.axis[axis]
    profile = load_profile(settings.drive)
    position = (RawScale(settings.scaling.sign / settings.scaling.increments_per_mm),)
    voltage = abs(profile.compute_voltage_scale(settings))
    return {
        "demand_mm": position,
        "position_mm": position,
        "speed_rad_s": (RawScale(profile.compute_speed_scale(settings)),),
        "current_a": (RawScale(profile.compute_current_scale(settings)),),
        "voltage_v": (RawScale(voltage), RawScale(-voltage)) if voltage else (),
    }


def _read_figures(window: StoredWindow, key: str) -> Float:
    """Return a figure (6,) of each parameter of a stored window, NaN where it is missing."""
    figures = window.parameters or {}
    return freeze_array(
        [math.nan if (number := figures.get(name, {}).get(key)) is None else number for name in PARAMETERS]
    )


def _read_pool_members(windows: Sequence[StoredWindow]) -> tuple[PoolMember, ...]:
    members = []
    for place, window in enumerate(windows, start=1 - len(windows)):
        if (pooled := window.pool_entry) is not None:
            values, own, shared = (freeze_array(pooled[key]) for key in ("values", "own", "shared"))
            members.append(PoolMember(tuple(pooled["names"]), values, own, shared, place, window.direction))
    return tuple(members)


class OutcomeStore:
    """Writes outcomes to the folder of windows and to the history. Safe to call from several worker threads.

    A failing store never stops the daemon: ``fault`` is the class of the refusal (None while all is well), the outcome
    stays in memory only, and each next one is tried again (a window always as a new file).
    """

    def __init__(self, config: MachineConfig, clock: Clock = SYSTEM_CLOCK) -> None:
        self._config, self._clock = config, clock
        self._directory = config.store.directory
        self._lock = threading.Lock()
        self._outbox = Outbox(config.uplink, config.uplink_directory) if config.uplink else None
        self._scales = {axis: get_raw_scales(config, axis) for axis in config.axis}
        self._history: History | None = None
        self._windows: WindowStore | None = None
        self._accepted = {
            axis: deque[tuple[int, int]](maxlen=HISTORY_WINDOWS) for axis in config.axis
        }  # start tick and row
        self.notices = NoticeLog()
        self.fault: str | None = None
        self._file_reported = False
        self.strays: tuple[str, ...] = ()

    def open(self) -> list[Notice]:
        """Open or create the store; a damaged history is moved aside, never deleted. Return notices."""
        notices = []
        try:
            notices += self._open_files()
            notices += self.notices.end_previous_conditions()
        except StoreError as error:
            if error.code == "CorruptFile":
                notices += self._put_history_aside(error)
            else:
                notices += self._note_refusal(error)
        if self.strays:
            names = ", ".join(self.strays[:5])
            folder = self._directory / WINDOWS_FOLDER
            text = f"{len(self.strays)} files in {folder} are not windows and are ignored: {names}."
            notices.append(Notice("StrayFiles", "minor", text))
        return notices

    def _open_files(self) -> list[Notice]:
        new = self._history is None
        if self._history is None:
            outbox = self._outbox
            adding = (outbox.add_entry, outbox.add_earlier_rows) if outbox else (None, None)
            self._history = History.open(self._directory, *adding)
        folder = self._directory / WINDOWS_FOLDER
        self._windows = WindowStore(folder, self._config.store.keep_windows, self._config.digest)
        self.strays = tuple(map(service_log.escape_unprintable, self._windows.strays))
        if not new:
            return []
        places = self._history.quarantine_damaged_rows()
        self.notices.load_history(self._history.read_notices(limit=NEWEST))
        self._history.write_checkpoint()
        text = f"Damaged rows of the history were moved aside, older ones are used: {places}; check the disk."
        return [Notice("CorruptFile", "MAJOR", text)] if places else []

    def _abandon_replaced_history(self) -> list[Notice]:
        """Close a history whose file was replaced, removed or overwritten; the new file is opened next."""
        if self._history is None or self._history.is_in_place():
            return []
        with suppress(OSError):
            self._history.discard_file()
        self._history = None
        for rows in self._accepted.values():
            rows.clear()  # row numbers of the old file
        path = self._directory / HISTORY_FILE_NAME
        text = f"{path} was replaced, removed or overwritten while the daemon ran: records made since that file"
        return [Notice("StoreReplaced", "MAJOR", f"{text} was written are not in it; new records go to the new file.")]

    def _put_history_aside(self, error: StoreError) -> list[Notice]:
        path = self._directory / HISTORY_FILE_NAME
        k = 1
        while any(path.with_name(f"{HISTORY_FILE_NAME}.corrupt-{k}{suffix}").exists() for suffix in SUFFIXES):
            k += 1
        aside = path.with_name(f"{HISTORY_FILE_NAME}.corrupt-{k}")
        try:
            for suffix in SUFFIXES:
                with suppress(FileNotFoundError):
                    path.with_name(HISTORY_FILE_NAME + suffix).rename(path.with_name(aside.name + suffix))
            sync_folder(self._directory)
            notices = self._open_files()
        except (OSError, StoreError):
            return self._note_refusal(error)
        text = f"The history was damaged; it is kept as {aside.name}, and a new one was started; check the disk."
        return [Notice("CorruptFile", "MAJOR", text), *notices]

    def close(self) -> None:
        """Close the history."""
        with self._lock:
            if self._history is not None:
                self._history.close()
                self._history = None

    def read_newest_revisions(self) -> dict[str, Revision]:
        """Return the newest revision of each axis in the history."""
        return {} if self._history is None else find_newest_parameters(self._history, self._config.axis)

    def read_newest_skills(self) -> list[Skill]:
        """Return the newest skills of all axes, oldest first."""
        if self._history is None:
            return []
        return [skill for axis in self._config.axis for skill in self._history.read_skills(axis, limit=SKILLS)]

    def read_axis_history(self, axis: str) -> PipelineState:
        """Return what an earlier run left: first values, newest set, estimates of the newest accepted windows."""
        if self._history is None:
            return PipelineState()
        newest = self._history.read_revisions(axis, limit=1)
        first = {
            direction: Parameters.from_mapping(dict(zip(PARAMETERS, _read_figures(window, "value"), strict=True)))
            for direction, window in self._history.read_first_windows(axis).items()
        }
        windows = [window for window in self._history.read_windows(axis, limit=2 * HISTORY_WINDOWS) if window.accepted][
            -HISTORY_WINDOWS:
        ]
        points = tuple(
            DriftPoint(
                _read_figures(window, "value"), _read_figures(window, "std"), window.start_tick, window.direction
            )
            for window in windows[-4 * POOL_WINDOWS :]
        )
        published = newest[0].set if newest else None
        loops = find_newest_loops(self._history, axis, self._config.digest)
        return PipelineState(first, published, points, _read_pool_members(windows), loops)

    def count_windows(self, axis: str) -> tuple[int, int]:
        """Return how many windows of an axis were ever accepted and refused."""
        return (0, 0) if self._history is None else self._history.count_windows(axis)

    def store_outcomes(self, outcomes: Sequence[Outcome]) -> list[Notice]:
        """Store outcomes durably in order; return a notice when that fails, and one when it works again."""
        with self._lock:
            notices = []
            try:
                notices += self._abandon_replaced_history()
                notices += self._write_outcomes(outcomes)
                if replaced := self._abandon_replaced_history():  # replaced during the write
                    notices += [*replaced, *self._write_outcomes(outcomes)]
            except StoreError as error:
                return notices + self._note_refusal(error)
            notices += self._report_undeleted_file()
            if self.fault is not None and any(isinstance(outcome, WindowOutcome) for outcome in outcomes):
                self.fault = None
                text = "The store can be written again; records in between were not stored, arm again when needed."
                notices.append(Notice("StoreRecovered", "info", text))
        return notices

    def _write_outcomes(self, outcomes: Sequence[Outcome]) -> list[Notice]:
        notices = self._open_files() if self._history is None or self._windows is None else []
        assert self._history is not None
        for outcome in outcomes:
            self._store_outcome(outcome)
        self._history.write_checkpoint()
        return notices

    def _report_undeleted_file(self) -> list[Notice]:
        left = self._windows.removal_error if self._windows is not None else None
        if left is None or self._file_reported:
            return []
        self._file_reported = True
        return [Notice("StrayFiles", "minor", str(left))]

    def store_acknowledgement(self, request: Mapping[str, Any]) -> Answer:
        """Store an acknowledgement of notices; StoreError when the disk refuses."""
        with self._lock:
            try:
                given = parse_acknowledgement(request, self.notices.select_open(request), TimeStamp.now(self._clock))
            except NotAcknowledged as refused:
                return refused.answer
            if self._history is None:
                self._open_files()
            assert self._history is not None
            self._require_in_place(self._history)
            if given.notices:
                self._history.add_acknowledgement(given)
                self._require_in_place(self._history)
                self._history.write_checkpoint()
                self.notices.note_acknowledged(given)
        still_open = self.notices.build_status()["count"]
        text = f"{describe_numbers(given.notices)} acknowledged by {given.who}; {still_open} more are open"
        service_log.write_line(text)
        return {"ok": True, "text": text, "acknowledged": list(given.notices)}

    def _require_in_place(self, history: History) -> None:
        if not history.is_in_place():
            text = (
                f"{self._directory / HISTORY_FILE_NAME} was replaced; nothing is acknowledged; check the notices again"
            )
            raise StoreError(text, "StoreReplaced")

    def _store_outcome(self, outcome: Outcome) -> None:
        assert self._history is not None
        assert self._windows is not None
        stamp = TimeStamp.now(self._clock)
        if isinstance(outcome, WindowOutcome):
            axis = outcome.window.axis
            last = self._history.find_last_window_number()
            file = self._windows.append_window(outcome.window, self._scales[axis], last)
            number = self._history.add_window(outcome, file.path.name, stamp)
            if outcome.verdict.accepted:
                self._accepted[axis].append((outcome.window.start_tick, number))
        elif isinstance(outcome, ParameterSet):
            ids = [number for tick, number in self._accepted[outcome.axis] if tick in outcome.window_ticks]
            self._history.add_revision(outcome, ids, stamp)
        elif isinstance(outcome, Notice):
            self.notices.add_stored(outcome, self._history.add_notice(outcome, stamp), stamp)
        elif isinstance(outcome, LoopEstimate):
            self._history.add_loops(outcome, stamp)
        else:
            self._history.add_skill(outcome, stamp)

    def _note_refusal(self, error: StoreError) -> list[Notice]:
        again, self.fault = self.fault == error.code, error.code
        self._windows = None  # its folder may be gone
        if again:
            return []
        return [Notice(error.code, "MAJOR", f"{error}; the daemon continues in shadow and cannot be armed.")]
