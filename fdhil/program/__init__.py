"""Interpret ISO 6983 programs and read recorded demands: the motion that the NC will command."""

from fdhil.lazy_exports import export_names

__getattr__, __dir__, __all__ = export_names(__name__, __file__)
