"""[axis.X.regulators]: the drive's nested loops."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from fdhil import tables
from fdhil.config.section import NotNegative, Positive, Section, require_one_of


class Regulators(Section):
    """[axis.X.regulators]: the drive's nested loops."""

    structure: Annotated[str, require_one_of(tables.REGULATORS)] = Field(
        "p_pi_pi", description=f"the regulators' structure: {', '.join(tables.REGULATORS)}"
    )
    position_gain_per_s: Positive = Field(ge=1e-2, le=1e5, description="Kv of the position loop, 1/s")
    speed_feedforward: Annotated[float, Field(ge=0, le=1.5)] = Field(
        1.0, description="fed-forward share of the demand's speed"
    )
    speed_kp: Positive = Field(
        description="proportional gain of the speed loop, A.s/rad; pid: derivative gain, factor of the others"
    )
    speed_ki: NotNegative = Field(description="integral gain of the speed loop, A/rad")
    speed_period_s: Positive = Field(0.00025, ge=1e-6, le=0.02, description="cycle of the speed loop")
    current_limit_a: Positive = Field(ge=1e-2, le=1e5, description="limit of the speed loop's output")
    current_kp: Positive = Field(description="proportional gain of the current loop, V/A")
    current_ki: NotNegative = Field(description="integral gain of the current loop, V/(A.s)")
    current_period_s: Positive = Field(3.125e-5, ge=1e-6, le=0.02, description="cycle of the current loop")
    voltage_limit_v: Positive = Field(ge=0.1, le=1e5, description="limit of the current loop's output")
    position_ki_per_s2: NotNegative = Field(0.0, description="double_pi, pid: integral gain of the position loop")
    torque_feedforward: Annotated[float, Field(ge=0, le=1.5)] = Field(
        0.0, description="share of the nominal inertia's current fed forward"
    )
    setpoint_filter_s: NotNegative = Field(0.0, le=1.0, description="time constant of a set-point filter; 0: none")
    setpoint_filter_order: Literal[1, 2] = Field(1, description="first order, or two equal ones in series")
    speed_filter_s: NotNegative = Field(0.0, le=0.1, description="first-order filter on the speed feedback; 0: none")
    current_delay_cycles: int = Field(0, ge=0, le=32, description="current cycles until a computed voltage acts")

    pid_output: Literal["speed", "current"] = Field(
        "speed", description="linuxcnc_pid: meaning of the output: a speed, or speed_kp times it a current"
    )
    position_derivative: NotNegative = Field(0.0, description="linuxcnc_pid: Dgain")
    position_feedforward_per_s: NotNegative = Field(0.0, description="linuxcnc_pid: FF0, 1/s")
    acceleration_feedforward_s: NotNegative = Field(0.0, description="linuxcnc_pid: FF2, s")
    jerk_feedforward_s2: NotNegative = Field(0.0, description="linuxcnc_pid: FF3, s2")
    deadband_mm: NotNegative = Field(0.0, le=10.0, description="linuxcnc_pid: dead band of the error")
    output_limit_mm_s: NotNegative = Field(0.0, description="linuxcnc_pid: maxoutput, as table speed; 0: none")
    error_previous_target: bool = Field(True, description="linuxcnc_pid: error against the previous command")

    @model_validator(mode="after")
    def _check_structure(self) -> Regulators:
        if self.structure == "p_pi_pi" and self.position_ki_per_s2:
            raise ValueError("structure p_pi_pi has no position_ki_per_s2; set structure = 'double_pi'")
        if self.structure == "double_pi" and not self.position_ki_per_s2:
            raise ValueError("structure double_pi needs position_ki_per_s2; without it, use structure = 'p_pi_pi'")
        no_speed_loop = self.structure == "pid" or (self.structure == "linuxcnc_pid" and self.pid_output == "current")
        if no_speed_loop and self.speed_ki:
            text = f"structure {self.structure} has no speed_ki"
            raise ValueError(f"{text}: set it to 0, its integral gain is position_ki_per_s2")
        if self.structure == "linuxcnc_pid" and (self.setpoint_filter_s or self.torque_feedforward):
            raise ValueError(
                "structure linuxcnc_pid has neither setpoint_filter_s nor torque_feedforward: leave them out"
            )
        if self.structure != "linuxcnc_pid" and (own := self._list_linuxcnc_keys()):
            raise ValueError(f"structure {self.structure} has no {', '.join(own)}; set structure = 'linuxcnc_pid'")
        return self

    def _list_linuxcnc_keys(self) -> list[str]:
        fields = type(self).model_fields.items()
        own = [key for key, field in fields if (field.description or "").startswith("linuxcnc_pid:")]
        return [key for key in own if getattr(self, key) != type(self).model_fields[key].default]


def find_period_faults(regulators: Regulators, sync_period_s: float) -> list[str]:
    faults = []
    for key, longer, of, shorter in (
        ("speed_period_s", sync_period_s, "sync_period_s of its bus", regulators.speed_period_s),
        ("current_period_s", regulators.speed_period_s, "speed_period_s", regulators.current_period_s),
    ):
        ratio = longer / shorter
        if ratio < 0.999 or abs(ratio - round(ratio)) > 1e-6 * ratio:
            faults.append(f"{key}: {shorter} s does not divide {of}, {longer} s")
    return faults
