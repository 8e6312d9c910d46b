"""The whole machine configuration, and the checks across its sections."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationInfo, model_validator

from fdhil.config.axis_plausibility import find_implausibilities
from fdhil.config.axis_section import Axis
from fdhil.config.bus_section import CanBus
from fdhil.config.nc_section import G0, Correction, Identification, Nc
from fdhil.config.nc_source_section import NcSource
from fdhil.config.offers_section import Offers
from fdhil.config.offset_bounds import find_limit_faults
from fdhil.config.publish_sections import Publish
from fdhil.config.regulators import find_period_faults
from fdhil.config.section import AxisName, Positive, Section, ShownName, is_second_drive
from fdhil.config.sensor_sections import WORDS, SerialLineUser, find_line_faults, find_line_user
from fdhil.config.service_sections import Access, Guard, Maintenance, Play, Store
from fdhil.config.simulation_sections import Sim
from fdhil.config.uplink_section import Uplink
from fdhil.config.web_section import Web

BESIDE_THE_MACHINE = {"access", "web", "publish", "uplink", "offers"}
_OF_A_MOVE = ("rapid_speed_mm_s", "max_acceleration_mm_s2", "max_jerk_mm_s3")


class Machine(Section):
    """[machine]: the machine's name and SYNC period."""

    name: ShownName = Field(min_length=1, max_length=64, description="name of this machine in reports")
    sync_period_s: Positive = Field(0.001, ge=1e-4, le=0.02, description="period of the SYNC message on the CAN bus")


