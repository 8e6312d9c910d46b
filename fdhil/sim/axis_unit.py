"""Combines one axis' drive with its slide-way and sensor, and applies faults to them."""

from dataclasses import dataclass, field

from fdhil.sim.drive.servo import Drive
from fdhil.sim.frame import BusFrame
from fdhil.sim.frame_faults import FrameFaults
from fdhil.sim.thermal import SlideWay
from fdhil.sim.wire.modbus_sensor import VoltageSensor

_GAP_CYCLES = 50  # a longer gap is the end of the stream, not a late frame
_THERMAL_CYCLES = 100  # the temperature changes slowly: update interval
_PATIENCE_CYCLES = 3  # lockstep stops waiting for an RPDO missing this often


@dataclass(slots=True)
class RpdoStream:
    """Tracks one RPDO per cycle; ``late`` counts the cycles in which it was missing within a running stream."""

    active: bool = False
    gap: int = 0
    late: int = 0

    def step(self, received: bool) -> None:
        if received:
            self.late += self.gap
            self.active, self.gap = True, 0
        elif self.active:
            self.gap += 1
            if self.gap > _GAP_CYCLES:
                self.active, self.gap = False, 0

    @property
    def awaited(self) -> bool:
        """Whether lockstep still waits for it."""
        return self.active and self.gap <= _PATIENCE_CYCLES


@dataclass(slots=True)
class AxisUnit:
    """One axis of the machine, with its drive and sensor; faults act on it.

    ``injected`` holds the machine's foreign frames, sent at every SYNC; ``sync_on`` is False while the NC's SYNC fails
    on the axis' bus; ``wire`` has the faults of that bus.
    """

    axis: str
    bus: str
    drive: Drive
    slide_way: SlideWay
    sensor: VoltageSensor
    outbox: list[BusFrame]
    injected: dict[int, tuple[str, bytes]]
    wire: FrameFaults
    offsets: RpdoStream = field(default_factory=RpdoStream)
    sync_on: bool = True
    _before: dict[tuple[int, int], int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.drive.on_cycle(self.cycle_ended)

    def power(self, on: bool) -> None:
        if on:
            self.outbox.extend((self.bus, frame) for frame in self.drive.power_on())
        else:
            self.drive.power_off()

    def set_input(self, bit: int, on: bool) -> None:
        """Set or clear a bit of 0x60FD."""
        feedback, mask = self.drive.feedback, 1 << bit
        feedback.digital_inputs = feedback.digital_inputs | mask if on else feedback.digital_inputs & ~mask

    def object_fault(self, index: int, sub: int, value: int) -> str:
        """Return why an object of the drive cannot hold a value, "" when it can."""
        entry = self.drive.dictionary.entries.get(index << 8 | sub)
        if entry is None or entry.size is None:
            return f"the drive has no numeric object {index:04X}:{sub:02X}"
        try:
            entry.encode(value)
        except OverflowError:
            return f"{value} does not fit {index:04X}:{sub:02X}"
        return ""

    def overwrite(self, index: int, sub: int, value: int, on: bool) -> None:
        """Overwrite an object regardless of its access rules, or restore its value."""
        drive = self.drive
        if on:
            self._before.setdefault((index, sub), drive.dictionary.shown(drive.dictionary.entry(index, sub)))
            drive.set_object(index, sub, value)
        elif (index, sub) in self._before:
            drive.set_object(index, sub, self._before.pop((index, sub)))

    def turn_tpdo(self, number: int) -> None:
        """Reverse the order of a TPDO's objects, as another tool might; a second call restores it."""
        if number not in self.drive.pdo.numbers("tpdo"):
            return
        index = 0x1A00 + number - 1
        count = self.drive.dictionary.number(index, 0)
        words = [self.drive.dictionary.number(index, sub) for sub in range(count, 0, -1)]
        self.drive.remap(index, [(word >> 16, word >> 8 & 0xFF, word & 0xFF) for word in words])

    def cycle_ended(self, voltage_v: float) -> None:
        """Update slide-way and sensor after a cycle; ``voltage_v`` is the mean over the cycle before it."""
        drive = self.drive
        celsius = self.slide_way.step(drive.physics.speed_rad_s)
        self.sensor.feed(drive.ratings.sign * voltage_v)
        if drive.tick % _THERMAL_CYCLES == 0:
            self.warm(celsius)

    def warm(self, celsius: float) -> None:
        """Set the slide-way's temperature in plant, drive and sensor."""
        self.slide_way.celsius = celsius
        self.drive.set_temperature(celsius)
        self.sensor.celsius = celsius
