"""The machine configuration: TOML -> frozen pydantic models.

``load`` reports all faults at once, each with its path and a suggestion. Every key is explained in
``configs/machine-template.toml``; the ``description`` of each field here is where that text comes from.
"""

from __future__ import annotations

import difflib
import hashlib
import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from fdhil import tables
from fdhil.cia402 import Scaling
from fdhil.errors import ConfigError, ConfigFault

MAX_CONFIG_BYTES = 256 * 1024

# the built-in ceilings of what may ever be added to a set-point; a config can only lower them
CEILING_OFFSET_UM = 250.0
CEILING_SPEED_MM_S = 20.0
CEILING_ACCELERATION_MM_S2 = 2000.0

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
AxisName = Annotated[str, Field(pattern="^[A-Z]$")]


class Section(BaseModel):
    """A table of the TOML file: frozen, and a key it does not know is a fault."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=False)


class Machine(Section):
    """[machine]"""

    name: str = Field(min_length=1, max_length=64, description="what the reports call this machine")
    sync_period_s: Positive = Field(0.001, le=0.02, description="period of the SYNC message on the CAN bus")


class Nominal(Section):
    """[axis.X.nominal]: the data sheet's values, used until validated ones exist."""

    R: Positive = Field(description="resistance, ohm")
    L: Positive = Field(description="inductance, H")
    K: Positive = Field(description="torque constant = back-EMF constant, N.m/A")
    Jt: Positive = Field(description="total inertia on the motor shaft, kg.m2")
    ft: NotNegative = Field(description="viscous friction, N.m.s")
    Cd: NotNegative = Field(description="dry friction torque, N.m")


class Regulators(Section):
    """[axis.X.regulators]: the drive's nested loops."""

    structure: str = Field("p_pi_pi", description="the regulators' structure, a name of the REGULATORS table")
    position_gain_per_s: Positive = Field(description="Kv of the position loop, 1/s")
    speed_feedforward: Annotated[float, Field(ge=0, le=1.5)] = Field(
        1.0, description="share of the demand's speed fed forward"
    )
    speed_kp: Positive = Field(
        description="proportional gain of the speed loop, A.s/rad; pid: derivative gain, and factor of the other two"
    )
    speed_ki: NotNegative = Field(description="integral gain of the speed loop, A/rad")
    speed_period_s: Positive = Field(0.00025, description="cycle of the speed loop")
    current_limit_a: Positive = Field(description="limit of the speed loop's output")
    current_kp: Positive = Field(description="proportional gain of the current loop, V/A")
    current_ki: NotNegative = Field(description="integral gain of the current loop, V/(A.s)")
    current_period_s: Positive = Field(3.125e-5, description="cycle of the current loop")
    voltage_limit_v: Positive = Field(description="limit of the current loop's output")
    position_ki_per_s2: NotNegative = Field(0.0, description="double_pi, pid: integral gain of the position loop")
    torque_feedforward: Annotated[float, Field(ge=0, le=1.5)] = Field(
        0.0, description="share of the nominal inertia's current fed forward"
    )
    setpoint_filter_s: NotNegative = Field(0.0, description="time constant of a filter on the set-point; 0: none")
    setpoint_filter_order: Literal[1, 2] = Field(1, description="first-order, or two equal ones behind each other")
    current_delay_cycles: int = Field(0, ge=0, le=4, description="current cycles until a computed voltage acts")

    @field_validator("structure")
    @classmethod
    def _known(cls, name: str) -> str:
        return _listed(name, tables.REGULATORS)

    @model_validator(mode="after")
    def _integrals(self) -> Regulators:
        """What a structure does not have would be ignored silently, what it lacks would make it another one."""
        if self.structure == "p_pi_pi" and self.position_ki_per_s2:
            raise ValueError("structure p_pi_pi has no position_ki_per_s2; set structure = 'double_pi'")
        if self.structure == "double_pi" and not self.position_ki_per_s2:
            raise ValueError("structure double_pi needs position_ki_per_s2; without it, it is p_pi_pi")
        if self.structure == "pid" and self.speed_ki:
            raise ValueError("structure pid has no speed_ki: set it to 0, its integral gain is position_ki_per_s2")
        return self


