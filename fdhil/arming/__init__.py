"""Arming: checks a program, hands its table rows to the guard, and feeds more rows while the machine runs."""

from fdhil.lazy_exports import export_names

__getattr__, __dir__, __all__ = export_names(__name__, __file__)
