"""Simulates the sensors at a table: an encoder node on the bus and an accelerometer that streams lines of text."""

import math
from collections.abc import Sequence

import numpy as np

from fdhil.config import Accelerometer, MachineConfig, TableEncoder
from fdhil.sim.drive.servo_drive import SimulatedDrive
from fdhil.sim.frame_types import BusFrame, Frame
from fdhil.sim.signal_fault import WhiteNoise

OPERATIONAL, STOPPED, PRE_OPERATIONAL = 0x05, 0x04, 0x7F
HEARTBEAT_S = 1.0
LIMITS = {
    "int16": (-(2**15), 2**15 - 1),
    "uint16": (0, 2**16 - 1),
    "int32": (-(2**31), 2**31 - 1),
    "uint32": (0, 2**32 - 1),
}
OFF_RATE = 1.007  # of the nominal rate: the sensor's oscillator is not a quartz
TILT_M_S2 = 0.3  # share of gravity in a slightly tilted sensor
KEPT_LINES = 2000
WITHOUT_SYNC_S = 0.05
MOST_CYCLES = 200  # limit of cycles made up at once
SEED = 406  # added to the machine's seed, so that the other sensors' noise does not change


class EncoderNode:
    """A CANopen encoder (CiA 406) whose TPDO carries the table position at every SYNC; it starts by itself."""

    def __init__(self, settings: TableEncoder, noise_um: float, rng: np.random.Generator) -> None:
        assert settings.cob_id is not None
        self.cob_id = settings.cob_id
        self.node_id = settings.cob_id & 0x7F
        self.nmt = OPERATIONAL
        low, high = LIMITS[settings.type]
        self.frame_bytes = settings.byte + (high - low).bit_length() // 8
        self._settings = settings
        self._noise = WhiteNoise(noise_um * 1e-3, rng)
        self._due_s = 0.0

    def power_on(self) -> list[Frame]:
        self.nmt = OPERATIONAL
        return [(0x700 + self.node_id, b"\0")]

    def receive_frame(self, can_id: int, data: bytes) -> list[Frame]:
        if can_id != 0 or len(data) != 2 or data[1] not in (0, self.node_id):
            return []
        if data[0] in (0x81, 0x82):
            return self.power_on()
        self.nmt = {0x01: OPERATIONAL, 0x02: STOPPED, 0x80: PRE_OPERATIONAL}.get(data[0], self.nmt)
        return []

    def run_timers(self, now_s: float) -> list[Frame]:
        if now_s < self._due_s:
            return []
        self._due_s = now_s + HEARTBEAT_S
        return [(0x700 + self.node_id, bytes([self.nmt]))]

    def send_position(self, table_mm: float) -> list[Frame]:
        """Return the TPDO with the position at this SYNC; counts beyond the type wrap around."""
        if self.nmt != OPERATIONAL:
            return []
        s = self._settings
        low, high = LIMITS[s.type]
        count = round((table_mm + self._noise.draw() - s.offset) / s.scale)
        count = (count - low) % (high - low + 1) + low
        size = (high - low).bit_length() // 8
        return [(self.cob_id, bytes(s.byte) + count.to_bytes(size, "little", signed=low < 0))]