class CorrectionLimits(Section):
    """[axis.X.correction]: what the guard lets through. Without this section writing is off."""

    max_offset_um: Positive = Field(50.0, le=CEILING_OFFSET_UM, description="largest offset")
    max_speed_mm_s: Positive = Field(2.0, le=CEILING_SPEED_MM_S, description="largest rate of the offset")
    max_acceleration_mm_s2: Positive = Field(
        250.0, le=CEILING_ACCELERATION_MM_S2, description="largest acceleration of the offset"
    )


class Drive(Section):
    """[axis.X.drive]: how the drive is reached and scaled."""

    bus: str = Field("can0", description="the [bus.*] it is on")
    node_id: int | None = Field(
        None, ge=1, le=127, description="CANopen node-ID; left out: 1 for the first axis, 2 for the next"
    )
    profile: str = Field("fdhil_twin", description="the vendor profile, a name of the DRIVE_PROFILES table")
    increments_per_rev: int = Field(
        65536, ge=4, le=2**31 - 1, description="encoder and set-point increments per revolution"
    )
    sign: Literal[1, -1] = Field(1, description="-1 where the drive counts against the axis")
    rated_current_a: Positive = Field(50.0, description="0x6075; 0x6078 counts in 0.1 % of it")
    setpoint_delay_cycles: int = Field(
        2, ge=0, le=16, description="SYNC cycles by which the drive runs its set-point late"
    )
    following_error_window_mm: Positive = Field(10.0, description="0x6065: beyond it the drive faults")
    speed_limit_mm_s: Positive | None = Field(None, description="the axis maximum; left out: the rapid speed")


class Voltage(Section):
    """[axis.X.voltage]: where the motor's terminal voltage comes from."""

    source: str = Field("drive", description="drive (a vendor object in a TPDO) or modbus (a separate sensor)")
    sampling: Literal["interval_mean", "instant"] = Field(
        "interval_mean", description="the drive's value is the mean since the last sample, or an instant"
    )
    host: str = Field("127.0.0.1", description="modbus: address of the sensor")
    port: int = Field(0, ge=0, le=65535, description="modbus: TCP port; 0 lets the simulator choose one")
    unit: int = Field(1, ge=0, le=247, description="modbus: unit identifier")
    timeout_s: Positive = Field(0.5, description="modbus: how long an answer may take")

    @field_validator("source")
    @classmethod
    def _known(cls, name: str) -> str:
        return _listed(name, tables.VOLTAGE_SOURCES)


class Thermometer(Section):
    """[axis.X.temperature]: the slide-way's thermometer, a float32 in two Modbus input registers."""

    host: str = Field("127.0.0.1", description="address of the thermometer")
    port: int = Field(502, ge=1, le=65535, description="TCP port")
    unit: int = Field(1, ge=0, le=247, description="unit identifier")
    address: int = Field(8, ge=0, le=65534, description="the first of its two registers, high word first")
    period_s: Positive = Field(1.0, le=3600, description="how often it is asked")
    timeout_s: Positive = Field(0.5, description="how long an answer may take")


class Axis(Section):
    """[axis.X]"""

    screw_pitch_mm: Positive = Field(description="table travel per motor revolution")
    rapid_speed_mm_s: Positive = Field(description="speed of G0")
    max_acceleration_mm_s2: Positive = Field(description="acceleration of G0")
    max_jerk_mm_s3: Positive | None = Field(
        None, description="largest jerk of profile jerk_limited; left out: the acceleration is reached in 25 ms"
    )
    nominal: Nominal
    regulators: Regulators
    correction: CorrectionLimits | None = None
    drive: Drive = Drive()
    voltage: Voltage = Voltage()
    temperature: Thermometer | None = None

    @property
    def jerk_mm_s3(self) -> float:
        """Largest jerk."""
        return self.max_jerk_mm_s3 or self.max_acceleration_mm_s2 / 0.025

    @property
    def scaling(self) -> Scaling:
        """Between millimetres and the drive's increments."""
        return Scaling(self.drive.increments_per_rev, self.screw_pitch_mm, self.drive.sign)

    @property
    def rapid_speed_rad_s(self) -> float:
        """Shaft speed of G0."""
        return self.rapid_speed_mm_s / self.screw_pitch_mm * 2 * math.pi


