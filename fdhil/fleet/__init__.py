"""Collects the records of many machines: sending (uplink), collecting (collector) and evaluating them (questions)."""

from fdhil.lazy_exports import export_names

__getattr__, __dir__, __all__ = export_names(__name__, __file__)