class TableAccelerometer:
    """An accelerometer that streams a line per sample: the mean over its interval, in counts.

    It samples in simulated time, with its own oscillator.
    """

    def __init__(self, settings: Accelerometer, period_s: float, noise_m_s2: float, rng: np.random.Generator) -> None:
        self._settings = settings
        self._step = 1.0 / (settings.rate_hz * OFF_RATE * period_s)  # cycles
        self._period_s = period_s
        self._noise = WhiteNoise(noise_m_s2, rng)
        self._cycle = 0
        self._next = self._step
        self._speed = self._begun = 0.0
        self._count = 0
        self._lines: list[str] = []

    def integrate_speed(self, speed_m_s: float) -> None:
        """Process the table's speed at a SYNC, interpolated linearly between SYNCs."""
        before, self._speed = self._speed, speed_m_s
        self._cycle += 1
        while self._next <= self._cycle:
            part = self._next - (self._cycle - 1)
            ended = before + (speed_m_s - before) * part
            self._append_sample((ended - self._begun) / (self._step * self._period_s))
            self._begun, self._next = ended, self._next + self._step

    def _append_sample(self, m_s2: float) -> None:
        s = self._settings
        self._count += 1
        numbers = ["0"] * max(4, s.column, s.count_column)
        numbers[s.column - 1] = str(round((m_s2 + TILT_M_S2 + self._noise.draw()) / s.scale))
        if s.count_column:
            numbers[s.count_column - 1] = str(self._count)
        if len(self._lines) < KEPT_LINES:
            self._lines.append(",".join(numbers))

    def take_lines(self) -> bytes:
        if not self._lines:
            return b""
        lines, self._lines = self._lines, []
        return "".join(f"{line}\n" for line in lines).encode()


class TableSensors:
    def __init__(self, config: MachineConfig) -> None:
        noise, period_s = config.sim.noise, config.machine.sync_period_s
        self._bus = {axis: section.drive.bus for axis, section in config.axis.items()}
        self._m_per_rad = {
            axis: section.drive.sign * section.screw_pitch_mm / (2e3 * math.pi) for axis, section in config.axis.items()
        }
        self._period_s = period_s
        self._synced, self._streamed_s = False, 0.0
        self._encoders: dict[str, EncoderNode] = {}
        self.accelerometers: dict[str, TableAccelerometer] = {}
        for n, (axis, section) in enumerate(config.axis.items()):
            seeds = np.random.SeedSequence([config.sim.seed, SEED, n]).spawn(2)
            rngs = [np.random.default_rng(seed) for seed in seeds]
            if section.table is not None and section.table.source == "canopen":
                self._encoders[axis] = EncoderNode(section.table, noise.table_um, rngs[0])
            if section.accelerometer is not None:
                settings = section.accelerometer
                self.accelerometers[axis] = TableAccelerometer(settings, period_s, noise.table_m_s2, rngs[1])

    def list_frame_bytes(self, bus: str) -> list[int]:
        """Return the sizes of the encoder frames of a bus per SYNC, bytes."""
        return [node.frame_bytes for axis, node in self._encoders.items() if self._bus[axis] == bus]

    def power_on(self) -> list[BusFrame]:
        return [(self._bus[axis], frame) for axis, node in self._encoders.items() for frame in node.power_on()]

    def receive_frame(self, bus: str, frame: Frame) -> list[Frame]:
        if frame[0] != 0:
            return []
        return [
            one for axis, node in self._encoders.items() if self._bus[axis] == bus for one in node.receive_frame(*frame)
        ]

    def run_timers(self, now_s: float, alone: Sequence[SimulatedDrive]) -> list[BusFrame]:
        """Return the due heartbeats; accelerometers of drives without SYNC keep streaming."""
        if self._synced:
            self._synced, self._streamed_s = False, now_s
        elif now_s - self._streamed_s > WITHOUT_SYNC_S:
            for drive in alone:
                for _ in range(min(round((now_s - self._streamed_s) / self._period_s), MOST_CYCLES)):
                    self._feed_accelerometer(drive.axis, drive.physics.table_speed_rad_s)
            self._streamed_s = now_s
        return [(self._bus[axis], one) for axis, node in self._encoders.items() for one in node.run_timers(now_s)]

    def sample_axis(self, drive: SimulatedDrive, table_rad_s: float) -> list[Frame]:
        """Sample an axis at a SYNC with this table speed; return its encoder's frame."""
        self._synced = True
        self._feed_accelerometer(drive.axis, table_rad_s)
        encoder = self._encoders.get(drive.axis)
        return [] if encoder is None else encoder.send_position(drive.table_mm)

    def _feed_accelerometer(self, axis: str, table_rad_s: float) -> None:
        if axis in self.accelerometers:
            self.accelerometers[axis].integrate_speed(table_rad_s * self._m_per_rad[axis])