class Nc(Section):
    """[nc]: what the numerical controller makes of a program."""

    profile: Literal["fir", "trapezoidal", "jerk_limited"] = Field(
        "fir", description="fir: smoothed feed; trapezoidal, jerk_limited: look-ahead within the axes' limits"
    )
    smoothing_s: tuple[NotNegative, ...] = Field(
        (0.060, 0.030), max_length=4, description="fir: moving averages over each axis' demand"
    )
    corner: Literal["continuous", "exact_stop"] = Field(
        "continuous", description="between feed moves; look-ahead: continuous obeys G61, G61.1 and G64 P"
    )
    rapid_stop: bool = Field(True, description="look-ahead: stop between rapid and feed; fir always does")
    settle_s: NotNegative = Field(0.0, le=10, description="rest that the NC adds at an exact stop")
    end_rest_s: NotNegative = Field(
        0.5, le=10, description="rest after the last motion: the drives' settling belongs to the path's error"
    )
    max_blocks: int = Field(10_000_000, ge=1, description="blocks a program may execute before it is refused")
    max_call_depth: int = Field(50, ge=1, le=200, description="nesting of calls before a program is refused")


class G0(Section):
    """[g0]: how a rapid move is recognised."""

    source: str = Field("inferred", description="inferred (from the demand's speed) or digital_input (the NC's signal)")
    input_bit: int = Field(16, ge=0, le=31, description="digital_input: bit of 0x60FD that the NC raises")

    @field_validator("source")
    @classmethod
    def _known(cls, name: str) -> str:
        return _listed(name, tables.EVENT_SOURCES)


class Identification(Section):
    """[identification]"""

    method: str | None = Field(None, description="a name of the ESTIMATORS table; left out: the best there is")
    lowpass_hz: Positive = Field(40.0, description="least_squares: corner of the zero-phase low-pass on every signal")

    @field_validator("method")
    @classmethod
    def _known(cls, name: str | None) -> str | None:
        return None if name is None else _listed(name, tables.ESTIMATORS)


class CanBus(Section):
    """[bus.NAME]: a CAN bus."""

    interface: Literal["socketcan", "socketcand", "virtual"] = Field("socketcand", description="python-can interface")
    channel: str = Field("can0", description="socketcan: the network interface; socketcand: the bus behind the hub")
    host: str = Field("127.0.0.1", description="socketcand: address of the hub")
    port: int = Field(0, ge=0, le=65535, description="socketcand: TCP port of the hub; 0 lets the simulator choose one")
    bitrate: int = Field(1_000_000, ge=10_000, le=1_000_000, description="bit/s, for the bus load")


class Store(Section):
    """[store]"""

    directory: Path = Field(Path("fdhil-data"), description="recordings and history; relative to the config's folder")
    run_directory: Path | None = Field(None, description="sockets and the guard's table; left out: <directory>/run")
    keep_windows: int = Field(10_000, ge=1, description="recorded windows kept; the oldest go first")


class Guard(Section):
    """[guard]: the process that owns the transmit socket."""

    node_id: int = Field(100, ge=1, le=127, description="the node-ID of fdhil's own heartbeat")
    heartbeat_s: Positive = Field(0.020, le=1.0, description="period of that heartbeat while armed")
    clock: Literal["monotonic", "sync"] = Field(
        "monotonic",
        description="sync: time is SYNC count x period, for a simulated machine that does not run in real time",
    )


class Maintenance(Section):
    """[maintenance]: relative change of a parameter from its first published value that raises an alarm."""

    R: Positive = Field(0.3, description="relative change")
    L: Positive = Field(0.3, description="relative change")
    K: Positive = Field(0.1, description="relative change")
    Jt: Positive = Field(0.3, description="relative change")
    ft: Positive = Field(1.0, description="relative change")
    Cd: Positive = Field(1.0, description="relative change")


class Noise(Section):
    """[sim.noise]: standard deviations of the twin's white sensor noise."""

    voltage_v: NotNegative = Field(0.06, description="terminal voltage")
    current_a: NotNegative = Field(0.05, description="motor current")
    speed_rad_s: NotNegative = Field(0.15, description="shaft speed")


