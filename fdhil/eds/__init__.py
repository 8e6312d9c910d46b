"""Reads EDS and DCF files (CiA 306): the one reader of drivers, commissioning and simulator."""

from fdhil.lazy_exports import export_names

__getattr__, __dir__, __all__ = export_names(__name__, __file__)
