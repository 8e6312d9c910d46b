"""A store of simulated weeks: rapids of drives that wear and warm, through the daemon's own pipeline and store.

Independent of the clock: the caller sets the time of the last rapid, each earlier one is half a day older.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest

from fdhil.config import Axis, MachineConfig
from fdhil.correction.learned_offsets import LearnedOffset
from fdhil.daemon import black_box
from fdhil.daemon.kernel_warmup import simulate_nominal_rapid
from fdhil.daemon.outcome_store import OutcomeStore
from fdhil.pipeline import AxisPipeline
from fdhil.records import Notice, Window, freeze_array
from fdhil.store.history_rows import TimeStamp
from fdhil.store.learned_offset_files import make_learned_path, write_learned
from fdhil.system_clock import SYSTEM_CLOCK, Clock

DAY_S = 86_400.0
APART_S = DAY_S / 2
TICKS_APART = 10_000
LOADED_AT = 0.7  # of the weeks: since then a heavier table
LIGHTER = 0.075 / 0.085
WEAR = 0.35  # of ft over the weeks
AMBIENT_C = 20.0
REFUSED_EVERY = 9

NOTICES = (
    Notice("Armed", "info", "armed corner.ngc: contour error 41.2 um RMS is predicted to become 0.6 um"),
    Notice(
        "PassMeasured",
        "info",
        "pass 3 of corner.ngc: contour error measured 0.92 um RMS, 2.1 at most (predicted 0.60 ± 0.40; "
        "without correction 41.2 predicted; gain 44.8, predicted 68.7)",
    ),
    Notice("ArmRefused", "minor", "ModelNotFresh: axis X was identified 11 h ago"),
    Notice("GuardState", "MAJOR", "ACTIVE -> OFF: DriveEmergency", "X"),
    Notice("GuardTripped", "MAJOR", "DriveEmergency: drive X sent emergency 0x4310", "X"),
)
FRAMES = "".join(f"({k * 1e-3:.6f}) can0 {can_id}#{k % 256:02X}00\n" for k in range(400) for can_id in ("080", "181"))


def fill_store(config: MachineConfig, rapids: int = 84, last: TimeStamp | None = None) -> None:
    """Write ``rapids`` of each axis with their results, notices and a black box; the newest is ``last`` (now).

    At the end every drive has its configuration's nominal values, so that an unchanged simulator is that machine.
    """
    last = last or TimeStamp.now()
    rng = np.random.default_rng(16)
    with open_daemon_store(config) as (store, clock):
        pipelines = {name: AxisPipeline(name, config) for name in config.axis}
        for k in range(rapids):
            clock["at"] = shift_time(last, (rapids - 1 - k) * APART_S)
            celsius = AMBIENT_C + 1.5 * float(np.sin(1.3 * k)) * (k < rapids - 4)
            for name, pipeline in pipelines.items():
                window = make_rapid(name, config, k, rapids, celsius, int(rng.integers(1 << 30)))
                assert store.store_outcomes(pipeline.process_record(window)) == []
        clock["at"] = shift_time(last, APART_S)
        store.store_outcomes([*NOTICES, write_black_box(config, clock["at"])])


@contextmanager
def open_daemon_store(config: MachineConfig) -> Iterator[tuple[OutcomeStore, dict[str, TimeStamp]]]:
    clock: dict[str, TimeStamp] = {}

    class ManualClock(TimeStamp):
        @staticmethod
        def now(_clock: Clock = SYSTEM_CLOCK) -> TimeStamp:
            return clock["at"]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fdhil.daemon.outcome_store.TimeStamp", ManualClock)
        store = OutcomeStore(config)
        assert store.open() == []
        try:
            yield store, clock
        finally:
            store.close()


def shift_time(stamp: TimeStamp, seconds: float) -> TimeStamp:
    monotonic_ns = stamp.monotonic_ns - round(seconds * 1e9)
    return TimeStamp(stamp.wall_s - seconds, stamp.boot if monotonic_ns >= 0 else "earlier", abs(monotonic_ns))


def write_black_box(config: MachineConfig, at: TimeStamp) -> Notice:
    folder = config.store.directory / black_box.BLACK_BOX_FOLDER
    folder.mkdir()
    stamp = datetime.fromtimestamp(at.wall_s, UTC).strftime("%Y%m%dT%H%M%S.%fZ")
    file = folder / f"{stamp}-DriveEmergency.log"
    file.write_text(FRAMES, "ascii")
    return Notice("BlackBox", "info", f"the last {FRAMES.count(chr(10))} frames are in {file}")


def make_rapid(name: str, config: MachineConfig, k: int, rapids: int, celsius: float, seed: int) -> Window:
    worn = make_worn_axis(config.axis[name], (k + 1) / rapids, celsius)
    window = simulate_nominal_rapid(name, worn, config.machine.sync_period_s, 1 if k % 2 == 0 else -1, seed)
    window = replace(window, start_tick=k * TICKS_APART, temperature_c=round(celsius, 2), source="inferred")
    if k % REFUSED_EVERY == REFUSED_EVERY - 3:
        return damage_recording(window, k // REFUSED_EVERY)
    return window


def make_worn_axis(axis: Axis, share: float, celsius: float) -> Axis:
    nominal = axis.nominal
    was: Mapping[str, Any] = {
        "ft": nominal.ft * (1 - WEAR * (1 - share)),
        "Cd": nominal.Cd * (1 - 0.02 * (celsius - AMBIENT_C)),
        "Jt": nominal.Jt * (1.0 if share > LOADED_AT else LIGHTER),
    }
    return axis.model_copy(update={"nominal": nominal.model_copy(update=was)})


def damage_recording(window: Window, kind: int) -> Window:
    assert window.stages.cruise is not None
    assert window.voltage_v is not None
    begin, end = window.stages.cruise
    current, voltage = window.current_a.copy(), window.voltage_v.copy()
    if kind % 2 == 0:
        current[begin + 60 : end - 60] += 9.0 * window.direction
        return replace(window, current_a=freeze_array(current))
    voltage[begin + 50 : begin + 250] = voltage[begin + 50]
    return replace(window, voltage_v=freeze_array(voltage))


def write_learned_offsets(config: MachineConfig, program_digest: str, rows: int) -> None:
    offset = freeze_array(0.05 * np.sin(np.arange(rows) / 300.0))
    learned = LearnedOffset(dict.fromkeys(config.axis, offset), 10.3, 0.7, (3.4, 1.6, 0.9))
    write_learned(make_learned_path(config.store.directory / "lessons", program_digest, config.digest), learned)