class SimAxis(Section):
    """[sim.axis.X]: what the simulated drive really is; what is left out is the nominal value."""

    R: Positive | None = Field(None, description="ohm")
    L: Positive | None = Field(None, description="H")
    K: Positive | None = Field(None, description="N.m/A")
    Jt: Positive | None = Field(None, description="kg.m2")
    ft: NotNegative | None = Field(None, description="N.m.s, at the reference temperature")
    Cd: NotNegative | None = Field(None, description="N.m, at the reference temperature")
    ft_per_kelvin: Finite = Field(0.0, description="relative change of ft per kelvin of slide-way temperature")
    Cd_per_kelvin: Finite = Field(0.0, description="relative change of Cd per kelvin of slide-way temperature")
    backlash_um: NotNegative = Field(0.0, description="lost motion between screw and table")
    start_mm: Finite = Field(0.0, description="position at power-on")
    offset_in_feedforward: bool = Field(True, description="whether 0x60B0 is seen by the speed feed-forward")


class Thermal(Section):
    """[sim.thermal]: the slide-ways warm with the work of friction and cool toward the ambient."""

    ambient_c: Finite = Field(20.0, description="ambient and start temperature, the reference of ft and Cd")
    rise_c: NotNegative = Field(2.0, description="rise in steady shuttling at rapid speed")
    time_constant_s: Positive = Field(600.0, description="time constant of that rise")


class Sim(Section):
    """[sim]: the simulated machine; a real machine's config needs none of it."""

    pace: Literal["realtime", "lockstep"] = Field(
        "realtime", description="lockstep: as fast as the bus answers, repeatable"
    )
    seed: int = Field(1, ge=0, description="seed of the sensor noise")
    nc: bool = Field(False, description="whether the simulated NC is switched on at start")
    lockstep_rpdo: tuple[str, ...] = Field(
        (), description="lockstep: RPDOs to wait for, such as X:2; left out: those heard in the cycle before"
    )
    modbus: bool = Field(True, description="serve a Modbus voltage sensor per axis")
    noise: Noise = Noise()
    thermal: Thermal = Thermal()
    axis: Mapping[AxisName, SimAxis] = Field(default_factory=dict)


