"""[sim]: the simulated machine; a real one needs none of it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from pydantic import Field

from fdhil.config.reality_section import Reality
from fdhil.config.section import AxisName, Finite, NotNegative, Positive, Section


class Noise(Section):
    """[sim.noise]: standard deviations of the simulator's white sensor noise."""

    voltage_v: NotNegative = Field(0.06, description="terminal voltage")
    current_a: NotNegative = Field(0.05, description="motor current")
    speed_rad_s: NotNegative = Field(0.15, description="shaft speed")
    table_um: NotNegative = Field(0.05, description="position of the encoder at the table, if there is one")
    table_m_s2: NotNegative = Field(0.05, description="acceleration of the accelerometer at the table")


class SimAxis(Section):
    """[sim.axis.X]: true values of the simulated drive; a key that is left out has the nominal value."""

    R: Positive | None = Field(None, ge=1e-9, le=1e6, description="ohm")
    L: Positive | None = Field(None, ge=1e-9, le=1e6, description="H")
    K: Positive | None = Field(None, ge=1e-9, le=1e6, description="N.m/A")
    Jt: Positive | None = Field(None, ge=1e-9, le=1e6, description="kg.m2")
    ft: NotNegative | None = Field(None, description="N.m.s, at the reference temperature")
    Cd: NotNegative | None = Field(None, description="N.m, at the reference temperature")
    ft_per_kelvin: Finite = Field(0.0, description="relative change of ft per kelvin of slide-way temperature")
    Cd_per_kelvin: Finite = Field(0.0, description="relative change of Cd per kelvin of slide-way temperature")
    backlash_um: NotNegative = Field(0.0, description="lost motion between screw and table")
    start_mm: Finite = Field(0.0, description="position at power-on")
    offset_in_feedforward: bool = Field(True, description="whether the speed feed-forward includes 0x60B0")
    eds: Path | None = Field(
        None,
        description="EDS or DCF file of a vendor's drive to emulate, from the config's folder; left out: the "
        "simulator's own drive",
    )
    boot_s: NotNegative = Field(0.0, le=60.0, description="time from a reset or power-on to the boot-up message")
    limit_switches_mm: tuple[Finite, Finite] | None = Field(
        None, description="limit switches for homing; left out: none"
    )
    home_switch_mm: Finite | None = Field(
        None, description="from here on in positive direction the home switch is active"
    )
    reality: Reality = Reality()


class Thermal(Section):
    """[sim.thermal]: the slide-ways warm with the work of friction and cool toward the ambient."""

    ambient_c: Finite = Field(20.0, ge=-50, le=200, description="ambient and start temperature, reference of ft and Cd")
    rise_c: NotNegative = Field(2.0, le=200, description="rise in steady shuttling at rapid speed")
    time_constant_s: Positive = Field(600.0, description="time constant of that rise")


class Sim(Section):
    """[sim]: the simulated machine; a real machine's config needs none of it."""

    pace: Literal["realtime", "lockstep"] = Field("realtime", description="lockstep: as fast as the bus, repeatable")
    seed: int = Field(1, ge=0, le=2**63 - 1, description="seed of the sensor noise")
    nc: bool = Field(False, description="whether the simulated NC is switched on at start")
    lockstep_rpdo: tuple[str, ...] = Field(
        (), description="lockstep: RPDOs to wait for, as X:2; left out: those of the previous cycle"
    )
    modbus: bool = Field(True, description="serve a Modbus voltage sensor per axis")
    modbus_cycles: int = Field(1, ge=1, le=100, description="SYNC cycles averaged in one of its samples")
    noise: Noise = Noise()
    thermal: Thermal = Thermal()
    axis: Mapping[AxisName, SimAxis] = Field(default_factory=dict)
