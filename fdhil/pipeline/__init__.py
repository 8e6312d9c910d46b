"""Sequences the rooms below: samples in, outcomes out. No I/O, no clock: the same input gives the same bits."""

from __future__ import annotations

from fdhil.pipeline.axis_pipeline import POOL_WINDOWS, AxisPipeline, PipelineState, Record
from fdhil.pipeline.identified_loops import analyse_windows
from fdhil.pipeline.validated_pool import pool_windows, pool_with_held_out
from fdhil.pipeline.window_analysis import analyse_window

__all__ = [
    "POOL_WINDOWS",
    "AxisPipeline",
    "PipelineState",
    "Record",
    "analyse_window",
    "analyse_windows",
    "pool_windows",
    "pool_with_held_out",
]
