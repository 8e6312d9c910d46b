"""Records of paths: reference, prediction and correction."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from fdhil.records.physical_parameters import Bool, Float, Int, compute_rms
from fdhil.records.verdicts import Reason


@dataclass(frozen=True, slots=True)
class Trajectory:
    """A reference on the SYNC grid: ``time_s`` (n,), ``position_mm`` per axis (n,); ``rapid`` (n,) marks G0 samples.

    ``line`` (n,) is the source line of the program for each sample, 0 where there is none. ``notes`` are doubts about
    the program. For a rotary axis with ``mm_per_degree``, mm are arc lengths at its radius.
    """

    dt_s: float
    time_s: Float
    position_mm: Mapping[str, Float]
    rapid: Bool
    line: Int
    notes: tuple[Reason, ...] = ()
    mm_per_degree: Mapping[str, float] = field(default_factory=dict)

    @property
    def axes(self) -> tuple[str, ...]:
        """The axes in the machine's order, both drives of a gantry axis."""
        return tuple(self.position_mm)

    @property
    def table_axes(self) -> tuple[str, ...]:
        """The axes of the path; a gantry axis appears once."""
        return list_table_axes(self.axes)

    @property
    def path_mm(self) -> Float:
        """The path (n, d), one column for each of ``table_axes``."""
        return self.compute_table_mm(self.position_mm)

    def compute_table_mm(self, position_mm: Mapping[str, Float]) -> Float:
        """Return the path (n, d) of the table for drive positions (n,) per axis."""
        return compute_table_path(self.axes, np.column_stack([position_mm[axis] for axis in self.axes]))

    def describe_position(self, row: int) -> str:
        """Return the position of a row as text: ``X 1.0 Y 2.0``, a rotary axis in degrees."""
        at = {axis: self.position_mm[axis][row] / self.mm_per_degree.get(axis, 1.0) for axis in self.table_axes}
        return " ".join(f"{axis} {position:.1f}" for axis, position in at.items())


def list_table_axes(axes: Sequence[str]) -> tuple[str, ...]:
    """Return the axes of a path: Y for the drives Y and Y2 of a gantry axis."""
    return tuple(dict.fromkeys(axis[0] for axis in axes))


def compute_table_path(axes: Sequence[str], position_mm: Float) -> Float:
    """Return the path (n, d) of a table from its drives' positions (n, k); a gantry axis is the mean of its drives."""
    found = list_table_axes(axes)
    if len(found) == len(axes):
        return position_mm
    return np.column_stack([position_mm[:, [a[0] == axis for a in axes]].mean(axis=1) for axis in found])


@dataclass(frozen=True, slots=True)
class Zone:
    """A section of the path with a prominent contour error: its position, size and cause."""

    start_s: float
    end_s: float
    where: str
    max_um: float
    cause: str


@dataclass(frozen=True, slots=True)
class Prediction:
    """Predicted against reference: arrays (n,) per axis, contour error (n,) in um, and zones.

    ``current_a`` per axis (n,) is the model's at the SYNC instants; ``limited_s`` is the time that each axis spent in a
    limit.
    """

    reference: Trajectory
    predicted_mm: Mapping[str, Float]
    error_um: Mapping[str, Float]
    contour_um: Float
    current_a: Mapping[str, Float]
    limited_s: Mapping[str, float]
    zones: tuple[Zone, ...] = ()

    @property
    def rms_um(self) -> float:
        """RMS of the contour error, um."""
        return compute_rms(self.contour_um)

    def get_zone_rows(self, zone: Zone) -> slice:
        """Return the rows of a zone."""
        start_s = float(self.reference.time_s[0])
        return slice(*(round((seconds - start_s) / self.reference.dt_s) for seconds in (zone.start_s, zone.end_s)))

    def find_worst_row(self, zone: Zone) -> int:
        """Return the row of a zone's largest contour error."""
        rows = self.get_zone_rows(zone)
        return int(rows.start + self.contour_um[rows].argmax())


@dataclass(frozen=True, slots=True)
class Skill:
    """Predicted against measured following error of one recorded move."""

    axis: str
    tick: int
    rms_um: float
    max_um: float
    delay_ms: float
    measured_rms_um: float


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Residual following error of moves that the models were not identified from, um, for the worst move.

    ``max_um`` is the largest of any move, ``following_um`` the RMS following error of the move with ``rms_um``.
    """

    moves: int
    rms_um: float
    max_um: float
    following_um: float


@dataclass(frozen=True, slots=True)
class Correction:
    """Result of a correction method for a reference: offsets per axis (n,), path error without and with them.

    ``offset_um`` is added to the reference; ``refused`` is empty when the correction may be used, else all offsets are
    0. ``warnings`` do not refuse it. ``measure_delay_s`` is the delay tau of the target r(t - tau). Speed and torque
    offsets (n,) per axis are empty unless the method is an on-line feed-forward.
    """

    method: str
    before: Prediction
    after: Prediction
    offset_um: Mapping[str, Float]
    refused: tuple[Reason, ...] = ()
    warnings: tuple[Reason, ...] = ()
    delay_s: float = 0.0
    speed_offset_rad_s: Mapping[str, Float] = field(default_factory=dict)
    torque_offset_nm: Mapping[str, Float] = field(default_factory=dict)
