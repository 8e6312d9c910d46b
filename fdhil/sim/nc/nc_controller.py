"""Simulates the NC, sans-I/O: it produces SYNC, is the NMT master, enables the drives and streams set-points.

Between SYNC k-1 and SYNC k it sends r[k+delay] by RPDO (controlword, target position), so that the drive, which
executes its set-point ``delay`` cycles late, follows r[k] at SYNC k. All its times are counted in SYNC cycles.
"""

from collections import deque
from collections.abc import Callable
from enum import Enum, auto
from typing import Any

import numpy as np

from fdhil.config import MachineConfig
from fdhil.records import Trajectory
from fdhil.sim.drive.power_stage import PowerState
from fdhil.sim.frame_types import BusFrame, Frame
from fdhil.sim.nc.demand_stream import DemandStream
from fdhil.sim.nc.drive_link import ENABLED, SHUTDOWN, DriveLink, PdoWiring, SdoWrite
from fdhil.sim.nc.nc_path import PathRate, PathRow, PathStage, Pause, PlayJob, RowPlayer, plan_rapid_rows

Event = dict[str, Any]

COUNTER_OVERFLOW = 240
TAIL_S = 0.3  # rest after the last row, part of the played file
_SETTLE_S = 0.3  # rest between the rapid and the first row
_ANSWER_S = 1.0
_ENABLE_S = 3.0
_RELEASE_CYCLES = 3
_MAX_OVERRIDE = 1.5


class NcPhase(Enum):
    OFF = auto()
    CONFIGURE = auto()
    ENABLE = auto()
    READY = auto()
    FAULTED = auto()
    RELEASE = auto()


