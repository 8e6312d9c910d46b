"""Play a demand on the drives of a test bench without an NC: fdhil acts as the NC meanwhile.

It produces SYNC, is the NMT master and streams the set-points (0x607A) in cyclic synchronous position mode. Everything
is checked before anything is sent. However it ends, the axes are braked, the drives switched off and written objects
restored. A guard can correct at the same time: the offsets (0x60B0) are the guard's alone.
"""

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fdhil.cia402 import NmtCommand, Object
from fdhil.commissioning.axis_motion import follow_path, ignore_interrupts, watch_power
from fdhil.commissioning.commissioning_record import CommissioningRecord, is_record_of_config, load_record
from fdhil.commissioning.commissioning_steps import enable_drive, prepare_drive
from fdhil.commissioning.drive_survey import listen_for_master, require_no_fault, survey_drive
from fdhil.commissioning.finding import read_optional
from fdhil.commissioning.foreign_master_stop import OFF_WORDS
from fdhil.commissioning.master import Master
from fdhil.commissioning.record_comparison import compare_record
from fdhil.commissioning.set_points import AxisBounds, SetPointGenerator, plan_straight_move
from fdhil.commissioning.sync_cycle import Lateness, SyncCycle
from fdhil.commissioning.void_mark import is_record_void
from fdhil.commissioning.watchdog import watch_heartbeat
from fdhil.config import MachineConfig
from fdhil.errors import ConfigError, ConfigFault, DeviceError, DriveFault, ForeignMaster
from fdhil.records import Float, Trajectory

NEAR_MM = 0.05  # a start within this distance needs no --go-to-start
APPROACH_SHARE = 0.1  # of the axis' permitted speed, on the way to the start
APPROACH_CYCLES = 50
SETTLE_S = 0.3  # rest after the last row: the drives apply set-points with a delay
LANDING_S = 3.0  # a guard needs less to ramp to zero
OFF_CYCLES = 20
BLOCK_ROWS = 256
Signals = Callable[[SetPointGenerator], contextlib.AbstractContextManager[None]]
"""Makes Ctrl-C and similar signals stop a path instead of raising."""


@dataclass(frozen=True, slots=True)
class PlaybackResult:
    """Result of a playback: rows played of all, why it ended early (None: it did not), SYNC lateness, scheduling.

    ``left`` describes how the drives were left; empty if ``stopped`` does.
    """

    rows: int
    of: int
    stopped: str | None
    lateness: Lateness
    scheduling: str
    left: str = "braked, the drives are off"


@dataclass(frozen=True, slots=True)
class PlaybackPlan:
    """A demand in increments for every axis of the machine; an axis that it does not name keeps its position."""

    config: MachineConfig
    trajectory: Trajectory
    bounds: tuple[AxisBounds, ...]

    @property
    def axes(self) -> tuple[str, ...]:
        """The machine's axes."""
        return tuple(self.config.axis)

    def compute_set_points(self, here: Sequence[int]) -> Float:
        """Return the set-points (n, axes) in increments; ``here`` are the present positions."""
        position, count = self.trajectory.position_mm, self.trajectory.time_s.size
        columns = []
        for axis, at in zip(self.axes, here, strict=True):
            scaling = self.config.axis[axis].scaling
            per_mm = scaling.sign * scaling.increments_per_mm
            columns.append(position[axis] * per_mm if axis in position else np.full(count, float(at)))
        return np.column_stack(columns)


def plan_playback(config: MachineConfig, trajectory: Trajectory, source: str) -> PlaybackPlan:
    """Check a demand against [axis.*.setpoints]; ConfigError without that section, DriveFault for an invalid row."""
    lacking = [name for name, axis in config.axis.items() if axis.setpoints is None]
    if lacking:
        faults = [
            ConfigFault(
                f"axis.{name}.setpoints", "is missing, so fdhil may not move this axis", "add it with travel_mm"
            )
            for name in lacking
        ]
        raise ConfigError(source, faults)
    bounds = []
    for name, axis in config.axis.items():
        assert axis.setpoints is not None
        travel, speed = axis.setpoints.travel_mm, axis.setpoints.max_speed_mm_s
        bounds.append(AxisBounds.create_for_axis(name, axis, config.machine.sync_period_s, travel, speed))
    plan = PlaybackPlan(config, trajectory, tuple(bounds))
    _require_inside_bounds(plan)
    return plan


