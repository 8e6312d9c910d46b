"""Simulates a machine at frame level: NC and drives as the guard sees them, one SYNC at a time, no physics."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from fdhil.guard import guard_step
from fdhil.guard.corrected_path import CorrectedPath
from fdhil.guard.feedforward_law import Pair
from fdhil.guard.frame_monitor import FrameMonitor
from fdhil.guard.guard_protocol import Mode
from fdhil.guard.guard_settings import AxisSettings, GuardSettings, Pdo
from fdhil.guard.guard_state import GuardRequest, GuardState, StepInputs, StepOutput, make_initial_state
from fdhil.guard.interlocks import FACTS, Alarm
from fdhil.guard.offset_limits import OffsetLimits

Frame = tuple[int, bytes]
ENABLED = 0x1237
FACTS_GIVEN: Mapping[str, bool] = dict.fromkeys(FACTS, True)
DIGEST = "program-1"
RECORD = "as commissioned"
LIMITS = OffsetLimits(offset=819, rate=65, acceleration=6, variation=9830, window=1000)


def ramp_cycles(limits: OffsetLimits, offset: int) -> int:
    """Return the bound on the cycles from ``offset`` at any rate to standstill at 0: 1 + |o|/S + 3 S/A."""
    return 1 + -(-abs(offset) // limits.rate) + 3 * -(-limits.rate // limits.acceleration)


def axis_settings(name: str, node_id: int, limits: OffsetLimits = LIMITS) -> AxisSettings:
    return AxisSettings(
        name=name,
        node_id=node_id,
        target=Pdo(0x200 + node_id, ((0x6040, 0, 16, False), (0x607A, 0, 32, True))),
        offset=Pdo(0x300 + node_id, ((0x60B0, 0, 32, True),)),
        tpdos=(
            Pdo(0x180 + node_id, ((0x6064, 0, 32, True), (0x606C, 0, 32, True))),
            Pdo(0x280 + node_id, ((0x6041, 0, 16, False), (0x6078, 0, 16, True), (0x2101, 0, 16, True))),
            Pdo(0x380 + node_id, ((0x6062, 0, 32, True), (0x60B0, 0, 32, True)), 10),
            Pdo(0x480 + node_id, ((0x60FD, 0, 32, False), (0x6061, 0, 8, True), (0x6077, 0, 16, True)), 10),
        ),
        increments_per_mm=3276.8,
        max_speed_mm_s=500.0,
        max_acceleration_mm_s2=4000.0,
        sign=1,
        limits=limits,
        window=32768,
        setpoint_delay_cycles=2,
        record=RECORD,
    )


def settings(axes: Sequence[str] = ("X", "Y"), limits: OffsetLimits = LIMITS, **changes: object) -> GuardSettings:
    made = GuardSettings(
        bus="can0",
        transport="socketcand",
        sync_period_s=0.001,
        clock="sync",
        heartbeat_s=0.020,
        node_id=100,
        token_sha256="",
        run_directory="",
        axes=tuple(axis_settings(name, k + 1, limits) for k, name in enumerate(axes)),
    )
    return replace(made, **changes)  # type: ignore[arg-type] # any field of Settings


def commissioned(made: GuardSettings) -> GuardSettings:
    return replace(made, axes=tuple(replace(axis, record=RECORD) for axis in made.axes))


@dataclass
class Drive:
    """State of a drive; ``answers`` False: it is silent; ``scale`` 0: it ignores its offset.

    ``remapped``: TPDO 380 carries its two objects in reverse order; ``shows_offset`` False: it is not sent. ``fed`` are
    the speed and torque offset in force, sent in TPDO 1A0 when ``shows_fed``; ``takes_fed`` maps a received pair to
    them.
    """

    node_id: int
    statusword: int = ENABLED
    mode: int = 8
    offset: int = 0
    position_error: int = 0
    answers: bool = True
    scale: float = 1.0
    target: int = 0
    received_target: int = 0
    received_offset: int | None = None
    fed: Pair = (0, 0)
    received_fed: Pair | None = None
    shows_fed: bool = False
    remapped: bool = False
    shows_offset: bool = True
    takes_fed: Callable[[Pair], Pair] = lambda pair: pair
    followed: int | None = None
    queue: list[tuple[int, int]] = field(default_factory=list)

    def hold(self, offset: int) -> None:
        self.offset = self.received_offset = offset
        self.queue = [(target, offset) for target, _ in self.queue]

    def at_sync(self, tick: int) -> list[Frame]:
        self.target = self.received_target
        if self.received_offset is not None:
            self.offset, self.received_offset = round(self.received_offset * self.scale), None
        if self.received_fed is not None:
            self.fed = self.takes_fed(self.received_fed)
        self.queue = [*self.queue, (self.target, self.offset)][-3:]
        if not self.answers:
            return []
        followed, before = sum(self.queue[0]), self.followed
        self.followed = followed
        speed = 0 if before is None else max(-(2**31), min((followed - before) * 1000, 2**31 - 1))
        n = self.node_id
        frames = [
            (0x180 + n, struct.pack("<ii", followed - self.position_error, speed)),
            (0x280 + n, struct.pack("<Hhh", self.statusword, 0, 0)),
        ]
        if self.shows_fed:
            frames.append((0x1A0 + n, struct.pack("<ih", *self.fed)))
        if tick % 10 == 0:
            shown = (self.offset, followed) if self.remapped else (followed, self.offset)
            if self.shows_offset:
                frames.append((0x380 + n, struct.pack("<ii", *shown)))
            frames.append((0x480 + n, struct.pack("<Ibh", 0, self.mode, 0)))
        return frames


@dataclass
class Bench:
    """Drives, the NC's stream of targets, and the guard's core with its frame monitor; ``frames`` is the bus trace.

    ``held`` are the drives' true offsets at each SYNC. ``row`` is the next demand row of the NC; before ``playing`` it
    stays at row 0.
    """

    settings: GuardSettings
    path: CorrectedPath | None = None
    demand: Sequence[Sequence[int]] = ()
    drives: list[Drive] = field(default_factory=list)
    state: GuardState = field(init=False)
    listener: FrameMonitor = field(init=False)
    tick: int = 0
    playing: bool = False
    row: int = 0
    main_alive: bool = True
    frames: list[tuple[int, tuple[int, ...]]] = field(default_factory=list)
    held: list[tuple[int, ...]] = field(default_factory=list)
    heartbeats: list[int] = field(default_factory=list)
    alarms: list[Alarm] = field(default_factory=list)
    outputs: list[StepOutput] = field(default_factory=list)
    counter: int = 0
    rest: list[int] | None = None

    def __post_init__(self) -> None:
        self.state = make_initial_state(self.settings)
        self.listener = FrameMonitor(self.settings)
        if not self.drives:
            self.drives = [Drive(axis.node_id) for axis in self.settings.axes]
        if not self.demand:
            self.demand = [[0] for _ in self.drives]
        self.stream()

    @property
    def mode(self) -> Mode:
        return self.state.mode

    @property
    def offsets(self) -> tuple[int, ...]:
        return tuple(axis.offset for axis in self.state.axes)

    def targets(self) -> list[int]:
        if self.rest is not None:
            return self.rest
        last = len(self.demand[0]) - 1
        return [column[min(self.row, last)] for column in self.demand]

    def stream(self) -> None:
        for drive, target in zip(self.drives, self.targets(), strict=True):
            drive.received_target = target
            self.receive_frames(0x200 + drive.node_id, struct.pack("<Hi", 0x0F, target))
        if self.playing:
            self.row += 1

    def receive_frames(self, cob_id: int, data: bytes) -> None:
        self.listener.take_frame(cob_id, data, self.tick * 1e-3)

    def to_zero(self, since_tick: int) -> int:
        """Return how many SYNC after ``since_tick`` the first zero frames of every axis left, by the bus trace."""
        return next(tick for tick, offsets in self.frames if tick > since_tick and not any(offsets)) - since_tick

    def inject_frame(self, cob_id: int, data: bytes) -> None:
        self.receive_frames(cob_id, data)
        for drive in self.drives:
            if cob_id == 0x300 + drive.node_id and len(data) >= 4:
                drive.received_offset = int.from_bytes(data[:4], "little", signed=True)
            elif cob_id == 0x600 + drive.node_id and data[:4] == b"\x23\xb0\x60\x00" and len(data) == 8:
                drive.received_offset = int.from_bytes(data[4:], "little", signed=True)

    def reboot(self, number: int) -> None:
        drive = self.drives[number]
        drive.hold(0)
        drive.received_offset = None
        self.receive_frames(0x700 + drive.node_id, b"\0")

    def run_sync(
        self,
        request: GuardRequest | None = None,
        *,
        late: bool = False,
        unsent: Sequence[int] = (),
        nc: bool = True,
        drop: Sequence[int] = (),
    ) -> StepOutput:
        """Run one SYNC: drives latch and sample, the guard steps and sends, then the NC streams.

        ``unsent``: axes whose frames of the previous step did not leave.
        """
        if unsent and self.outputs and self.outputs[-1].offsets is not None:
            tick, offsets = self.frames.pop()
            for k in unsent:
                self.drives[k].received_offset = None
            if len(unsent) < len(self.drives) and self.frames:
                before = self.frames[-1][1]
                self.frames.append((tick, tuple([before[k] if k in unsent else o for k, o in enumerate(offsets)])))
        self.tick += 1
        self.counter = self.counter % 240 + 1
        sampled = [frame for drive in self.drives for frame in drive.at_sync(self.tick)]
        self.held.append(tuple([drive.offset for drive in self.drives]))
        axes, bus = self.listener.receive_at_sync(bytes([self.counter]), self.tick * 1e-3, self.tick * 1e-3)
        inputs = StepInputs(
            True,
            axes,
            bus,
            late,
            tuple(unsent),
            tuple(unsent),
            self.main_alive,
            self.listener.take_alarms(),
            path=self.path,
            request=request,
        )
        output = self.decide_and_check(inputs)
        for cob_id, data in sampled:
            if cob_id not in drop:
                self.receive_frames(cob_id, data)
        if nc:
            self.stream()
        return output

    def decide_and_check(self, inputs: StepInputs) -> StepOutput:
        self.state, output = guard_step.step_guard(self.state, inputs, self.settings)
        self.outputs.append(output)
        if output.offsets is not None:
            self.frames.append((self.tick, output.offsets))
            for drive, offset in zip(self.drives, output.offsets, strict=True):
                drive.received_offset = offset
        if output.feed is not None:
            for drive, pair in zip(self.drives, output.feed, strict=True):
                drive.received_fed = pair
        if output.heartbeat:
            self.heartbeats.append(self.tick)
        if output.transition is not None and output.transition[2] is not None:
            self.alarms.append(output.transition[2])
        return output

    def silence(self) -> StepOutput:
        axes, bus = self.listener.read_between_syncs(self.tick * 1e-3, True)
        return self.decide_and_check(StepInputs(False, axes, bus, main_alive=self.main_alive, path=self.path))

    def settle(self, cycles: int = 130) -> None:
        for _ in range(cycles):
            self.run_sync()

    def arm(self) -> tuple[Alarm, ...]:
        refused = self.run_sync(arm_request()).refused
        assert refused is not None
        return refused

    def run(self, cycles: int) -> None:
        for _ in range(cycles):
            self.run_sync()

    def play(self) -> None:
        self.playing = True

    def run_until(self, mode: Mode, limit: int = 2000) -> int:
        """Step until the guard is in ``mode``; return the number of SYNC."""
        for taken in range(limit):
            if self.mode is mode:
                return taken
            self.run_sync()
        raise AssertionError(f"still {self.mode} after {limit} SYNC")


def arm_request(**changes: object) -> GuardRequest:
    return replace(GuardRequest("arm", True, DIGEST, FACTS_GIVEN), **changes)  # type: ignore[arg-type] # fields of Request


def smooth_path(
    rows: int = 600, rest: int = 40, amplitude: int = 300, axes: int = 2
) -> tuple[list[list[int]], list[list[int]]]:
    demand: list[list[int]] = []
    offset: list[list[int]] = []
    for axis in range(axes):
        positions, speed, at = [], 0.0, 1000.0 * axis
        for k in range(rows):
            positions.append(round(at))
            moving = rest <= k < rows - rest
            braking = k > rows - rest - 100
            speed = max(0.0, min(500.0, speed + (-6.0 if braking else 6.0))) if moving else 0.0
            at += speed * (1.0 if axis == 0 else 0.5)
        demand.append(positions)
        offset.append(
            [
                _increment_touch_count(k, rest + 20, rows - rest - 20, amplitude * (1 if axis == 0 else -1))
                for k in range(rows)
            ]
        )
    return demand, offset


def _increment_touch_count(k: int, begin: int, end: int, amplitude: int) -> int:
    import math

    if not begin <= k < end:
        return 0
    return round(amplitude * 0.5 * (1 - math.cos(2 * math.pi * (k - begin) / (end - begin))))


def bench(amplitude: int = 300, **changes: object) -> Bench:
    made = settings(**changes)  # type: ignore[arg-type] # fields of Settings
    demand, offset = smooth_path(amplitude=amplitude, axes=len(made.axes))
    path = CorrectedPath(0, tuple(demand), tuple(offset), True, DIGEST, 1)
    drives = [Drive(axis.node_id) for axis in made.axes]
    for drive, column in zip(drives, demand, strict=True):
        drive.queue = [(column[0], 0)] * 2
    return Bench(made, path, demand, drives)


DEMAND_AT_REST = [[0] * 3, [0] * 3]
