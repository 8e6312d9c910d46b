"""Benchmarks: what takes how long, measured (``python -m benchmarks``)."""

import fdhil as fdhil  # before NumPy: it keeps the numeric libraries to one thread
