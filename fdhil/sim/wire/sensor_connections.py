"""Connects the sensors of the simulated machine as configured: Modbus TCP and RTU, lines of text."""

from collections.abc import Callable, Mapping
from typing import Any

from fdhil.config import MachineConfig, TableEncoder, Thermometer
from fdhil.errors import ConnectError
from fdhil.sim.wire.modbus_sensor import VoltageSensor
from fdhil.sim.wire.modbus_tcp_servers import SensorServers
from fdhil.sim.wire.register_maps import (
    CombinedMap,
    RegisterMap,
    SingleValueMap,
    create_thermometer_map,
    create_voltage_map,
)
from fdhil.sim.wire.serial_lines import LineParticipant, RtuUnits, SerialLines, TextInstrument


class SensorConnections:
    """All sensors of a machine; ``ready`` has the connection of each voltage sensor once :meth:`start` has returned.

    An axis whose voltage comes from its drive has a sensor on Modbus TCP as well. A thermometer, or a table encoder on
    Modbus, is served where its device is: on a serial line, or within the unit of the voltage sensor at the same
    address. ``positions`` return the table positions, mm.
    """

    def __init__(
        self,
        config: MachineConfig,
        sensors: Mapping[str, VoltageSensor],
        positions: Mapping[str, Callable[[], float]] | None = None,
    ) -> None:
        self._config, self._sensors, self._positions = config, sensors, positions or {}
        self._parties: dict[str, LineParticipant] = {}
        maps, addresses = {}, {}
        for axis, sensor in sensors.items():
            section = config.axis[axis]
            voltage, thermometer, table = section.voltage, section.temperature, section.table
            if table is not None and table.source == "modbus" and table.device:
                self._add_serial_sensor(axis, table)
            if thermometer is not None and thermometer.device:
                self._add_serial_sensor(axis, thermometer)
            if voltage.is_separate and voltage.device:
                self._add_serial_sensor(axis, voltage)
                continue
            registers = create_voltage_map(voltage, sensor, sensor)
            here = thermometer is not None and (thermometer.host, thermometer.port) == (voltage.host, voltage.port)
            if thermometer is not None and here and thermometer.source == "modbus" and not thermometer.device:
                registers = CombinedMap(registers, create_thermometer_map(thermometer, sensor))
            there = table is not None and (table.host, table.port) == (voltage.host, voltage.port)
            if table is not None and there and table.source == "modbus" and not table.device:
                registers = CombinedMap(registers, SingleValueMap(table, table.type, self._positions[axis]))
            maps[axis], addresses[axis] = registers, (voltage.host, voltage.port)
        units = {axis: config.axis[axis].voltage.unit for axis in addresses}
        over_rtu = frozenset(axis for axis in addresses if config.axis[axis].voltage.is_rtu)
        self._tcp = SensorServers(sensors, addresses, maps, units, over_rtu)
        self._lines = SerialLines(self._parties) if self._parties else None
        self.ready: dict[str, dict[str, Any]] = {}

    def _add_serial_sensor(self, axis: str, settings: Any) -> None:
        sensor = self._sensors[axis]
        is_thermometer = isinstance(settings, Thermometer)
        if settings.source == "serial":
            read = (lambda: sensor.celsius) if is_thermometer else (lambda: (sensor.read_newest(1)[1] or [0.0])[0])
            self._parties[settings.device] = TextInstrument(settings, read, sensor.faults)
            return
        party = self._parties.setdefault(settings.device, RtuUnits())
        assert isinstance(party, RtuUnits)  # the configuration allows no other sensor on a text device
        registers: RegisterMap
        if isinstance(settings, TableEncoder):
            registers = SingleValueMap(settings, settings.type, self._positions[axis])
        else:
            registers = (
                create_thermometer_map(settings, sensor)
                if is_thermometer
                else create_voltage_map(settings, sensor, sensor)
            )
        if settings.unit in party.units:
            registers = CombinedMap(party.units[settings.unit][0], registers)
        party.units[settings.unit] = registers, sensor.faults

    def start(self) -> None:
        """Open every port and device; ConnectError when one cannot be opened."""
        self._tcp.start()
        try:
            if self._lines is not None:
                self._lines.start()
        except ConnectError:
            self._lines = None
            self._tcp.stop()
            raise
        for axis in self._sensors:
            voltage = self._config.axis[axis].voltage
            port = self._tcp.ports.get(axis)
            if port is not None:
                self.ready[axis] = {"host": voltage.host, "port": port, "unit": voltage.unit}
            elif voltage.source == "serial":
                self.ready[axis] = {"device": voltage.device}
            else:
                self.ready[axis] = {"device": voltage.device, "unit": voltage.unit}

    def stop(self) -> None:
        if self._lines is not None:
            self._lines.stop()
        self._tcp.stop()
