"""Sequences the rooms below: samples in, outcomes out. No I/O, no clock: the same input gives the same bits."""

from __future__ import annotations

from fdhil.pipeline.analysis import analyse
from fdhil.pipeline.axis import POOL_WINDOWS, AxisPipeline, Known, Record
from fdhil.pipeline.identified_loops import analyse_windows
from fdhil.pipeline.validated_pool import pool, pool_with_held_out

__all__ = [
    "POOL_WINDOWS",
    "AxisPipeline",
    "Known",
    "Record",
    "analyse",
    "analyse_windows",
    "pool",
    "pool_with_held_out",
]