class NcController:
    """The NC of one machine. ``events`` collects its events; the caller takes them out.

    Each period: send the frames of :meth:`begin`, pass the drives' answers to :meth:`hear`, then send the frames of
    :meth:`end`. ``wiring`` returns the PDO mapping of an axis' drive; it is called at each takeover. ``in_force`` is
    the row r[k] of the SYNC that :meth:`begin` returned last, None while there is none.
    """

    def __init__(self, config: MachineConfig, wiring: Callable[[str], PdoWiring]) -> None:
        period = config.machine.sync_period_s
        self.axes = tuple(config.axis)
        self.events: list[Event] = []
        self.in_force: PathRow | None = None
        self.phase = NcPhase.OFF
        self._period_s = period
        self._smoothing_s = config.nc.smoothing_s
        self._speeds = [axis.rapid_speed_mm_s for axis in config.axis.values()]
        self._accelerations = [axis.max_acceleration_mm_s2 for axis in config.axis.values()]
        self._links = [
            DriveLink(
                name,
                axis.drive.bus,
                config.get_node_id(name),
                axis.drive.sign * axis.drive.increments_per_rev / axis.screw_pitch_mm,
                axis.drive.setpoint_delay_cycles,
            )
            for name, axis in config.axis.items()
        ]
        self._wiring = wiring
        self._by_node = {(link.bus, link.node_id): link for link in self._links}
        self._by_answer: dict[tuple[str, int], DriveLink] = {}
        self._buses = list(dict.fromkeys(link.bus for link in self._links))
        self._delay = max(link.delay for link in self._links)
        slope = min(a / v for a, v in zip(self._accelerations, self._speeds, strict=True))
        self._rate = PathRate(min(slope, 0.5 / period), period)
        self._rows: deque[PathRow] = deque(maxlen=self._delay + 1)
        self._stages: deque[PathStage] = deque()
        self._requests: deque[SdoWrite] = deque()
        self._job: PlayJob | None = None
        self._position = [0.0] * len(self._links)
        self._counter = 0
        self._waited = 0
        self._played = 0
        self._hold = self._stopping = self._leaving = self._given_up = False
        self.override = 1.0

    def switch_on_off(self, on: bool) -> None:
        """Take over the bus and enable the drives; or come to rest, disable them and release the bus."""
        if on and self.phase in (NcPhase.OFF, NcPhase.FAULTED):
            self._take_over()
        elif on and self.phase is NcPhase.READY:
            self.events.append({"event": "nc", "on": True})
        elif not on and self.phase is NcPhase.OFF:
            self.events.append({"event": "nc", "on": False})
        elif not on:
            self._leaving = True
            self.stop_path()

    def play_demand(self, file: str, demand: Trajectory | DemandStream) -> None:
        """Move to the demand's start in a rapid, then play it; an event reports why it cannot be played.

        A stream starts once it has enough rows, and may end before.
        """
        job = PlayJob(file, demand)
        if refusal := self._explain_refusal(job):
            self._report_error(f"{file} cannot be played: {refusal}")
            return
        self._job = job
        self._played, self._given_up = 0, False
        if self.phase is NcPhase.READY:
            self._start_job()

    def stop_path(self) -> None:
        """Decelerate along the path and abandon the rest of it."""
        if self._stages:
            self._stopping = True
        elif self._awaits_rows and self.phase is NcPhase.READY:
            self._given_up = True
        elif self._job is not None and self.phase is not NcPhase.READY:
            self._job = None

    def set_feed_hold(self, on: bool) -> None:
        """Decelerate along the path and hold; continue when it is released."""
        self._hold = on

    def set_override(self, percent: float) -> None:
        """Set the rate along the path, 0 to 150 %; ValueError outside."""
        if not 0 <= percent <= 100 * _MAX_OVERRIDE:
            raise ValueError(f"an override is 0 to {100 * _MAX_OVERRIDE:g} %, not {percent:g}")
        self.override = percent / 100

    @property
    def is_busy(self) -> bool:
        """Whether it plays, is about to, or is taking over."""
        return bool(self._stages) or self._job is not None or self.phase in (NcPhase.CONFIGURE, NcPhase.ENABLE)

    @property
    def is_stopping(self) -> bool:
        """Whether it decelerates to abandon the rest of a path."""
        return self.is_on and (self._stopping or (self._given_up and self._job is not None))

    @property
    def is_on(self) -> bool:
        return self.phase is not NcPhase.OFF

    def _explain_refusal(self, job: PlayJob) -> str:
        if self._leaving or self.phase in (NcPhase.OFF, NcPhase.FAULTED, NcPhase.RELEASE):
            return "the NC does not control the drives; switch it on first"
        if self._job is not None:
            return f"{self._job.file} is being played; stop it first"
        return job.explain_refusal(self.axes, self._period_s)

    def begin_cycle(self) -> list[BusFrame]:
        """Return the SYNC of this period, one frame per bus; none while the drives are being configured."""
        if self.phase in (NcPhase.OFF, NcPhase.CONFIGURE):
            return []
        self._counter = self._counter % COUNTER_OVERFLOW + 1
        for link in self._links:
            link.silent += 1
        before = self.in_force
        self.in_force = self._rows[0] if len(self._rows) > self._delay else None
        self._report_progress(before, self.in_force)
        return [(bus, (0x80, bytes([self._counter]))) for bus in self._buses]

    def receive_frame(self, bus: str, frame: Frame) -> None:
        """Process a frame of a drive: the TPDOs it is wired to, SDO answers."""
        can_id, data = frame
        link = self._by_answer.get((bus, can_id))
        if link is not None:
            link.receive_tpdo(can_id, data)
        elif can_id & ~0x7F == 0x580 and len(data) == 8 and (bus, can_id & 0x7F) in self._by_node:
            self._receive_sdo_answer(self._by_node[bus, can_id & 0x7F], data)

    def end_cycle(self) -> list[BusFrame]:
        """Return the frames after this period's SYNC: the next set-points, or the steps of a takeover."""
        match self.phase:
            case NcPhase.OFF:
                return []
            case NcPhase.CONFIGURE:
                return self._configure_drives()
            case NcPhase.ENABLE:
                return self._enable_drives()
            case NcPhase.RELEASE:
                return self._release_drives()
        return self._send_setpoints()

    def _take_over(self) -> None:
        self.phase = NcPhase.CONFIGURE
        self._leaving = self._stopping = False
        self._counter = self._waited = 0
        self._rows.clear()
        self._requests.clear()
        for link in self._links:
            link.status = link.position = None
            link.word = SHUTDOWN
            wiring = self._wiring(link.axis)
            self._requests.append(SdoWrite(link, 0x1019, COUNTER_OVERFLOW, required=False))
            self._requests.append(SdoWrite(link, wiring.mode_index, wiring.mode, required=True))

    def _build_nmt_frames(self, command: int) -> list[BusFrame]:
        return [(link.bus, (0x000, bytes([command, link.node_id]))) for link in self._links]

    def _configure_drives(self) -> list[BusFrame]:
        frames = self._build_nmt_frames(0x80) if self._waited == 0 else []
        self._waited += 1
        if not self._requests:
            return self._start_nodes()
        request = self._requests[0]
        if not request.sent:
            request.sent = True
            frames.append(request.frame)
        request.cycles += 1
        if request.cycles * self._period_s > _ANSWER_S:
            self._abort_takeover(f"drive {request.link.axis} does not respond: the NC stays off. Check its supply")
        return frames

    def _start_nodes(self) -> list[BusFrame]:
        for link in self._links:
            link.wiring = self._wiring(link.axis)
            if link.wiring.missing:
                what = " and ".join(link.wiring.missing)
                self._abort_takeover(
                    f"drive {link.axis} maps {what} in no PDO: the NC stays off. Map it (0x1400 to 0x1BFF)"
                )
                return []
        self._by_answer = {(link.bus, pdo.cob_id): link for link in self._links for pdo in link.wiring.answers}
        self.phase, self._waited = NcPhase.ENABLE, 0
        return self._build_nmt_frames(0x01)

    def _receive_sdo_answer(self, link: DriveLink, data: bytes) -> None:
        if not self._requests or not self._requests[0].sent or self._requests[0].link is not link:
            return
        request = self._requests[0]
        if int.from_bytes(data[1:3], "little") != request.index:
            return
        self._requests.popleft()
        if data[0] == 0x80 and request.required:
            code = int.from_bytes(data[4:], "little")
            self._abort_takeover(
                f"drive {link.axis} refuses {request.index:04X} = {request.value} with SDO abort {code:08X}: NC off"
            )

    def _abort_takeover(self, text: str) -> None:
        self._report_error(text)
        self._end_job(stopped=True)
        self._leave_bus()

    def _enable_drives(self) -> list[BusFrame]:
        self._waited += 1
        frames = [frame for link in self._links for frame in link.step_toward_enabled()]
        if all(link.state is PowerState.OPERATION_ENABLED for link in self._links):
            self._position = [(link.position or 0) / link.increments_per_mm for link in self._links]
            self.phase = NcPhase.READY
            self._rate.jump_to(0.0 if self._hold else self.override)
            self._rows.extend([PathRow(self._position, False, False)] * (self._delay + 1))
            self.events.append({"event": "nc", "on": True})
            if self._job is not None:
                self._start_job()
        elif self._waited * self._period_s > _ENABLE_S:
            pending = ", ".join(f"{k.axis} ({k.state.name})" for k in self._links if k.word != ENABLED)
            self._abort_takeover(
                f"drives do not reach Operation enabled: {pending}; clear the cause and switch the NC on"
            )
        return frames

    def _release_drives(self) -> list[BusFrame]:
        self._waited += 1
        if self._waited > _RELEASE_CYCLES:
            frames = self._build_nmt_frames(0x80)
            self._leave_bus()
            return frames
        for link in self._links:
            link.word = SHUTDOWN
        return [frame for k in self._links if k.position is not None for frame in k.build_setpoint_frames(k.position)]

    def _leave_bus(self) -> None:
        self.phase = NcPhase.OFF
        self._leaving = False
        self._rows.clear()
        self._stages.clear()
        self.in_force = None
        self.events.append({"event": "nc", "on": False})

    def _start_job(self) -> None:
        assert self._job is not None
        demand = self._job.demand
        if isinstance(demand, DemandStream):
            if demand.start_mm is not None:
                self._begin_motion(demand.start_mm, demand)
            return
        columns = [
            demand.position_mm[axis] if axis in demand.axes else np.full(demand.time_s.size, here)
            for axis, here in zip(self.axes, self._position, strict=True)
        ]
        rows = np.column_stack(columns)
        self._begin_motion(rows[0].tolist(), RowPlayer(rows, demand.rapid))

    def _begin_motion(self, start_mm: list[float], motion: RowPlayer | DemandStream) -> None:
        self._rate.jump_to(0.0 if self._hold else self.override)
        rapid = plan_rapid_rows(
            self._position, start_mm, self._speeds, self._accelerations, self._smoothing_s, self._period_s
        )
        if len(rapid):
            self._stages.append(PathStage(RowPlayer(rapid, np.ones(len(rapid), dtype=bool))))
            self._stages.append(PathStage(Pause(round(_SETTLE_S / self._period_s))))
        self._stages.append(PathStage(motion, playing=True))
        self._stages.append(PathStage(Pause(round(TAIL_S / self._period_s)), playing=True))

    def _send_setpoints(self) -> list[BusFrame]:
        self._supervise_drives()
        self._rows.append(self._advance_path())
        frames: list[BusFrame] = []
        for n, link in enumerate(self._links):
            if self.phase is NcPhase.FAULTED and link.state is not PowerState.OPERATION_ENABLED:
                link.word = SHUTDOWN
                target = link.position or 0
            else:
                link.word = ENABLED
                row = self._rows[link.delay - self._delay - 1]
                target = round(row.position_mm[n] * link.increments_per_mm)
            frames += link.build_setpoint_frames(target)
        return frames

    def _advance_path(self) -> PathRow:
        held = self._hold or self._stopping or self.phase is NcPhase.FAULTED
        rate = self._rate.advance_rate(0.0 if held else self.override)
        if self._stopping and rate == 0.0:
            self._stages.clear()
            self._stopping, self._given_up = False, True
        while self._stages and self._stages[0].motion.has_ended:
            self._stages.popleft()
        if not self._stages:
            self._handle_path_end()
        if not self._stages:
            return PathRow(self._position, False, False)
        stage = self._stages[0]
        if isinstance(stage.motion, Pause):
            stage.motion.cycles -= 1
            return PathRow(self._position, False, stage.playing)
        self._position, rapid = stage.motion.play_row(rate)
        return PathRow(self._position, rapid, stage.playing)

    def _handle_path_end(self) -> None:
        self._stopping = False  # the stopped path has ended
        if not self._hold and self.phase is NcPhase.READY:
            self._rate.jump_to(self.override)
        if self._leaving and not any(row.playing for row in self._rows):
            self.phase, self._waited = NcPhase.RELEASE, 0
        elif self._awaits_rows and self.phase is NcPhase.READY:
            self._start_job()

    def _supervise_drives(self) -> None:
        """Stop the path when a drive leaves Operation enabled or falls silent."""
        if self.phase is NcPhase.FAULTED:
            return
        for link in self._links:
            if link.silent > link.wiring.patience:
                why = "stopped sending its statusword"
            elif link.status is None or link.status & 0x6F != PowerState.OPERATION_ENABLED:
                why = f"left Operation enabled ({link.state.name})"
            else:
                continue
            self.phase = NcPhase.FAULTED
            self.stop_path()
            self._report_error(f"drive {link.axis} {why}: the path is stopped. Clear the cause and switch the NC on")
            return

    def _report_progress(self, before: PathRow | None, now: PathRow | None) -> None:
        was, is_ = before is not None and before.playing, now is not None and now.playing
        if is_:
            self._played += 1
        if is_ and not was and self._job is not None:
            self.events.append({"event": "playing", "file": self._job.file, "rows": self._job.rows})
        elif was and not is_:
            self._end_job(stopped=False)
        elif self._stages or any(row.playing for row in self._rows):
            return
        elif self.phase is NcPhase.FAULTED or (self.phase is NcPhase.READY and not self._awaits_rows):
            self._end_job(stopped=True)

    def _end_job(self, *, stopped: bool) -> None:
        if self._job is None:
            return
        self.events.append(self._job.create_finished_event(self._played, stopped or self._given_up))
        self._job = None

    @property
    def _awaits_rows(self) -> bool:
        """Whether a stream is to be played that has too few rows to start."""
        return self._job is not None and self._job.is_awaited and not self._given_up

    def _report_error(self, text: str) -> None:
        self.events.append({"event": "error", "text": text})
