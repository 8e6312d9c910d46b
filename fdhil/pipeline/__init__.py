"""Sequences the rooms below: samples in, outcomes out. No I/O, no clock: the same input gives the same bits."""

from fdhil.lazy_exports import export_names

__getattr__, __dir__, __all__ = export_names(__name__, __file__)
