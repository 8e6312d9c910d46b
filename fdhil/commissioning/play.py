"""Plays a demand to the drives of a test bench that has no NC: fdhil is the NC for as long as it lasts.

It produces SYNC, is the NMT master and streams the set-points (0x607A) in cyclic synchronous position. Everything is
checked before anything is sent, and whatever ends it, the axes are braked, the drives switched off and what was written
is given back. A correction by the guard works beside it: the offsets (0x60B0) are the guard's alone.
"""

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fdhil.cia402 import NmtCommand, Object
from fdhil.commissioning.compare import compare_record
from fdhil.commissioning.cycle import Cycle, Lateness
from fdhil.commissioning.finding import read_optional
from fdhil.commissioning.landing import OFF_WORDS
from fdhil.commissioning.master import Master
from fdhil.commissioning.moving import following, undisturbed, watch_power
from fdhil.commissioning.record import CommissioningRecord, load_record, of_config
from fdhil.commissioning.set_points import Bounds, SetPoints, straight
from fdhil.commissioning.steps import enable, prepare
from fdhil.commissioning.survey import listen, require, survey
from fdhil.commissioning.void import is_void
from fdhil.commissioning.watchdog import watched
from fdhil.config import MachineConfig
from fdhil.errors import ConfigError, ConfigFault, DeviceError, DriveFault, ForeignMaster
from fdhil.records import Float, Trajectory

NEAR_MM = 0.05  # a start no farther away is gone to without being asked
APPROACH_SHARE = 0.1  # of the speed an axis may have, on the way to the start
APPROACH_CYCLES = 50
SETTLE_S = 0.3  # rest after the last row: the drives run their set-points late
LANDING_S = 3.0  # a guard that ramps to zero needs less
OFF_CYCLES = 20
BLOCK_ROWS = 256
Signals = Callable[[SetPoints], contextlib.AbstractContextManager[None]]
"""Has Ctrl-C and its like stop a path, instead of raising."""


@dataclass(frozen=True, slots=True)
class Played:
    """What was played: rows of all, why it ended early (None: it did not), how late SYNC was, how it was scheduled.

    ``left`` says how the drives were left, empty where ``stopped`` does.
    """

    rows: int
    of: int
    stopped: str | None
    lateness: Lateness
    scheduling: str
    left: str = "braked, the drives are off"


@dataclass(frozen=True, slots=True)
class Plan:
    """A demand as increments for every axis of the machine; an axis that it does not name stays where it stands."""

    config: MachineConfig
    trajectory: Trajectory
    bounds: tuple[Bounds, ...]

    @property
    def axes(self) -> tuple[str, ...]:
        """The machine's axes."""
        return tuple(self.config.axis)

    def rows(self, here: Sequence[int]) -> Float:
        """Return the set-points (n, axes) in increments; ``here`` is where the axes stand."""
        position, count = self.trajectory.position_mm, self.trajectory.time_s.size
        columns = []
        for axis, at in zip(self.axes, here, strict=True):
            scaling = self.config.axis[axis].scaling
            per_mm = scaling.sign * scaling.increments_per_mm
            columns.append(position[axis] * per_mm if axis in position else np.full(count, float(at)))
        return np.column_stack(columns)


def plan_play(config: MachineConfig, trajectory: Trajectory, source: str) -> Plan:
    """Check a demand against [axis.*.setpoints]; ConfigError without that section, DriveFault for the first row out."""
    lacking = [name for name, axis in config.axis.items() if axis.setpoints is None]
    if lacking:
        faults = [
            ConfigFault(f"axis.{name}.setpoints", "fdhil may send this axis no set-points", "give it its travel_mm")
            for name in lacking
        ]
        raise ConfigError(source, faults)
    bounds = []
    for name, axis in config.axis.items():
        assert axis.setpoints is not None
        travel, speed = axis.setpoints.travel_mm, axis.setpoints.max_speed_mm_s
        bounds.append(Bounds.of(name, axis, config.machine.sync_period_s, travel, speed))
    plan = Plan(config, trajectory, tuple(bounds))
    _require_inside(plan)
    return plan


