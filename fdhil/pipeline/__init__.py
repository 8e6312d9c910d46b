"""Sequences the rooms below: samples in, outcomes out. No I/O, no clock: the same input gives the same bits."""

from __future__ import annotations

from fdhil.pipeline.analysis import analyse
from fdhil.pipeline.axis import POOL_WINDOWS, AxisPipeline, Known, Record
from fdhil.pipeline.held_out_pool import pool_with_held_out
from fdhil.pipeline.pooling import pool
from fdhil.pipeline.recorded import analyse_windows

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
