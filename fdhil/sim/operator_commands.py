"""Executes the commands of the operator's panel: one JSON object per line, validated first."""

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from fdhil.errors import ConfigError, FdhilError
from fdhil.records import PARAMETERS
from fdhil.sim import fault_script
from fdhil.sim.simulated_axis import SimulatedAxis
from fdhil.sim.simulated_machine import SimulatedMachine

MAX_LINE = 1 << 16
_LOWEST_C, _HIGHEST_C = -40.0, 150.0


class CommandError(FdhilError):
    """A command of the panel cannot be executed."""

    exit_code = 2


class OperatorCommands:
    """Executes the commands of one machine; ``play`` and ``quit`` are callbacks of the process."""

    def __init__(self, machine: SimulatedMachine, play: Callable[[Path], None], quit: Callable[[], None]) -> None:
        self._machine = machine
        self._play = play
        self._quit = quit
        self._commands: Mapping[str, Callable[[dict[str, Any]], None]] = {
            "nc": lambda command: machine.nc.switch_on_off(_parse_flag(command, "on")),
            "play": lambda command: self._play(_parse_path(command)),
            "feed_hold": lambda command: machine.nc.set_feed_hold(_parse_flag(command, "on")),
            "override": lambda command: machine.nc.set_override(_parse_number(command, "percent")),
            "stop": lambda _: machine.nc.stop_path(),
            "set": self._set_parameters,
            "temperature": self._set_temperature,
            "fault": self._add_fault,
            "trace": lambda command: machine.record_next_file(_parse_path(command)),
            "quit": lambda _: self._quit(),
        }

    def execute_line(self, line: str) -> None:
        """Execute one line; CommandError says why it is invalid; an empty line is ignored."""
        if not line.strip():
            return
        if len(line) > MAX_LINE:
            raise CommandError("a panel command is longer than 64 KiB and was ignored; send one JSON object per line")
        try:
            command = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise CommandError(f"a panel command is not valid JSON ({error}); send one JSON object per line") from None
        name = command.pop("command", None) if isinstance(command, dict) else None
        if not isinstance(name, str) or name not in self._commands:
            raise CommandError(f"unknown panel command {name!r}; the commands are {', '.join(self._commands)}")
        try:
            self._commands[name](command)
        except (ValueError, TypeError) as error:
            raise CommandError(f"command {name}: {error}") from None
        except ConfigError as error:
            raise CommandError(f"command {name}: {'; '.join(map(str, error.faults))}") from None

    def _set_parameters(self, command: dict[str, Any]) -> None:
        (unit,) = self._select_axes(command, required=True)
        parameters = command.get("parameters")
        if not isinstance(parameters, dict) or not parameters:
            raise ValueError('"parameters" must be an object such as {"Jt": 0.085}')
        unknown = [name for name in parameters if name not in PARAMETERS]
        if unknown:
            raise ValueError(f"unknown parameter {', '.join(unknown)}; the parameters are R, L, K, Jt, ft and Cd")
        unit.drive.set_parameters(**{name: _parse_number(parameters, name) for name in parameters})

    def _set_temperature(self, command: dict[str, Any]) -> None:
        celsius = _parse_number(command, "celsius")
        if not _LOWEST_C <= celsius <= _HIGHEST_C:
            raise ValueError(f"{celsius:g} degC is out of range ({_LOWEST_C:g} to {_HIGHEST_C:g} degC)")
        for unit in self._select_axes(command):
            unit.set_temperature(celsius)

    def _add_fault(self, command: dict[str, Any]) -> None:
        self._machine.faults.add_entry(fault_script.parse_entry(command, tuple(self._machine.units)))

    def _select_axes(self, command: dict[str, Any], *, required: bool = False) -> list[SimulatedAxis]:
        units, axis = self._machine.units, command.get("axis")
        if axis is None and not required:
            return list(units.values())
        if axis not in units:
            raise ValueError(f"unknown axis {axis!r}; the machine has {', '.join(units)}")
        return [units[axis]]


def _parse_flag(command: Mapping[str, Any], key: str) -> bool:
    value = command.get(key)
    if not isinstance(value, bool):
        raise TypeError(f'"{key}" must be true or false')
    return value


def _parse_number(command: Mapping[str, Any], key: str) -> float:
    value = command.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f'"{key}" must be a number')
    return float(value)


def _parse_path(command: Mapping[str, Any]) -> Path:
    value = command.get("file")
    if not isinstance(value, str) or not value:
        raise ValueError('"file" must be a path')
    return Path(value)