class MachineConfig(Section):
    """The whole file."""

    machine: Machine
    axis: Mapping[AxisName, Axis] = Field(min_length=1)
    nc: Nc = Nc()
    g0: G0 = G0()
    identification: Identification = Identification()
    bus: Mapping[str, CanBus] = Field(default_factory=lambda: {"can0": CanBus()})
    store: Store = Store()
    guard: Guard = Guard()
    maintenance: Maintenance = Maintenance()
    sim: Sim = Sim()

    @model_validator(mode="after")
    def _consistent(self) -> MachineConfig:
        period = self.machine.sync_period_s
        faults: list[str] = []
        for name, axis in self.axis.items():
            if axis.drive.bus not in self.bus:
                faults.append(f"axis.{name}.drive.bus: there is no [bus.{axis.drive.bus}]")
            faults += [f"axis.{name}.regulators.{fault}" for fault in _period_faults(axis.regulators, period)]
            faults += [f"axis.{name}.correction: {fault}" for fault in _limit_faults(axis.correction, period)]
        ids = [self.node_id(name) for name in self.axis]
        if len({(self.axis[n].drive.bus, i) for n, i in zip(self.axis, ids, strict=True)}) < len(ids):
            faults.append("axis: two drives of one bus have the same node_id")
        faults += [f"sim.axis.{name}: there is no [axis.{name}]" for name in self.sim.axis if name not in self.axis]
        if faults:
            raise ValueError("\n".join(faults))
        return self

    def node_id(self, axis: str) -> int:
        """Return the CANopen node-ID of an axis' drive."""
        return self.axis[axis].drive.node_id or list(self.axis).index(axis) + 1

    @property
    def digest(self) -> str:
        """SHA-256 of the configuration's meaning (not of its text), 16 hexadecimal digits."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()[:16]


def _listed(name: str, table: Mapping[str, str]) -> str:
    if name not in table:
        near = difflib.get_close_matches(name, table, n=1)
        raise ValueError(f"{name!r} is none of {', '.join(table)}" + (f"; did you mean {near[0]!r}?" if near else ""))
    return name


def _period_faults(regulators: Regulators, sync_period_s: float) -> list[str]:
    faults = []
    for key, longer, shorter in (
        ("speed_period_s", sync_period_s, regulators.speed_period_s),
        ("current_period_s", regulators.speed_period_s, regulators.current_period_s),
    ):
        ratio = longer / shorter
        if ratio < 0.999 or abs(ratio - round(ratio)) > 1e-6 * ratio:
            faults.append(f"{key}: {shorter} s does not divide {longer} s")
    return faults


def _limit_faults(limits: CorrectionLimits | None, sync_period_s: float) -> list[str]:
    """The time to safe must stay under 120 ms: n_detect + 1 + ceil(L/S) + 3 ceil(S/A) cycles (safety concept)."""
    if limits is None:
        return []
    speed_um = limits.max_speed_mm_s * 1e3 * sync_period_s
    acceleration_um = limits.max_acceleration_mm_s2 * 1e3 * sync_period_s**2
    cycles = 3 + 1 + math.ceil(limits.max_offset_um / speed_um) + 3 * math.ceil(speed_um / acceleration_um)
    if cycles * sync_period_s > 0.120:
        return [
            f"from the largest offset to zero these limits need {cycles * sync_period_s * 1e3:.0f} ms, 120 are allowed"
            " (lower max_offset_um or raise max_speed_mm_s)"
        ]
    return []


def load(path: Path) -> MachineConfig:
    """Read a machine configuration; ConfigError with every fault, its path and a suggestion."""
    try:
        raw = path.read_bytes()
    except OSError as error:
        fault = ConfigFault("file", f"cannot be read: {error.strerror}", "check the path")
        raise ConfigError(str(path), [fault]) from None
    if len(raw) > MAX_CONFIG_BYTES:
        raise ConfigError(str(path), [ConfigFault("file", "is larger than 256 KiB", "a machine config is a few kB")])
    try:
        document = tomllib.loads(raw.decode("utf-8"))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(str(path), [ConfigFault("file", f"is no TOML: {error}", "check the line it names")]) from None
    return parse(document, str(path), path.parent)


def parse(document: Mapping[str, Any], source: str = "config", folder: Path = Path()) -> MachineConfig:
    """Check a parsed TOML document; relative directories of [store] are taken from ``folder``."""
    try:
        config = MachineConfig.model_validate(document)
    except ValidationError as error:
        raise ConfigError(source, _faults(error)) from None
    directory = folder / config.store.directory
    run = config.store.run_directory
    store = config.store.model_copy(
        update={"directory": directory, "run_directory": folder / run if run else directory / "run"}
    )
    return config.model_copy(update={"store": store})


def _faults(error: ValidationError) -> list[ConfigFault]:
    faults = []
    for item in error.errors():
        path = ".".join(str(part) for part in item["loc"]) or "config"
        if item["type"] == "extra_forbidden":
            faults.append(ConfigFault(path, "is no key of this section", _near_key(item["loc"])))
        elif item["type"] == "missing":
            faults.append(ConfigFault(path, "is missing", _describe(item["loc"])))
        elif item["type"] == "value_error" and not item["loc"]:
            for line in str(item["ctx"]["error"]).splitlines():
                where, _, what = line.partition(": ")
                faults.append(ConfigFault(where, what))
        else:
            shown = f", not {item['input']!r}" if isinstance(item["input"], str | int | float | bool) else ""
            faults.append(ConfigFault(path, item["msg"].removeprefix("Value error, ") + shown, _describe(item["loc"])))
    return faults


def _section(loc: tuple[int | str, ...]) -> type[Section] | None:
    """Follow a path of keys through the models; None where it leaves them."""
    section: type[Section] = MachineConfig
    for key in loc:
        field = section.model_fields.get(str(key))
        if field is None:  # a name chosen by the user: axis.X, bus.can0
            continue
        inner = [a for a in _arguments(field.annotation) if isinstance(a, type) and issubclass(a, Section)]
        if not inner:
            return section
        section = inner[0]
    return section


def _arguments(annotation: Any) -> list[Any]:
    arguments = getattr(annotation, "__args__", None)
    return [annotation] if not arguments else [x for a in arguments for x in _arguments(a)]


def _near_key(loc: tuple[int | str, ...]) -> str:
    section = _section(loc[:-1])
    near = difflib.get_close_matches(str(loc[-1]), section.model_fields if section else [], n=1)
    return f"did you mean {near[0]!r}?" if near else "see configs/machine-template.toml"


def _describe(loc: tuple[int | str, ...]) -> str:
    section = _section(loc[:-1])
    field = section.model_fields.get(str(loc[-1])) if section else None
    return field.description or "" if field else ""
