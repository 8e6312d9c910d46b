"""Receives from a CAN bus: bus interfaces, frames in bulk, SYNC grid, SDO, node monitoring."""
