"""Listens to a CAN bus: ways onto it, its frames in bulk, the SYNC grid, SDO, and the watch over its nodes."""
