"""Polls the state of an NC, or its PLC, over Modbus: bits for the motion, registers for line and overrides."""

import asyncio
import time
from collections.abc import Mapping, Sequence
from typing import Self

from fdhil.config import MachineConfig
from fdhil.drivers.modbus.modbus_unit import ModbusUnit
from fdhil.drivers.modbus.rtu_frames import BIT_READS
from fdhil.drivers.nc.nc_profile import Condition, NcProfile, Rule, Shown, Signal, StateTranslator
from fdhil.drivers.nc.value_timing import bound_value_time
from fdhil.records import MoveKind, NcState

_SET = Condition((True,))
_IN_ORDER = {"hold": MoveKind.HOLD, "rapid": MoveKind.RAPID, "arc": MoveKind.ARC, "feed": MoveKind.FEED}


class ModbusCoilSource:
    """The NC source ``modbus_coil``: each request reads adjacent bits, or registers."""

    def __init__(self, config: MachineConfig) -> None:
        settings = config.nc_source.modbus_coil
        self._places = settings.map_signals()
        self._requests = settings.plan_requests()
        self._period_s, self._renewed_s = settings.period_s, settings.renewed_s
        self.name = f"NC at Modbus {settings.device or f'{settings.host}:{settings.port}'}, unit {settings.unit}"
        self._link = ModbusUnit(self.name, settings)
        self._translator = StateTranslator(_build_profile(self._places, settings.override_scale), self.name)
        self._next_s = 0.0

    async def __aenter__(self) -> Self:
        await self._link.connect()
        self._next_s = time.monotonic()
        return self

    async def __aexit__(self, *_: object) -> None:
        self._link.close()

    async def read_states(self) -> Sequence[NcState]:
        await asyncio.sleep(max(0.0, self._next_s - time.monotonic()))
        self._next_s = max(time.monotonic(), self._next_s + self._period_s)
        answers: dict[int, Sequence[int]] = {}
        asked_ns = 0
        for function, (first, count) in self._requests.items():
            answers[function] = await self._link.read_registers(function, first, count)
            asked_ns = asked_ns or self._link.asked_ns
        shown: dict[str, Shown] = {}
        for name, (function, address, _) in self._places.items():
            value = answers[function][address - self._requests[function][0]]
            shown[name] = bool(value) if function in BIT_READS else value
        stamp_ns, error_ns = bound_value_time(asked_ns, self._link.answered_ns, self._renewed_s)
        return [self._translator.translate_state(shown, stamp_ns, error_ns)]


def _build_profile(places: Mapping[str, tuple[int, int, int | None]], override_scale: float) -> NcProfile:
    """Build the profile of the section: a hold outranks a rapid, and no bit at all is rest."""
    signals = {
        name: Signal(name, str(address), override_scale if name.endswith("override") else 1.0, bit)
        for name, (_, address, bit) in places.items()
    }
    rules = [Rule(kind, {name: _SET}) for name, kind in _IN_ORDER.items() if name in places]
    return NcProfile("Modbus", "modbus", signals, (*rules, Rule(MoveKind.REST, {"rapid": Condition((False,))})))
