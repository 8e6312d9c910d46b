"""[nc], [g0], [identification]: how the NC executes a program, and how its rapids are used."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from fdhil import tables
from fdhil.config.section import NotNegative, Positive, Section, require_one_of


class Nc(Section):
    """[nc]: how the numerical controller executes a program."""

    profile: Literal["fir", "trapezoidal", "jerk_limited", "linuxcnc"] = Field(
        "fir", description="fir: smoothed feed; trapezoidal, jerk_limited: look-ahead; linuxcnc: LinuxCNC's planner"
    )
    smoothing_s: tuple[Annotated[NotNegative, Field(le=10)], ...] = Field(
        (0.060, 0.030), max_length=4, description="fir: moving averages over each axis' demand"
    )
    max_path_speed_mm_s: Positive = Field(
        1e6,
        ge=1e-3,
        le=1e6,
        description="largest speed along the path, rapids included (LinuxCNC: [TRAJ] MAX_LINEAR_VELOCITY); 1e6: none",
    )
    corner: Literal["continuous", "exact_stop"] = Field(
        "continuous", description="between feed moves; look-ahead: continuous obeys G61, G61.1 and G64 P"
    )
    rapid_stop: bool = Field(True, description="look-ahead: stop between rapid and feed; fir always does")
    settle_s: NotNegative = Field(0.0, le=10, description="rest that the NC adds at an exact stop")
    end_rest_s: NotNegative = Field(
        0.5, le=10, description="rest after the last motion, so that settling counts as error"
    )
    dwell_unit: Literal["s", "ms", "ms_without_point"] = Field(
        "s", description="P of a dwell (G4, G82, G86, G89): s as LinuxCNC, ms, or ms_without_point (Haas, Fanuc: P500)"
    )
    integers: Literal["whole", "thousandths", "thousandths_and_feed"] = Field(
        "whole",
        description="a length or angle without a decimal point: whole units as LinuxCNC, thousandths of mm and degree "
        "(tenths of that in inch; Haas and Fanuc by default), or thousandths_and_feed: F too (Haas by default)",
    )
    wrapped_axes: tuple[Literal["A", "B", "C"], ...] = Field(
        (),
        description="rotary axes whose absolute words are within one turn and turn by their sign (LinuxCNC: "
        "[AXIS_A] WRAPPED_ROTARY)",
    )
    max_blocks: int = Field(10_000_000, ge=1, le=10**12, description="blocks that a program may execute")
    max_repeated_blocks: int = Field(500_000, ge=1, le=10**12, description="of these, repeated by loops and calls")
    max_call_depth: int = Field(50, ge=1, le=200, description="nesting of calls before a program is refused")


# of the following error: separates useful from useless models on two machines with 90 real effects
TOLERANCE_SHARE = 0.05


class G0(Section):
    """[g0]: how a rapid move is recognised."""

    source: Annotated[str, require_one_of(tables.EVENT_SOURCES)] = Field(
        "inferred",
        description=f"{', '.join(tables.EVENT_SOURCES)}; inferred: from the demand's speed,"
        " digital_input: the NC's signal; else what the NC reports ([nc_source])",
    )
    input_bit: int = Field(16, ge=0, le=31, description="digital_input: bit of 0x60FD that the NC raises")


class Correction(Section):
    """[correction]: learning in addition to the planned correction."""

    learning: bool = Field(False, description="learn offsets from the measured error of each pass, for the next pass")


class Identification(Section):
    """[identification]: how the parameters are estimated."""

    method: Annotated[str, require_one_of(tables.ESTIMATORS)] | None = Field(
        None, description=f"{', '.join(tables.ESTIMATORS)}; left out: the best one"
    )
    lowpass_hz: Positive = Field(40.0, ge=0.01, le=1e5, description="least_squares: corner of the zero-phase low-pass")
    tolerance_um: Positive | None = Field(
        None,
        le=1e4,
        description="largest accepted RMS residual of a model at the table; left out: 5 % of the rapid's "
        "following error",
    )
    speed_source: Literal["auto", "sensor", "difference", "filtered"] = Field(
        "auto",
        description="kind of the recorded speed: instantaneous, a difference of positions, or filtered; auto: "
        "determined from the data",
    )
    voltage_source: Literal["auto", "terminals", "command"] = Field(
        "auto",
        description="kind of the recorded voltage: measured at the motor, or the drive's command; auto: "
        "determined from the data",
    )

    def compute_tolerance_um(self, following_um: float) -> float:
        """Return the largest accepted RMS residual (um at the table) of a rapid whose following error has this RMS."""
        return self.tolerance_um or TOLERANCE_SHARE * following_um