def _require_inside_bounds(plan: PlaybackPlan) -> None:
    """Play the rows without sending them, to find the first one that would stop the motion."""
    middle = [round((of.low + of.high) / 2) for of in plan.bounds]
    rows = plan.compute_set_points(middle)
    points = SetPointGenerator(plan.bounds, rows[0].round().astype(int).tolist())
    points.play_rows(rows.tolist())
    while not points.is_resting and points.stopped is None:
        points.advance_cycle()
    if points.stopped is not None:
        row = min(points.played, len(rows) - 1)
        where = f"{plan.trajectory.time_s[row]:.3f} s, {plan.trajectory.describe_position(row)}"
        advice = "nothing was sent; change the program, or [axis.*.setpoints] if the machine has the room"
        raise DriveFault("the demand", f"{points.stopped} (row {row + 1}, {where}); {advice}")


def load_valid_records(config: MachineConfig) -> dict[str, CommissioningRecord]:
    """Return the record of every axis; DriveFault if one is missing, void, or of another configuration."""
    found = {}
    for name in config.axis:
        record = load_record(config.store.directory, name, config.store.commissioning_key)
        if record is None or not is_record_of_config(record, config, name) or record.watchdog != "proven":
            what = "it is not commissioned with this configuration"
            raise DriveFault(f"drive {name}", f"{what}, so nothing was sent; run fdhil commission --axis {name}")
        if is_record_void(config.store.directory, name):
            what = "it was reconfigured or has rebooted since it was commissioned"
            raise DriveFault(f"drive {name}", f"{what}, so nothing was sent; run fdhil check, which compares it")
        found[name] = record
    return found


