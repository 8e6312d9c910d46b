"""A complete machine in one process on one virtual clock: daemon, guard, store, drives, NC and operator.

The same seed and the same calls give the same frames, history rows and log, byte by byte.
"""