def _require_inside(plan: Plan) -> None:
    """Send the rows nowhere and see whether one is stopped."""
    middle = [round((of.low + of.high) / 2) for of in plan.bounds]
    rows = plan.rows(middle)
    points = SetPoints(plan.bounds, rows[0].round().astype(int).tolist())
    points.play(rows.tolist())
    while not points.resting and points.stopped is None:
        points.step()
    if points.stopped is not None:
        row = min(points.played, len(rows) - 1)
        where = f"{plan.trajectory.time_s[row]:.3f} s, {plan.trajectory.place(row)}"
        advice = "nothing was sent; change the program, or [axis.*.setpoints] where the machine has room for it"
        raise DriveFault("the demand", f"{points.stopped} (row {row + 1}, {where}); {advice}")


def valid_records(config: MachineConfig) -> dict[str, CommissioningRecord]:
    """Return the record of every axis; DriveFault where one is missing, void, or of another set-up."""
    found = {}
    for name in config.axis:
        record = load_record(config.store.directory, name, config.store.commissioning_key)
        if record is None or not of_config(record, config, name) or record.watchdog != "proven":
            what = "it is not commissioned with this configuration"
            raise DriveFault(f"drive {name}", f"{what}, and nothing was sent; run fdhil commission --axis {name}")
        if is_void(config.store.directory, name):
            what = "it was set up anew or has rebooted since it was commissioned"
            raise DriveFault(f"drive {name}", f"{what}, and nothing was sent; run fdhil check, which compares it")
        found[name] = record
    return found


