"""[sim.axis.X.reality]: effects of real axes that the paper's plant lacks; each is off until it is set."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from fdhil.config.section import Finite, NotNegative, Positive, Section

Share = Annotated[float, Field(ge=-1.0, le=1.0, allow_inf_nan=False)]


class Reality(Section):
    """[sim.axis.X.reality]: effects of a real axis beyond the paper's plant, each off until it is set."""

    static_friction: Annotated[float, Field(ge=-0.95, le=5.0)] = Field(
        0.0, description="share of Cd added at standstill, decaying with speed; negative: friction increases with speed"
    )
    static_speed_rad_s: Positive = Field(10.0, ge=1e-3, le=1e4, description="speed ws of its decay, exp(-(w/ws)^2)")
    presliding_um: NotNegative = Field(
        0.0, le=1e3, description="table travel over which dry friction builds up (LuGre); 0: none"
    )
    friction_asymmetry: Share = Field(0.0, description="share by which Cd is larger in the positive direction")
    viscous_asymmetry: Share = Field(0.0, description="share by which ft is larger in the positive direction")
    friction_ripple: Share = Field(0.0, description="share of dry friction that varies once per revolution")
    load_nm: Finite = Field(0.0, description="constant torque against the positive direction: weight, counterweight")
    brake_nm: NotNegative = Field(0.0, description="torque of a holding brake that is closed while no current flows")
    screw_ripple_nm: NotNegative = Field(0.0, description="amplitude of a torque that follows the screw's angle")
    screw_ripple_order: int = Field(1, ge=1, le=99, description="its periods per revolution")
    screw_ripple_phase_rad: Finite = Field(0.0, description="its phase where the axis is at 0 mm")
    motor_ripple_nm: NotNegative = Field(0.0, description="amplitude of a torque that follows the motor's poles")
    motor_ripple_order: int = Field(24, ge=1, le=999, description="its periods per revolution")
    motor_ripple_phase_rad: Finite = Field(0.0, description="its phase where the axis is at 0 mm")

    resonance_hz: NotNegative = Field(
        0.0, le=500.0, description="motor against table on the screw's stiffness; 0: rigid"
    )
    resonance_damping: Annotated[float, Field(ge=0.0, le=1.0)] = Field(0.02, description="its damping ratio")
    table_inertia: Annotated[float, Field(ge=0.05, le=0.95)] = Field(
        0.6, description="share of Jt behind that compliance"
    )
    table_friction: Annotated[float, Field(ge=0.0, le=1.0)] = Field(1.0, description="share of ft and Cd behind it")
    position_encoder: Literal["table", "motor"] = Field(
        "table", description="encoder of the position loop: a scale at the table, or the motor's shaft"
    )
    pitch_error_um: NotNegative = Field(0.0, le=1e3, description="amplitude of the screw's error once per revolution")
    pitch_error_um_per_m: Finite = Field(0.0, ge=-1e3, le=1e3, description="growth of the screw's error with position")

    dead_time_v: NotNegative = Field(0.0, description="voltage loss by the inverter's dead time, against the current")
    dead_time_current_a: Positive = Field(0.5, ge=1e-3, le=1e4, description="current from which the loss is complete")
    bus_sag: Annotated[float, Field(ge=0.0, le=0.9)] = Field(
        0.0, description="share by which the DC bus and the output voltages drop at bus_power_kw"
    )
    bus_power_kw: Positive = Field(10.0, ge=1e-3, le=1e4, description="electric power of the axis for that drop")
    bus_time_constant_s: NotNegative = Field(0.002, le=10.0, description="time constant of its capacitors; 0: none")
    voltage_object: Literal["terminals", "command"] = Field(
        "terminals", description="content of 0x2101: the voltage at the motor, or the current loop's command"
    )

    current_gain: Positive = Field(1.0, ge=0.5, le=2.0, description="of the current sensor: it also affects the loop")
    current_offset_a: Finite = Field(0.0, description="of the current sensor: it also affects the loop")
    voltage_gain: Positive = Field(1.0, ge=0.5, le=2.0, description="of 0x2101")
    encoder_bits: int = Field(0, ge=0, le=32, description="resolution of the encoder per revolution, 2^bits; 0: ideal")
    speed_object: Literal["shaft", "difference", "loop"] = Field(
        "shaft",
        description="0x606C: the shaft with white noise, the encoder's difference over a SYNC period, the loop's speed",
    )
    speed_object_filter_s: NotNegative = Field(
        0.0, le=1.0, description="first-order filter on 0x606C, by SYNC; 0: none"
    )
    speed_feedback: Literal["shaft", "difference"] = Field(
        "shaft", description="feedback of the speed loop: the shaft, or the encoder's difference over its cycle"
    )

    position_gain_per_s: Positive | None = Field(
        None, ge=1e-2, le=1e5, description="true gain of the drive; this and those below left out: as in regulators"
    )
    speed_feedforward: Annotated[float, Field(ge=0, le=1.5)] | None = Field(None, description="true value of the drive")
    speed_kp: Positive | None = Field(None, description="true value of the drive, A.s/rad")
    speed_ki: NotNegative | None = Field(None, description="true value of the drive, A/rad")
    current_kp: Positive | None = Field(None, description="true value of the drive, V/A")
    current_ki: NotNegative | None = Field(None, description="true value of the drive, V/(A.s)")
    setpoint_filter_s: NotNegative | None = Field(None, le=1.0, description="true value of the drive")
    speed_filter_s: NotNegative | None = Field(None, le=0.1, description="true value of the drive")
    current_delay_cycles: int | None = Field(None, ge=0, le=32, description="true value of the drive")

    def list_loop_settings(self) -> dict[str, float]:
        """Return the regulator settings that are set here, by their key."""
        named = {key: getattr(self, key) for key in LOOPS}
        return {key: value for key, value in named.items() if value is not None}


LOOPS = (
    "position_gain_per_s", "speed_feedforward", "speed_kp", "speed_ki", "current_kp", "current_ki",
    "setpoint_filter_s", "speed_filter_s", "current_delay_cycles",
)  # fmt: skip