class MachineConfig(Section):
    """The whole file."""

    machine: Machine
    axis: Mapping[AxisName, Axis] = Field(min_length=1)
    nc: Nc = Nc()
    g0: G0 = G0()
    nc_source: NcSource = NcSource()
    identification: Identification = Identification()
    correction: Correction = Correction()
    bus: Mapping[str, CanBus] = Field(default_factory=lambda: {"can0": CanBus()})
    store: Store = Store()
    guard: Guard = Guard()
    access: Access = Access()
    publish: Publish = Publish()
    uplink: Uplink | None = None
    offers: Offers = Offers()
    play: Play = Play()
    maintenance: Maintenance = Maintenance()
    web: Web = Web()
    sim: Sim = Sim()

    @model_validator(mode="after")
    def _check_consistency(self, info: ValidationInfo) -> MachineConfig:
        period = self.machine.sync_period_s
        faults: list[str] = []
        for name, axis in self.axis.items():
            bus = self.bus.get(axis.drive.bus)
            if bus is None:
                faults.append(f"axis.{name}.drive.bus: there is no [bus.{axis.drive.bus}]")
            elif axis.correction is not None and not bus.may_send:
                faults.append(f"axis.{name}.correction: {self._explain_listen_only(axis.drive.bus)}")
            elif axis.correction is not None and (axis.drive.source == "hal") != (bus.offset_lead_cycles > 0):
                text = "1 or more where its drives are HAL pins, which take offsets from a queue, and 0 for CANopen"
                faults.append(f"bus.{axis.drive.bus}.offset_lead_cycles: must be {text}")
            faults += [f"axis.{name}.regulators.{fault}" for fault in find_period_faults(axis.regulators, period)]
            limits = [f"axis.{name}.correction: {fault}" for fault in find_limit_faults(axis, period)]
            # a wrong unit also breaks limits, and explains the fault better
            found = [] if (info.context or {}).get("made_up") else find_implausibilities(axis)
            faults += [f"axis.{name}.{doubt.key}: {doubt.text}" for doubt in found if limits or not doubt.possible]
            faults += limits
            if axis.unit == "deg" and axis.radius_mm is None:
                faults.append(f"axis.{name}.radius_mm: is missing: angles count as path error at a radius; give it")
            if axis.unit == "deg" and name[0] in "XYZUVW":
                faults.append(f"axis.{name}.unit: programs give {name[0]} in mm; name a rotary axis A, B or C")
        faults += self._find_gantry_faults()
        faults += find_line_faults(self._list_line_users())
        faults += self._find_node_faults()
        faults += [f"sim.axis.{name}: there is no [axis.{name}]" for name in self.sim.axis if name not in self.axis]
        labelled = self.uplink.axis_labels if self.uplink is not None else ()
        faults += [
            f"uplink.axis_labels.{name}: there is no [axis.{name}]" for name in labelled if name not in self.axis
        ]
        if faults:
            raise ValueError("\n".join(faults))
        return self

    def _find_gantry_faults(self) -> Iterator[str]:
        for name in filter(is_second_drive, self.axis):
            first, second = self.axis[name[0]], self.axis[name]
            for key in ("unit", "radius_mm", "screw_pitch_mm", *_OF_A_MOVE):
                if getattr(first, key) != getattr(second, key):
                    yield f"axis.{name}.{first.format_key(key)}: differs from axis.{name[0]}, and both move one beam"
            if first.setpoints is not None or second.setpoints is not None:
                text = "fdhil plays no set-points on a gantry axis: moving one drive would skew the beam"
                yield f"axis.{name[0]}.setpoints: {text}; remove the section"
            if first.drive.bus != second.drive.bus:
                yield f"axis.{name}.drive.bus: both drives of axis {name[0]} are on one bus, whose SYNC they share"
            if (first.correction is None) != (second.correction is None):
                yield f"axis.{name}.correction: both drives of axis {name[0]} are corrected, or neither; give both"

    def _find_node_faults(self) -> Iterator[str]:
        if self.play.node_id == self.guard.node_id:
            yield "play.node_id: equals guard.node_id, and both send a heartbeat; give them different ones"
        drives = {self.get_node_id(name): name for name in self.axis}
        for section, node_id in (("guard", self.guard.node_id), ("play", self.play.node_id)):
            if node_id in drives:
                yield f"{section}.node_id: it is that of drive {drives[node_id]}; both send a heartbeat"
        # a device's second axis uses the PDOs of the next node-ID
        ids: dict[tuple[str, int], str] = {}
        for name, axis in self.axis.items():
            other = ids.setdefault((axis.drive.bus, self.get_node_id(name) + axis.drive.logical_axis), name)
            if other != name:
                text = f"drives {other} and {name} have the same node_id on one bus; give them different ones"
                yield f"axis.{name}.drive.node_id: {text}"
        places: dict[tuple[str, ...], str] = {}
        for name, bus in self.bus.items():
            if bus.endpoint is not None and places.setdefault(bus.endpoint, name) != name:
                yield f"bus.{name}: it is the same bus as [bus.{places[bus.endpoint]}]; keep one of them"

    def _list_line_users(self) -> Iterator[SerialLineUser]:
        for name, axis in self.axis.items():
            yield from filter(None, [find_line_user(f"axis.{name}.voltage", axis.voltage)])
            if axis.temperature is not None:
                yield from filter(None, [find_line_user(f"axis.{name}.temperature", axis.temperature)])
            table, accelerometer = axis.table, axis.accelerometer
            if table is not None and table.source == "modbus" and table.device:
                yield SerialLineUser(f"axis.{name}.table", table, WORDS[table.type], table.period_s, False)
            if accelerometer is not None:
                yield SerialLineUser(f"axis.{name}.accelerometer", accelerometer, 0, 1.0, True)
        bits = self.nc_source.modbus_coil
        if self.g0.source == "modbus_coil" and bits.device:
            yield SerialLineUser("nc_source.modbus_coil", bits, bits.registers, bits.period_s, False)

    def _explain_listen_only(self, bus: str) -> str:
        interface = self.bus[bus].interface
        return (
            f"bus {bus} is receive-only ({interface}), so no offset can be sent; use SocketCAN, or remove this section"
        )

    def get_node_id(self, axis: str) -> int:
        return self.axis[axis].drive.node_id or list(self.axis).index(axis) + 1

    @property
    def mm_per_degree(self) -> dict[str, float]:
        """Arc length of one degree at the radius of each rotary axis, mm."""
        return {name: axis.mm_per_unit for name, axis in self.axis.items() if axis.unit == "deg"}

    @property
    def run_directory(self) -> Path:
        return self.store.run_directory or self.store.directory / "run"

    @property
    def guard_directory(self) -> Path:
        """Folder of the guard's socket: its own, or the daemon's."""
        return self.guard.run_directory or self.run_directory

    @property
    def uplink_directory(self) -> Path:
        """Folder in which fdhil uplink stores its progress."""
        return (self.uplink and self.uplink.directory) or self.store.directory / "uplink"

    @property
    def offers_directory(self) -> Path:
        """Folder of the proposed configuration changes that fdhil uplink fetched."""
        return self.offers.directory or self.uplink_directory / "offers"

    @property
    def plant_name(self) -> str:
        """This machine's name in the plant, also where no uplink is configured."""
        return (self.uplink or Uplink()).get_plant_name(self.machine.name)

    @property
    def digest(self) -> str:
        """SHA-256 of the machine's settings (not of the text), 16 hexadecimal digits.

        Access and network settings are excluded: changing them invalidates no record.
        """
        files = "".join(axis.drive.files_digest for axis in self.axis.values())
        # unchanged for linear axes, so that existing records stay valid
        rotary = {"unit", "radius_mm"}
        linear = {
            n: {"max_difference_um", "guessed", *(rotary if axis.unit == "mm" else ())} for n, axis in self.axis.items()
        }
        unused: dict[str, Any] = {**dict.fromkeys(BESIDE_THE_MACHINE, True), "axis": linear}
        if not self.nc.wrapped_axes:
            unused["nc"] = {"wrapped_axes"}
        settings = self.model_dump_json(exclude=unused)
        return hashlib.sha256(f"{settings}{files}".encode()).hexdigest()[:16]
