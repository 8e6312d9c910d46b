"""Combines one axis' drive with its slide-way and sensor, and applies faults to them."""

from dataclasses import dataclass, field

from fdhil.sim.drive.servo_drive import SimulatedDrive
from fdhil.sim.frame_faults import FrameFaults
from fdhil.sim.frame_types import BusFrame
from fdhil.sim.slide_way import SlideWay
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

    def count_cycle(self, received: bool) -> None:
        if received:
            self.late += self.gap
            self.active, self.gap = True, 0
        elif self.active:
            self.gap += 1
            if self.gap > _GAP_CYCLES:
                self.active, self.gap = False, 0

    @property
    def is_awaited(self) -> bool:
        """Whether lockstep still waits for it."""
        return self.active and self.gap <= _PATIENCE_CYCLES


@dataclass(slots=True)
class SimulatedAxis:
    """One axis of the machine, with its drive and sensor; faults act on it.

    ``injected`` holds the machine's foreign frames, sent at every SYNC; ``sync_on`` is False while the NC's SYNC fails
    on the axis' bus; ``wire`` has the faults of that bus.
    """

    axis: str
    bus: str
    drive: SimulatedDrive
    slide_way: SlideWay
    sensor: VoltageSensor
    outbox: list[BusFrame]
    injected: dict[int, tuple[str, bytes]]
    wire: FrameFaults
    offsets: RpdoStream = field(default_factory=RpdoStream)
    sync_on: bool = True
    _before: dict[tuple[int, int], int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.drive.set_cycle_callback(self.update_after_cycle)

    def switch_power(self, on: bool) -> None:
        if on:
            self.outbox.extend((self.bus, frame) for frame in self.drive.power_on())
        else:
            self.drive.power_off()

    def set_digital_input(self, bit: int, on: bool) -> None:
        """Set or clear a bit of 0x60FD."""
        feedback, mask = self.drive.feedback, 1 << bit
        feedback.digital_inputs = feedback.digital_inputs | mask if on else feedback.digital_inputs & ~mask

    def explain_rejected_value(self, index: int, sub: int, value: int) -> str:
        """Return why an object of the drive cannot hold a value, "" when it can."""
        entry = self.drive.dictionary.entries.get(index << 8 | sub)
        if entry is None or entry.size is None:
            return f"the drive has no numeric object {index:04X}:{sub:02X}"
        try:
            entry.encode_value(value)
        except OverflowError:
            return f"{value} does not fit {index:04X}:{sub:02X}"
        return ""

    def overwrite_object(self, index: int, sub: int, value: int, on: bool) -> None:
        """Overwrite an object regardless of its access rules, or restore its value."""
        drive = self.drive
        if on:
            self._before.setdefault(
                (index, sub), drive.dictionary.get_wire_value(drive.dictionary.get_entry(index, sub))
            )
            drive.overwrite_object(index, sub, value)
        elif (index, sub) in self._before:
            drive.overwrite_object(index, sub, self._before.pop((index, sub)))

    def reverse_tpdo_mapping(self, number: int) -> None:
        """Reverse the order of a TPDO's objects, as another tool might; a second call restores it."""
        if number not in self.drive.pdo.list_numbers("tpdo"):
            return
        index = 0x1A00 + number - 1
        count = self.drive.dictionary.get_number(index, 0)
        words = [self.drive.dictionary.get_number(index, sub) for sub in range(count, 0, -1)]
        self.drive.overwrite_mapping(index, [(word >> 16, word >> 8 & 0xFF, word & 0xFF) for word in words])

    def update_after_cycle(self, voltage_v: float) -> None:
        """Update slide-way and sensor after a cycle; ``voltage_v`` is the mean over the cycle before it."""
        drive = self.drive
        celsius = self.slide_way.advance_temperature(drive.physics.speed_rad_s)
        self.sensor.feed_mean_voltage(drive.ratings.sign * voltage_v)
        if drive.tick % _THERMAL_CYCLES == 0:
            self.set_temperature(celsius)

    def set_temperature(self, celsius: float) -> None:
        """Set the slide-way's temperature in plant, drive and sensor."""
        self.slide_way.celsius = celsius
        self.drive.set_temperature(celsius)
        self.sensor.celsius = celsius