class Bench:
    """The drives of a machine whose buses fdhil runs: ``say`` gets a sentence per step. See :func:`on_bench`."""

    def __init__(self, plan: Plan, loop: Cycle, masters: Sequence[Master], say: Callable[[str], None]) -> None:
        self.plan, self.loop, self.masters, self._say = plan, loop, tuple(masters), say
        self._config = plan.config
        self._boots: dict[str, int] = {}

    # nothing is sent but SDO requests

    def compare(self, records: Mapping[str, CommissioningRecord]) -> None:
        """Listen, and refuse another master; read every drive, and refuse one that is not as it was signed off."""
        self._say("listening: no NC may run the buses")
        for bus in self.loop.buses.values():
            listen(next(master for master in self.masters if master.bus is bus))
        self._say("comparing the drives with their commissioning records; nothing moves")
        for master in self.masters:
            self._boots[master.axis] = master.heard.boots
            finding = compare_record(records[master.axis], survey(master))
            require(master, [finding])
            held = read_optional(master, master.profile.offset[0], master.profile.offset[1], signed=True)
            if held:
                text = f"it holds an offset (0x60B0) of {held} increments; run fdhil adopt before anything moves"
                raise DriveFault(master.device, text)
        self._require_room(records)
        self._require_one_counter()

    def _require_room(self, records: Mapping[str, CommissioningRecord]) -> None:
        for master, of in zip(self.masters, self.plan.bounds, strict=True):
            travel = records[master.axis].travel
            if travel is not None and not (travel[0] <= of.low and of.high <= travel[1]):
                low, high = sorted(self._mm(master, limit) for limit in travel)
                axis = self._config.axis[master.axis]
                leave = f"{low / axis.mm_per_unit:g} to {axis.shown(high, form='g')}"
                text = f"its software limits (0x607D) leave it {leave}, less than [axis.{master.axis}"
                raise DriveFault(master.device, f"{text}.setpoints] {axis.shown_key('travel_mm')}; correct that")

    def _require_one_counter(self) -> None:
        counters = {read_optional(master, Object.SYNC_COUNTER_OVERFLOW) or 0 for master in self.masters}
        if len(counters) > 1:
            shown = ", ".join(map(str, sorted(counters)))
            raise DriveFault("the drives", f"they want different SYNC counters (0x1019: {shown}); set all to one value")

    def as_compared(self) -> set[str]:
        """Return the axes whose drives have not booted since they were compared, while SYNC goes on."""
        self.masters[0].wait_cycles(OFF_CYCLES)  # so that what others have heard by now is heard here too
        return {master.axis for master in self.masters if master.heard.boots == self._boots[master.axis]}

    def here(self) -> list[int]:
        """Read where the axes stand, in increments."""
        return [master.sdo.read_int(*master.profile.position, signed=True) for master in self.masters]

    def away_mm(self, here: Sequence[int]) -> list[float]:
        """How far each axis is from the first row."""
        first = self.plan.rows(here)[0]
        return [
            self._config.axis[master.axis].scaling.to_mm(float(start) - at)
            for master, start, at in zip(self.masters, first, here, strict=True)
        ]

    def require_start(self, here: Sequence[int], go_to_start: bool) -> None:
        """DriveFault where an axis is outside its travel, or not at the start and nobody said that it may go there."""
        for master, at, away, of in zip(self.masters, here, self.away_mm(here), self.plan.bounds, strict=True):
            if not of.low <= at <= of.high:
                stands = self._shown(master, self._mm(master, at))
                text = f"it stands at {stands}, outside its travel; bring it inside by hand"
                raise DriveFault(master.device, text)
            if abs(away) > NEAR_MM and not go_to_start:
                stands, off = (self._shown(master, mm) for mm in (self._mm(master, at), abs(away)))
                text = f"it stands at {stands}, {off} from the start of the demand"
                raise DriveFault(master.device, f"{text}; move it there, or let it go there slowly with --go-to-start")

    def _mm(self, master: Master, increments: float) -> float:
        return self._config.axis[master.axis].scaling.to_mm(increments)

    def _shown(self, master: Master, mm: float) -> str:
        return self._config.axis[master.axis].shown(mm, form=".3f")

    # the drives are led

    @contextlib.contextmanager
    def led(self, written: Callable[[], None]) -> Iterator[None]:
        """Take the bus over and hold every drive in Operation enabled; at the end they are off and as they were.

        ``written`` is called while SYNC goes on when 0x1016 was written and when it was given back: a guard that heard
        it takes the drives for set up anew.
        """
        node_id, beat_s = self._config.play.node_id, self._config.play.heartbeat_s
        with self._bus_loss_told(), contextlib.ExitStack() as undo:
            undo.callback(self._leave_bus, written)
            for master in self.masters:
                undo.enter_context(self._given_back(watched(master, node_id, beat_s)))
            undo.callback(self._switch_off)
            self._say("starting SYNC and switching the drives on, held where they stand")
            for master in self.masters:
                prepare(master)
            self.loop.heartbeat, self.loop.heartbeat_s = node_id, beat_s
            for master in self.masters:
                enable(master)
            written()
            yield

    @contextlib.contextmanager
    def _bus_loss_told(self) -> Iterator[None]:
        try:
            yield
        except DeviceError as error:
            if isinstance(error, ForeignMaster) or not self.loop.lost:
                raise
            what = "nothing more can be sent: a drive that is on stops by itself when it misses our heartbeat (0x1016)"
            raise DeviceError(error.device, f"{str(error).removeprefix(f'{error.device}: ')}; {what}") from None

    def _leave_bus(self, written: Callable[[], None]) -> None:
        with undisturbed():
            self.loop.heartbeat = None
            if self.loop.turning and self.loop.taken is None:
                written()
            self.loop.stop_sync()

    @contextlib.contextmanager
    def _given_back(self, watching: contextlib.AbstractContextManager[None]) -> Iterator[None]:
        """What cannot be given back, for the bus is gone, is told and hides nothing else."""
        with contextlib.ExitStack() as undo:
            undo.enter_context(watching)
            try:
                yield
            finally:
                with undisturbed():
                    try:
                        undo.close()
                    except DeviceError as error:
                        self._say(f"0x1016 could not be given back ({error}); power the drive off and on again")

    def _switch_off(self) -> None:
        """Wait until a guard has taken its offsets away, then take the power off, step by step."""
        with undisturbed(), contextlib.suppress(DeviceError):  # of a bus that is gone: what went wrong is told already
            if not self.loop.turning:
                return
            self._await_landing()
            for word in OFF_WORDS:
                for master in self.masters:
                    master.controlword = word
                self.masters[0].wait_cycles(OFF_CYCLES)
            for master in self.masters:
                master.target = None
                master.nmt(NmtCommand.ENTER_PRE_OPERATIONAL)

    def _await_landing(self) -> None:
        end = time.monotonic() + LANDING_S
        while time.monotonic() < end and any(m.heard.objects.get(m.profile.offset, 0) for m in self.masters):
            self.masters[0].wait_cycles(OFF_CYCLES)

    def go_to_start(self, signals: Signals, asked: bool) -> str | None:
        """Go slowly and straight to the first row; why it was stopped on the way, None when it is there.

        DriveFault where an axis has moved away from it meanwhile and nobody ``asked`` that it goes there.
        """
        here = [master.target or 0 for master in self.masters]
        self.require_start(here, asked)
        goal = self.plan.rows(here)[0]
        slow = [of.speed * APPROACH_SHARE for of in self.plan.bounds]
        gently = [of.acceleration * APPROACH_SHARE for of in self.plan.bounds]
        rows = straight(here, goal.tolist(), slow, gently, APPROACH_CYCLES)
        return self._played(rows, signals).stopped

    def play(self, signals: Signals, begin: Callable[[], bool] = lambda: True) -> Played:
        """Play the demand from where the axes are held, as soon as ``begin`` is true."""
        rows = self.plan.rows([master.target or 0 for master in self.masters])
        self.loop.lateness = Lateness()
        return self._played(rows, signals, begin)

    def _played(self, rows: Float, signals: Signals, begin: Callable[[], bool] = lambda: True) -> Played:
        loop = self.loop
        with following(self.masters, self.plan.bounds) as path, signals(path):
            while path.stopped is None and loop.turning and not begin():
                self._watch(path)
            path.play(_in_blocks(rows))
            while not path.resting and loop.turning:  # rows that nobody sends any more never end
                self._watch(path)
            if path.stopped is None and loop.turning:
                self.masters[0].wait_cycles(round(SETTLE_S / loop.period_s))
                watch_power(self.masters, path)
        played = Played(path.played, len(rows), path.stopped, loop.lateness, loop.scheduling)
        try:
            loop.check()
        except ForeignMaster as error:
            return replace(played, stopped=str(error), left="")
        return played

    def _watch(self, path: SetPoints) -> None:
        with contextlib.suppress(ForeignMaster):  # the path was stopped
            self.loop.check()
        watch_power(self.masters, path)
        time.sleep(self.loop.period_s)


def _in_blocks(rows: Float) -> Iterator[list[float]]:
    """Yield the rows; a long program is not turned into a million lists at once, which no cycle would wait for."""
    for first in range(0, len(rows), BLOCK_ROWS):
        yield from rows[first : first + BLOCK_ROWS].tolist()


@contextlib.contextmanager
def on_bench(plan: Plan, say: Callable[[str], None], guard_runs: Callable[[], bool]) -> Iterator[Bench]:
    """Open the buses of the machine; nothing is sent yet, and at the end everything is closed.

    Offsets are those of another master where no guard runs.
    """
    config = plan.config
    buses = dict.fromkeys(axis.drive.bus for axis in config.axis.values())
    loop = Cycle(config, buses, realtime=True, guard_runs=guard_runs)
    masters = [Master(config, name, loop) for name in config.axis]
    with loop:
        yield Bench(plan, loop, masters, say)