class Bench:
    """The drives of a machine whose buses fdhil runs; ``say`` gets a sentence per step. See :func:`on_bench`."""

    def __init__(
        self, plan: PlaybackPlan, loop: SyncCycle, masters: Sequence[Master], say: Callable[[str], None]
    ) -> None:
        self.plan, self.loop, self.masters, self._say = plan, loop, tuple(masters), say
        self._config = plan.config
        self._boots: dict[str, int] = {}

    # only SDO requests are sent

    def compare_drives(self, records: Mapping[str, CommissioningRecord]) -> None:
        """Listen and refuse another master; read every drive and refuse one that differs from its record."""
        self._say("listening: no NC may run the buses")
        for bus in self.loop.buses.values():
            listen_for_master(next(master for master in self.masters if master.bus is bus))
        self._say("comparing the drives with their commissioning records; no axis moves")
        for master in self.masters:
            self._boots[master.axis] = master.feedback.boots
            finding = compare_record(records[master.axis], survey_drive(master))
            require_no_fault(master, [finding])
            held = read_optional(master, master.profile.offset[0], master.profile.offset[1], signed=True)
            if held:
                text = f"it holds an offset (0x60B0) of {held} increments; run fdhil adopt before you move it"
                raise DriveFault(master.device, text)
        self._require_travel(records)
        self._require_equal_counters()

    def _require_travel(self, records: Mapping[str, CommissioningRecord]) -> None:
        for master, of in zip(self.masters, self.plan.bounds, strict=True):
            travel = records[master.axis].travel
            if travel is not None and not (travel[0] <= of.low and of.high <= travel[1]):
                low, high = sorted(self._convert_to_mm(master, limit) for limit in travel)
                axis = self._config.axis[master.axis]
                leave = f"{low / axis.mm_per_unit:g} to {axis.format_in_unit(high, form='g')}"
                text = f"its software limits (0x607D) allow {leave}, less than [axis.{master.axis}"
                raise DriveFault(master.device, f"{text}.setpoints] {axis.format_key('travel_mm')}; correct that")

    def _require_equal_counters(self) -> None:
        counters = {read_optional(master, Object.SYNC_COUNTER_OVERFLOW) or 0 for master in self.masters}
        if len(counters) > 1:
            shown = ", ".join(map(str, sorted(counters)))
            raise DriveFault("the drives", f"they need different SYNC counters (0x1019: {shown}); set all to one value")

    def find_axes_without_reboot(self) -> set[str]:
        """Return the axes whose drives have not booted since they were compared, while SYNC continues."""
        self.masters[0].wait_cycles(OFF_CYCLES)  # to receive every frame that others have received by now
        return {master.axis for master in self.masters if master.feedback.boots == self._boots[master.axis]}

    def read_positions(self) -> list[int]:
        """Read the present positions in increments."""
        return [master.sdo.read_int(*master.profile.position, signed=True) for master in self.masters]

    def compute_distance_to_start_mm(self, here: Sequence[int]) -> list[float]:
        """Return the distance of each axis from the first row."""
        first = self.plan.compute_set_points(here)[0]
        return [
            self._config.axis[master.axis].scaling.convert_to_mm(float(start) - at)
            for master, start, at in zip(self.masters, first, here, strict=True)
        ]

    def require_start(self, here: Sequence[int], go_to_start: bool) -> None:
        """Raise DriveFault if an axis is outside its travel, or away from the start without ``go_to_start``."""
        for master, at, away, of in zip(
            self.masters, here, self.compute_distance_to_start_mm(here), self.plan.bounds, strict=True
        ):
            if not of.low <= at <= of.high:
                position = self._format_position(master, self._convert_to_mm(master, at))
                text = f"its position is {position}, outside its travel; move it inside by hand"
                raise DriveFault(master.device, text)
            if abs(away) > NEAR_MM and not go_to_start:
                position, off = (
                    self._format_position(master, mm) for mm in (self._convert_to_mm(master, at), abs(away))
                )
                text = f"its position is {position}, {off} from the start of the demand"
                raise DriveFault(master.device, f"{text}; move it there, or use --go-to-start to move it there slowly")

    def _convert_to_mm(self, master: Master, increments: float) -> float:
        return self._config.axis[master.axis].scaling.convert_to_mm(increments)

    def _format_position(self, master: Master, mm: float) -> str:
        return self._config.axis[master.axis].format_in_unit(mm, form=".3f")

    # the drives are controlled

    @contextlib.contextmanager
    def hold_drives_enabled(self, written: Callable[[], None]) -> Iterator[None]:
        """Take over the bus and hold every drive in Operation enabled; at the end they are off and restored.

        ``written`` is called while SYNC runs, after 0x1016 was written and after it was restored: a guard that receives
        these writes considers the drives reconfigured.
        """
        node_id, beat_s = self._config.play.node_id, self._config.play.heartbeat_s
        with self._explain_bus_loss(), contextlib.ExitStack() as undo:
            undo.callback(self._leave_bus, written)
            for master in self.masters:
                undo.enter_context(self._report_failed_restore(watch_heartbeat(master, node_id, beat_s)))
            undo.callback(self._switch_drives_off)
            self._say("starting SYNC and switching the drives on at their present positions")
            for master in self.masters:
                prepare_drive(master)
            self.loop.heartbeat, self.loop.heartbeat_s = node_id, beat_s
            for master in self.masters:
                enable_drive(master)
            written()
            yield

    @contextlib.contextmanager
    def _explain_bus_loss(self) -> Iterator[None]:
        try:
            yield
        except DeviceError as error:
            if isinstance(error, ForeignMaster) or not self.loop.is_lost:
                raise
            what = "nothing more can be sent: drives stop by themselves when they miss fdhil's heartbeat (0x1016)"
            raise DeviceError(error.device, f"{str(error).removeprefix(f'{error.device}: ')}; {what}") from None

    def _leave_bus(self, written: Callable[[], None]) -> None:
        with ignore_interrupts():
            self.loop.heartbeat = None
            if self.loop.is_running and self.loop.foreign_master_bus is None:
                written()
            self.loop.stop_sync()

    @contextlib.contextmanager
    def _report_failed_restore(self, watching: contextlib.AbstractContextManager[None]) -> Iterator[None]:
        with contextlib.ExitStack() as undo:
            undo.enter_context(watching)
            try:
                yield
            finally:
                with ignore_interrupts():
                    try:
                        undo.close()
                    except DeviceError as error:
                        self._say(f"0x1016 could not be restored ({error}); power the drive off and on again")

    def _switch_drives_off(self) -> None:
        with (
            ignore_interrupts(),
            contextlib.suppress(DeviceError),
        ):  # of a bus that is gone: the cause has been reported
            if not self.loop.is_running:
                return
            self._await_zero_offsets()
            for word in OFF_WORDS:
                for master in self.masters:
                    master.controlword = word
                self.masters[0].wait_cycles(OFF_CYCLES)
            for master in self.masters:
                master.target = None
                master.send_nmt(NmtCommand.ENTER_PRE_OPERATIONAL)

    def _await_zero_offsets(self) -> None:
        end = time.monotonic() + LANDING_S
        while time.monotonic() < end and any(m.feedback.objects.get(m.profile.offset, 0) for m in self.masters):
            self.masters[0].wait_cycles(OFF_CYCLES)

    def go_to_start(self, signals: Signals, asked: bool) -> str | None:
        """Move slowly and straight to the first row; return why it was stopped on the way, None on arrival.

        DriveFault if an axis has moved away from the start meanwhile and ``asked`` is false.
        """
        here = [master.target or 0 for master in self.masters]
        self.require_start(here, asked)
        goal = self.plan.compute_set_points(here)[0]
        slow = [of.speed * APPROACH_SHARE for of in self.plan.bounds]
        gently = [of.acceleration * APPROACH_SHARE for of in self.plan.bounds]
        rows = plan_straight_move(here, goal.tolist(), slow, gently, APPROACH_CYCLES)
        return self._play_rows(rows, signals).stopped

    def play_demand(self, signals: Signals, begin: Callable[[], bool] = lambda: True) -> PlaybackResult:
        """Play the demand from the held positions as soon as ``begin`` returns true."""
        rows = self.plan.compute_set_points([master.target or 0 for master in self.masters])
        self.loop.lateness = Lateness()
        return self._play_rows(rows, signals, begin)

    def _play_rows(self, rows: Float, signals: Signals, begin: Callable[[], bool] = lambda: True) -> PlaybackResult:
        loop = self.loop
        with follow_path(self.masters, self.plan.bounds) as path, signals(path):
            while path.stopped is None and loop.is_running and not begin():
                self._watch_motion(path)
            path.play_rows(_iterate_in_blocks(rows))
            while not path.is_resting and loop.is_running:  # without a running cycle the rows would never end
                self._watch_motion(path)
            if path.stopped is None and loop.is_running:
                self.masters[0].wait_cycles(round(SETTLE_S / loop.period_s))
                watch_power(self.masters, path)
        played = PlaybackResult(path.played, len(rows), path.stopped, loop.lateness, loop.scheduling)
        try:
            loop.raise_if_failed()
        except ForeignMaster as error:
            return replace(played, stopped=str(error), left="")
        return played

    def _watch_motion(self, path: SetPointGenerator) -> None:
        with contextlib.suppress(ForeignMaster):  # the path was stopped
            self.loop.raise_if_failed()
        watch_power(self.masters, path)
        time.sleep(self.loop.period_s)


def _iterate_in_blocks(rows: Float) -> Iterator[list[float]]:
    """Yield the rows; converting a long program to lists at once would delay the cycle."""
    for first in range(0, len(rows), BLOCK_ROWS):
        yield from rows[first : first + BLOCK_ROWS].tolist()


@contextlib.contextmanager
def open_bench(plan: PlaybackPlan, say: Callable[[str], None], guard_runs: Callable[[], bool]) -> Iterator[Bench]:
    """Open the machine's buses and close them at the end; nothing is sent yet.

    Without a running guard, offsets count as another master's.
    """
    config = plan.config
    buses = dict.fromkeys(axis.drive.bus for axis in config.axis.values())
    loop = SyncCycle(config, buses, realtime=True, guard_runs=guard_runs)
    masters = [Master(config, name, loop) for name in config.axis]
    with loop:
        yield Bench(plan, loop, masters, say)
